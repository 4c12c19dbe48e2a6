"""The figures in the documentation: stored as JSON in ``docs/results``, shown in Markdown, checked by a unit test.

    python benchmarks/results.py                                   # show the stored figures in every page
    python benchmarks/results.py --check                           # status 1 if a page shows other figures
    python benchmarks/results.py --age                             # which were measured with other code than today's
    python benchmarks/results.py --record lidar --code scans crops -- python benchmarks/lidar.py
    python benchmarks/results.py --record miniature --code eval --csv results/mini/eval/table1.csv -- make eval_report

``--record NAME`` runs the command and writes ``docs/results/NAME.json``: the command, the machine, the version, the
fingerprint of the code that was measured, and as ``figures`` the last line of the output, which every benchmark
prints as JSON, or with ``--csv`` the rows of a table.

A block of Markdown between ``<!-- figures`` and ``<!-- end of figures -->`` begins with a template in the comment;
what follows is that template with every ``{NAME > key > key|format}`` replaced from ``docs/results/NAME.json``.
Several last keys, ``{NAME > key > key; key; key|format}``, give cells of a row. A key that a file lacks is an error.
Of a figure beside a bar, ``{"value": .., "bar": ..}``, the value is shown.
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
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs/results"
BLOCK = re.compile(r"<!-- figures\n(.*?)\n-->\n(.*?)\n<!-- end of figures -->", re.DOTALL)
FIELD = re.compile(r"\{([^{}|]+)(?:\|([^{}]*))?\}")


def pages() -> list[Path]:
    """Every Markdown page that may show figures."""
    return [ROOT / "README.md", ROOT / "models/README.md", *sorted(ROOT.glob("docs/**/*.md"))]


def rendered(text: str, files: dict[str, Any]) -> str:
    """A page with all its blocks filled in.

    >>> page = "<!-- figures\\nIt takes {speed > cast|.1f} s.\\n-->\\n?\\n<!-- end of figures -->"
    >>> print(rendered(page, {"speed": {"figures": {"cast": {"value": 2.34, "bar": 3}}}}).splitlines()[3])
    It takes 2.3 s.
    """

    def block(match: re.Match[str]) -> str:
        template = match[1]
        filled = FIELD.sub(lambda field: shown(field[1], field[2] or "", files), template)
        return f"<!-- figures\n{template}\n-->\n{filled}\n<!-- end of figures -->"

    return BLOCK.sub(block, text)


def shown(path: str, layout: str, files: dict[str, Any]) -> str:
    """One figure as text, or several as cells. Raises ``KeyError`` with the whole path if one is not stored."""
    name, *keys = path.split(" > ")
    cells = []
    for last in keys.pop().split("; "):
        try:
            value: Any = files[name]
            for key in [last] if last in ("command", "machine") else ["figures", *keys, last]:
                value = value[int(key)] if isinstance(value, list) else value[key]
        except (KeyError, TypeError, IndexError, ValueError) as error:
            raise KeyError(f"docs/results has no figure {path}") from error
        cells.append(format(value["value"] if isinstance(value, dict) else value, layout))
    return " | ".join(cells)


def stored() -> dict[str, Any]:
    """The files of ``docs/results`` by name."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(FOLDER.glob("*.json"))}


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
    from p2wss.provenance import fingerprint

    # the exit status of a benchmark tells whether its bars are met: figures that miss them are stored too
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    print(done.stdout)
    if table is not None and done.returncode:
        sys.exit(done.returncode)
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
    """Print which figures were measured with the code as it is."""
    from p2wss.provenance import fingerprint

    for name, document in stored().items():
        if document["code"] is None:
            state = "code unknown"
        else:
            state = "current" if document["code"] == fingerprint(*document["modules"]) else "OLDER CODE"
        print(f"{name:<20} {state:<14} {document['command']}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--check", action="store_true", help="write nothing; status 1 if a page is out of date"
    )
    parser.add_argument(
        "--age", action="store_true", help="list the stored figures and whether code has changed"
    )
    parser.add_argument("--record", metavar="NAME", help="run COMMAND and store its figures under this name")
    parser.add_argument("--code", nargs="*", default=[], help="with --record: the modules that are measured")
    parser.add_argument("--csv", type=Path, help="with --record: a table that the command writes")
    arguments, command = parser.parse_known_args()
    if arguments.age:
        age()
        return 0
    if arguments.record:
        record(arguments.record, arguments.code, arguments.csv, command[command[:1] == ["--"] :])
    files, outdated = stored(), []
    for path in pages():
        text = path.read_text()
        new = rendered(text, files)
        if new != text:
            outdated.append(str(path.relative_to(ROOT)))
            if not arguments.check:
                path.write_text(new)
    if outdated:
        print(("out of date: " if arguments.check else "rewritten: ") + ", ".join(outdated))
    return 1 if arguments.check and outdated else 0


if __name__ == "__main__":
    sys.exit(main())
