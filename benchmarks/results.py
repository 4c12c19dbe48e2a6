"""The figures in the documentation: stored as JSON in ``docs/results``, shown in Markdown, checked by a unit test.

    python benchmarks/results.py                                   # show the stored figures in every page
    python benchmarks/results.py --age                             # which were measured with other code than today's
    python benchmarks/results.py --record lidar --code scans crops -- python benchmarks/lidar.py
    python benchmarks/results.py --record miniature --code eval --csv results/mini/eval/table1.csv -- make eval_report

Needs what the command needs that it records.

``--record NAME`` runs the command and writes ``docs/results/NAME.json``: the command, the machine, the version, the
fingerprint of the code that was measured, and as ``figures`` the last line of the output, which every benchmark
prints as JSON, or with ``--csv`` the rows of a table.

Pages of results are made from ``docs/results/templates``, where ``{NAME[key][key]:format}`` stands for a figure of
``docs/results/NAME.json``, as in ``str.format``, and ``{NAME[key]:key .2f | key .0f}`` for a row of figures. In other
pages, written by hand, a figure may be followed by ``<!--short_name-->``, a line of ``docs/results/figures.yaml``.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs/results"
KEY = re.compile(r"(\w+)(?: ([.,\d]*[f%]))?")
REFERENCE = re.compile(r"<!--(\w+)-->")
NUMBER = r"\d[\d.,]*"


class Figures(dict[str, Any]):
    """Figures by their keys. Several figures can be shown at once; a figure with a bar is shown by its value.

    >>> "{:roof .2f, tri .0f}".format(Figures(roof=0.237, tri=Figures(value=43.6, bar=40)))
    '0.24, 44'
    """

    def __missing__(self, key: str) -> Any:
        raise KeyError(f"docs/results has no figure {key!r} among {list(self)}")

    def __format__(self, layout: str) -> str:
        if "value" in self:
            return format(self["value"], layout)
        return KEY.sub(lambda match: format(self[match[1]], match[2] or ""), layout)


def stored() -> dict[str, Any]:
    """The files of ``docs/results`` by name."""
    files = sorted(FOLDER.glob("*.json"))
    return {file.stem: json.loads(file.read_text(), object_hook=Figures) for file in files}


def pages() -> dict[Path, str]:
    """The text that every page with figures should have."""
    files = {name: {**document, **document["figures"]} for name, document in stored().items()}
    result = {}
    for template in sorted(FOLDER.glob("templates/*.md")):
        note = f"<!-- Made by benchmarks/results.py: edit templates/{template.name} instead. -->\n"
        result[FOLDER / template.name] = note + template.read_text().format_map(files)
    references = yaml.safe_load((FOLDER / "figures.yaml").read_text())
    shown = {name: layout.format_map(files) for name, layout in references.items()}
    for page in [ROOT / "README.md", *ROOT.glob("models/*.md"), *sorted(ROOT.glob("docs/**/*.md"))]:
        if page not in result and page.parent.name != "templates":
            result[page] = mended(page.read_text(), shown)
    return result


def mended(text: str, shown: dict[str, str]) -> str:
    """A page with the digits before each reference replaced.

    >>> mended("It takes 1.9<!--cast--> s in 3<!--of--> of 4 runs.", {"cast": "12.3", "of": "2"})
    'It takes 12.3<!--cast--> s in 2<!--of--> of 4 runs.'
    """
    for name in set(REFERENCE.findall(text)):
        reference = f"<!--{name}-->"
        any_digits = NUMBER.join(map(re.escape, re.split(NUMBER, shown[name]))) + reference
        text, count = re.subn(any_digits, shown[name] + reference, text)
        if count != text.count(reference):
            raise ValueError(f"not behind a figure like {shown[name]}: {reference}")
    return text


def from_csv(path: Path) -> dict[str, dict[str, float | str | None]]:
    """A table of the report: its rows by their first cell, their cells by the title of the column."""

    def number(cell: str) -> float | str | None:
        try:
            return float(cell)
        except ValueError:
            return cell or None

    with path.open(encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    return {row[0]: dict(zip(header[1:], map(number, row[1:]), strict=True)) for row in rows}


def record(name: str, modules: list[str], table: Path | None, command: list[str]) -> None:
    """Run a command and store its figures."""
    from p2wss import __version__
    from p2wss.storage.provenance import fingerprint

    # the exit status of a benchmark tells whether its bars are met: figures that miss them are stored too
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=table is not None)
    print(done.stdout)
    document = {
        "command": shlex.join(command),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "version": __version__,
        "modules": modules,
        "code": fingerprint(*modules) if modules else None,
        "figures": json.loads(done.stdout.splitlines()[-1]) if table is None else from_csv(ROOT / table),
    }
    (FOLDER / f"{name}.json").write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n")


def age() -> None:
    """Print which figures were measured with the present code."""
    from p2wss.storage.provenance import fingerprint

    for name, document in stored().items():
        if document["code"] is None:
            state = "code unknown"
        else:
            state = "current" if document["code"] == fingerprint(*document["modules"]) else "OLDER CODE"
        print(f"{name:<20} {state:<14} {document['command']}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--age", action="store_true", help="list the stored figures and whether code has changed"
    )
    parser.add_argument("--record", metavar="NAME", help="run COMMAND and store its figures under this name")
    parser.add_argument("--code", nargs="*", default=[], help="with --record: the modules that are measured")
    parser.add_argument("--csv", type=Path, help="with --record: a table that the command writes")
    arguments, command = parser.parse_known_args()
    if arguments.age:
        age()
        return
    if arguments.record:
        record(arguments.record, arguments.code, arguments.csv, command[command[:1] == ["--"] :])
    for page, text in pages().items():
        if not page.is_file() or page.read_text() != text:
            page.write_text(text)
            print(f"rewritten: {page.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
