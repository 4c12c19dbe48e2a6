"""Arguments from a file: for lists that are as long as a data set is large."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
    options = cli._parser().parse_args(["crops", "manifest", *words])
    assert options.simulated == [Path("a b.parquet"), Path("c.parquet")] and options.real == []
    assert options.config == '{"crops": {"seed": 1}}'


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


def test_an_option_between_paths_is_explained(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main(["reconstruct", "cloud.laz", "--terrain", "dtm.tif", "footprints.gpkg", "out"])
    assert "unrecognized arguments: out; give all paths together" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        cli.main(["reconstruct", "cloud.laz", "footprints.gpkg", "out", "--terain", "dtm.tif"])
    assert capsys.readouterr().err.endswith("unrecognized arguments: --terain dtm.tif\n")
