"""What the documentation names exists: commands, options, rules, targets, settings, files and figures."""

from __future__ import annotations

import importlib
import inspect
import re
import runpy
import shlex
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import yaml
from pydantic import BaseModel

import p2wss
from p2wss import cli
from p2wss.config import Config, load
from p2wss.reconstruction.scene import Scene

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "models/README.md",
    *sorted(path for path in ROOT.glob("docs/**/*.md") if path.parent.name != "templates"),
]
RULES = {
    name
    for path in [ROOT / "Snakefile", *ROOT.glob("workflow/rules/*.smk")]
    for name in re.findall(r"^(?:rule|checkpoint) (\w+):", path.read_text(), re.MULTILINE)
}
# the pages name the files of one region, whose place is empty
RULES_TEXT = "".join(path.read_text() for path in ROOT.glob("workflow/rules/*.smk")).replace("{place}", "")
SOURCES = [
    path
    for folder in (
        "src",
        "workflow",
        "config",
        "benchmarks",
        "tests",
        "profiles",
        "envs",
        "docs/img",
        "docs/results",
    )
    for path in (ROOT / folder).rglob("*")
    if path.suffix in (".py", ".smk", ".yaml", ".json", ".csv", ".txt") and path.name != Path(__file__).name
]
# options of Snakemake that the pages name
SNAKEMAKE_FLAGS = {"-n", "-f", "--unlock"}
SNAKEMAKE_VALUES = {
    "--profile", "--report", "--sdm", "--container-image", "-R",
    "--default-storage-prefix", "--slurm-no-account", "--slurm-status-command",
}  # fmt: skip
# what the recipes of CONTRIBUTING add
RECIPES = re.compile(r"saltbox|\bdome\b|hip35|\btail\b|tail_|\boff$")
# placeholders in the pages, and files that a command of the pages writes
PLACEHOLDER = re.compile(r"\.\.|[<>$*{]|\bmy[-_.]|NAME|FOLDER")


def text_of(page: Path) -> str:
    """The page without comments, such as the references of its figures."""
    return re.sub(r"<!--.*?-->", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)


def inline_code(page: Path) -> list[str]:
    without_blocks = re.sub(r"```.*?```", "", text_of(page), flags=re.DOTALL)
    return re.findall(r"`([^`\n]+)`", without_blocks)


def block_lines(page: Path) -> Iterator[str]:
    """The lines of fenced and of indented code, continuations joined, without comments."""
    text = text_of(page)
    blocks = re.findall(r"```(?:bash|sh)?\n(.*?)```", text, re.DOTALL)
    blocks += re.findall(r"(?:^    .*\n?)+", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE)
    for block in blocks:
        for line in re.sub(r"\\\n\s*", "", block).splitlines():
            yield re.sub(r"\s+#.*", "", line).strip()


def commands(word: str) -> list[tuple[Path, str, bool]]:
    """(page, command, whether it is whole) of every command of the pages that begins with ``word``."""
    result = []
    for page in PAGES:
        result += [(page, code, False) for code in inline_code(page) if code.split()[:1] == [word]]
        result += [(page, line, True) for line in block_lines(page) if line.split()[:1] == [word]]
    assert result, word
    return result


def subcommand(words: list[str]) -> tuple[click.Command, list[str]]:
    """The command that the words begin with, and the words after it."""
    command: click.Command = cli.program
    while isinstance(command, click.Group):
        if not words or words[0] not in command.commands:
            assert words[:1] == [] or words[0].startswith("-") or PLACEHOLDER.search(words[0]), words
            break
        command, words = command.get_command(click.Context(command), words[0]), words[1:]
    return command, words


def options(command: click.Command) -> set[str]:
    # a command keeps the options for help of the first context
    context = click.Context(command, **cli.program.context_settings)
    names = {name for each in command.get_params(context) for name in each.opts + each.secondary_opts}
    if isinstance(command, click.Group):
        parts = [command.get_command(click.Context(command), name) for name in command.commands]
        names.update(*map(options, parts))
    return names


