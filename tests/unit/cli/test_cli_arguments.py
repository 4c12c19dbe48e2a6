"""Arguments from a file: for lists that are as long as a data set is large."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import click
import pytest

from p2wss import cli

NUM_SHARDS = 20_000


def test_a_file_stands_for_the_arguments_in_it(tmp_path: Path) -> None:
    listing, nothing, config = (tmp_path / name for name in ("list", "nothing", "config"))
    listing.write_text("a b.parquet\nc.parquet\n")
    nothing.write_text("\n")  # printf '%s\n' without arguments
    config.write_text('{"crops": {"seed": 1}}\n')
    words = [
        "--out",
        "m.json",
        "--simulated",
        f"@{listing}",
        "--real",
        f"@{nothing}",
        "--config",
        f"@{config}",
    ]
    context = click.Context(cli.program)
    manifest = cli.program.get_command(context, "crops").get_command(context, "manifest")
    options = manifest.make_context("manifest", cli.with_files(words)).params
    assert options["simulated"] == (Path("a b.parquet"), Path("c.parquet")) and options["real"] == ()
    assert options["config"].crops.seed == 1


@pytest.mark.parametrize("by_file", [True, False])
def test_a_manifest_of_thousands_of_shards_is_a_command_that_can_be_started(
    tmp_path: Path, by_file: bool
) -> None:
    """As the rule calls it: the shell hands the list over, which is more than Linux passes on as arguments."""
    shards = f"$(seq -f '{'results/name/' * 8}crops/simulated/%06.0f_6862.parquet' {NUM_SHARDS})"
    listed = f"@<(printf '%s\\n' {shards})" if by_file else shards
    program = f"{sys.executable} -m p2wss.cli crops manifest --out manifest.json"
    script = f"{program} --simulated {listed} --real @<(printf '\\n')"
    run = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    if by_file:
        assert run.returncode == 2 and "crops/simulated/000001_6862.parquet" in run.stderr
    else:
        assert run.returncode == 126 and "Argument list too long" in run.stderr


def run(*words: object) -> int:
    return cli.main([str(word) for word in words])


def test_options_stand_anywhere_among_the_paths(place: Path) -> None:
    options = ["--model", "none", "--format", "obj"]
    assert (
        run(
            "reconstruct",
            *options[:2],
            place / "cloud.laz",
            *options[2:],
            place / "footprints.gpkg",
            place / "out",
        )
        == 0
    )
    assert (place / "out" / "cloud.obj").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["reconstruct", "a", "b", "c", "--terain", "d"], "No such option '--terain'. (Did you mean"),
        (["reconstruct", "a", "b", "c", "--detail", "lo"], "Invalid value for '--detail': 'lo' is not one of"),
        (["reconstruct", "a", "b", "c", "--frequency-ghz", "-1"], "reconstruct.frequency_ghz: Input should be greater"),
        (["reconstruct", "a", "b", "c", "--threads", "0"], "Invalid value for '--threads': 0 is not in the range"),
        (["reconstrct"], "No such command 'reconstrct'. Did you mean 'reconstruct'?"),
        (["crops", "reel"], "No such command 'reel'. Did you mean 'real'?"),
        (["crops", "manifest", "--real", "a"], "Missing option '--out'. (see p2wss crops manifest --help)"),
        (["reconstruct", "a", "b", "c", "--crs", "--skin"], "Option '--crs' requires an argument."),
        (["inspect", "@none"], "@none: not a readable list of arguments"),
    ],
)  # fmt: skip
def test_a_wrong_argument_is_one_line(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("p2wss: error: ") and message in line


def test_later_configs_win_and_options_over_them(tmp_path: Path) -> None:
    first, second = tmp_path / "a.yaml", '{"reconstruct": {"buffer_m": 3, "detail": "low"}}'
    first.write_text("reconstruct: {buffer_m: 2, wedges: true}")
    words = ["a", "b", "c", "--config", str(first), "--config", second, "--detail", "high", "--no-skin"]
    reconstruct = cli.program.get_command(click.Context(cli.program), "reconstruct")
    config = reconstruct.make_context("reconstruct", words).params["config"].reconstruct
    assert (config.buffer_m, config.wedges, config.detail, config.skin) == (3, True, "high", False)


@pytest.mark.parametrize("words", [[], ["-h"], ["eval"], ["fetch"], ["crops", "manifest", "--help"]])
def test_help_is_no_error(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*words) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("Usage: p2wss") and not printed.err


def test_the_options_for_every_day_fit_one_screen_and_all_are_shown_on_request(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run("reconstruct", "--help") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 40 and not any("--wedges" in line for line in lines)
    assert run("reconstruct", "--help-all") == 0
    every = capsys.readouterr().out
    assert "More options:" in every and "--wedges" in every and "--outputs" in every
    assert run("check", "--help") == 0
    assert "--help-all" not in capsys.readouterr().out


def test_every_command_is_described_as_it_describes_itself() -> None:
    context = click.Context(cli.program)
    for commands in cli.COMMANDS.values():
        for name in commands:
            command = cli.program.get_command(context, name)
            assert command is not None and command.name == name and command.help


def test_the_help_imports_nothing_slow() -> None:
    code = "import sys; from p2wss.cli import main; main([]); print({'numpy', 'pydantic'} & set(sys.modules))"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert output.stdout.endswith("set()\n")


def test_an_interrupted_command_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(path: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("p2wss.cli.inspection.describe", interrupt)
    assert run("inspect", "a") == 130
    assert capsys.readouterr().err == "p2wss: interrupted\n"


def test_the_shell_completes_commands_and_values() -> None:
    def completed(*words: str) -> set[str]:
        environment = {"_P2WSS_COMPLETE": "bash_complete", "COMP_WORDS": " ".join(["p2wss", *words])}
        environment["COMP_CWORD"] = str(len(words))
        code = "import sys; from p2wss.cli import main; sys.exit(main([]))"
        environment |= os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
        return {line.partition(",")[2] for line in run.stdout.splitlines()}

    assert completed("re") == {"reconstruct"}
    assert completed("eval", "me") == {"measure", "medians"}
    assert completed("reconstruct", "--detail", "") == {"low", "normal", "high"}