def test_every_command_of_p2wss_parses():
    for page, command, is_whole in commands("p2wss"):
        inner, words = subcommand(shlex.split(command)[1:])
        for word in words:
            if word.startswith("--") and len(word) > 2:
                assert word.partition("=")[0] in options(inner), f"{page.name}: {command}"
        if is_whole and not RECIPES.search(command) and not any(word in (".", "..", "...") for word in words):
            try:
                inner.make_context("p2wss", words)
            except (click.exceptions.Exit, click.exceptions.NoArgsIsHelpError):  # --help
                pass
            except click.UsageError as error:
                pytest.fail(f"{page.name}: {command}: {error.format_message()}")


def test_every_option_named_alone_exists():
    existing = options(cli.program) | SNAKEMAKE_VALUES | SNAKEMAKE_FLAGS
    for path in ROOT.glob("benchmarks/*.py"):
        existing |= set(re.findall(r'"(--[\w-]+)"', path.read_text()))
    for page in PAGES:
        for code in inline_code(page):
            if code.startswith("--"):
                assert code.split()[0].partition("=")[0] in existing, f"{page.name}: {code}"


def test_every_target_and_setting_of_snakemake_commands_exists():
    for page, command, _ in commands("snakemake"):
        if "$" in command or RECIPES.search(command):
            continue
        words, kind = shlex.split(command)[1:], ""
        while words:
            word, where = words.pop(0), f"{page.name}: {command}"
            if word in ("--config", "--configfile"):
                kind = word
            elif word in SNAKEMAKE_VALUES:
                value = words.pop(0) if words else ""
                assert word != "-R" or value in RULES, where
                assert word != "--profile" or (ROOT / value / "config.yaml").is_file(), where
            elif word in SNAKEMAKE_FLAGS or re.fullmatch(r"-c\d+", word) or PLACEHOLDER.search(word[:1]):
                kind = ""
            elif kind == "--config" and "=" in word:
                section, _, value = word.partition("=")
                load({section: yaml.safe_load(value)})
            elif kind == "--configfile" and word.endswith(".yaml"):
                assert PLACEHOLDER.search(word) or (ROOT / word).is_file(), where
            elif word.startswith("results/"):
                assert generic(word) in RULES_TEXT, where
            else:
                assert word in RULES or word in ("...", "<your", "image>", "bucket>/p2wss"), where


def test_contributing_has_every_room():
    table = (ROOT / "CONTRIBUTING.md").read_text()
    for package in (ROOT / "src/p2wss").glob("*/__init__.py"):
        assert f"`{package.parent.name}/`" in table


def test_every_target_of_make_exists():
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page, command, _ in commands("make"):
        assert command == "make" or command.split()[1] in targets, f"{page.name}: {command}"


def generic(path: str) -> str:
    """A file of the results as the rules write it."""
    path = re.sub(r"^results/(<region>|mini)/", "<results>/", path)
    return re.sub(r"<tile>|\d{4}_\d{4}", "{tile}", path)


def test_every_path_exists():
    top = ["src", "tests", "docs", "config", "benchmarks", "workflow", "models", "profiles", "envs"]
    for page in PAGES:
        for code in inline_code(page):
            path = code.removesuffix("*")
            if re.fullmatch(r"[\w/]+\.(py|smk)", code) and not RECIPES.search(code):
                assert (ROOT / code).is_file() or any(str(file).endswith(f"/{code}") for file in SOURCES), (
                    f"{page.name}: {code}"
                )
            if not re.fullmatch(r"[\w./*{}<>-]+", code) or path.split("/")[0] not in top or "/" not in path:
                continue
            if not re.search(r"[<>{]|my-town", code) and not RECIPES.search(code):
                assert list(ROOT.glob(path.rstrip("/"))), f"{page.name}: {code}"
        for link in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
            if not link.startswith("http"):
                file, _, anchor = link.partition("#")
                target = (page.parent / file).resolve() if file else page
                assert target.exists(), f"{page.name}: {link}"
                assert not anchor or anchor in anchors(target), f"{page.name}: {link}"


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives to the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_result_is_written_by_a_rule():
    for page in PAGES:
        for code in inline_code(page):
            if re.match(r"results/(<region>|mini)/.*\.\w+$", code) and "*" not in code:
                assert RECIPES.search(code) or generic(code) in RULES_TEXT, f"{page.name}: {code}"


def test_every_setting_exists():
    for page in PAGES:
        for code in inline_code(page):
            section, dot, rest = code.partition(":")[0].partition(".")
            if dot and section in Config.model_fields and re.fullmatch(r"[\w.]+", rest):
                if rest in ("py", "yaml", "smk", "safetensors", "parquet", "tif"):
                    continue
                model: object = Config.model_fields[section].annotation
                for key in rest.split("."):
                    assert isinstance(model, type) and issubclass(model, BaseModel), f"{page.name}: {code}"
                    assert key in model.model_fields, f"{page.name}: {code}"
                    model = model.model_fields[key].annotation


def test_every_identifier_occurs_in_the_code():
    """Names of rules, columns, functions and settings have an underscore; they must occur somewhere."""
    words = {word for path in SOURCES for word in re.findall(r"\w+", path.read_text())}
    for page in PAGES:
        for code in inline_code(page):
            name = code.partition(":")[0].strip("*")
            if re.fullmatch(r"[A-Za-z]\w*_\w*", name) and not RECIPES.search(name):
                assert name in words or any(word.startswith(name) for word in words), f"{page.name}: {code}"


def test_every_import_of_the_examples_works():
    num_imports = 0
    for page in PAGES:
        for module, names in re.findall(
            r"^\s*from (p2wss[\w.]*) import ([\w, ]+)$", text_of(page), re.MULTILINE
        ):
            for name in names.split(", "):
                imported = importlib.import_module(module)
                if not hasattr(imported, name):
                    importlib.import_module(f"{module}.{name}")
                num_imports += 1
    assert num_imports


def test_pages_show_the_stored_figures():
    results = runpy.run_path(str(ROOT / "benchmarks/results.py"))
    pages = results["pages"]()
    for page, text in pages.items():
        assert page.read_text() == text, f"{page.name}: run python benchmarks/results.py"
    references = yaml.safe_load((ROOT / "docs/results/figures.yaml").read_text())
    assert set(references) == set(results["REFERENCE"].findall("".join(pages.values())))


def test_the_site_loads_no_script_from_a_server() -> None:
    """The search needs a worker, which the theme would load from a server where pages are read from disk."""
    text = (ROOT / "mkdocs.yml").read_text()
    (script,) = yaml.safe_load(text)["extra"]["polyfills"]
    assert "iframe-worker" in script and (ROOT / "docs" / script).stat().st_size > 0


@pytest.mark.parametrize(
    "name", [*p2wss.__all__, "Scene.points", "Scene.write", "Scene.plot", "Scene.explore"]
)
def test_docstrings_name_parameters_results_and_errors(name: str) -> None:
    """As numpydoc has them, which editors read."""
    owner = Scene if name.startswith("Scene.") else p2wss
    call = getattr(owner, name.split(".")[-1])
    if not inspect.isfunction(call):
        return
    text = inspect.getdoc(call) or ""
    sections = dict(re.findall(r"\n\n(\w+)\n-{4,}\n(.*?)(?=\n\n\w+\n-{4,}\n|\Z)", text, re.DOTALL))
    heads = [head.split(" : ")[0] for head in re.findall(r"^\S.*$", sections["Parameters"], re.MULTILINE)]
    named = [each.lstrip("*") for head in heads for each in head.split(", ")]
    assert sorted(named) == sorted(set(inspect.signature(call).parameters) - {"self"})
    assert "Returns" in sections and ("Raises" in sections or name == "Scene.plot")
