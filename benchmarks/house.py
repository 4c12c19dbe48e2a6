"""How large the package is, how its rooms depend on each other, and what must not get worse when it gets smaller.

    python benchmarks/house.py [--measure --data ../shared/data --judge ../shared/tools/evaluate_cityjson.py]

Needs the sources alone; ``--measure`` the data and the judge of ``fit_ablation.py``.

A room is a package or module directly below src/p2wss, or one of benchmarks and workflow. An arrow: a file of one room
imports another, be it for types only. ``--measure`` adds what takes half an hour: the compilation of a first use
(first_use.py) and the accuracy of the default settings (fit_ablation.py). The last line is JSON.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

from figures import Figures

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "p2wss"
FEW_ARGUMENTS = 8
_FIT = "fit/fitting.py"
# means of fit_ablation.py before the package was made smaller: roof CD and points to mesh in metres, triangles
ACCURACY = {
    "delft": (0.2371, 0.1101, 43.7),
    "half A": (0.2367, 0.1166, 43.4),
    "half B": (0.2374, 0.1037, 44.0),
    "blocks": (0.4822, 0.1867, 66.5),
    "bresse": (0.1466, 0.0632, 40.3),
}
MORE = {"roof": 0.002, "p2m": 0.001, "tri": 1.0}

Function = ast.FunctionDef | ast.AsyncFunctionDef


def num_statements(tree: ast.Module) -> int:
    """Statements at all levels, without docstrings.

    >>> num_statements(ast.parse("'''Doc.'''\\nif a:\\n    b = 1\\n"))
    2
    """
    with_docstring = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = sum(
        isinstance(node, with_docstring) and ast.get_docstring(node, clean=False) is not None
        for node in ast.walk(tree)
    )
    return sum(isinstance(node, ast.stmt) for node in ast.walk(tree)) - docstrings


def num_arguments(function: Function) -> int:
    """Named arguments of a function, without ``self`` and ``cls``."""
    arguments = function.args
    names = [a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def num_module_numbers(tree: ast.Module) -> int:
    """Numbers in the assignments at the level of the module."""
    values = [s.value for s in tree.body if isinstance(s, ast.Assign | ast.AnnAssign) and s.value is not None]
    constants = [n.value for v in values for n in ast.walk(v) if isinstance(n, ast.Constant)]
    return sum(isinstance(value, int | float) and not isinstance(value, bool) for value in constants)


def room_of(path: Path) -> str:
    """The room of a file of the package."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_rooms(source: str) -> set[str]:
    """The rooms that a file imports; read from its lines, since rules of Snakemake are not Python.

    >>> sorted(imported_rooms("from p2wss.config import Fit\\nfrom p2wss import errors, fit\\nimport p2wss.nets.crops"))
    ['config', 'errors', 'fit', 'nets']
    """
    rooms = set(re.findall(r"^\s*(?:from|import) p2wss\.(\w+)", source, re.MULTILINE))
    for names in re.findall(r"^\s*from p2wss import (\([^)]*\)|[^\n]*)", source, re.MULTILINE):
        rooms |= {name.split()[0] for name in names.strip("()").split(",") if name.strip()}
    return rooms


def arrows() -> dict[str, set[str]]:
    """The rooms that each room imports."""
    rooms = {room_of(path): set[str]() for path in PACKAGE.rglob("*.py")} | {
        "benchmarks": set(),
        "workflow": set(),
    }
    del rooms["__init__"], rooms["__main__"]
    files = [(room_of(path), path) for path in PACKAGE.rglob("*.py")]
    files += [("benchmarks", path) for path in (ROOT / "benchmarks").rglob("*.py")]
    files += [("workflow", path) for path in (ROOT / "Snakefile", *(ROOT / "workflow").rglob("*.smk"))]
    for room, path in files:
        if room in rooms:
            rooms[room] |= (imported_rooms(path.read_text(encoding="utf-8")) & rooms.keys()) - {room}
    return rooms


def in_circles(rooms: dict[str, set[str]]) -> set[str]:
    """The rooms that can be reached from themselves.

    >>> sorted(in_circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}))
    ['b', 'c']
    """
    reached = {room: set(others) for room, others in rooms.items()}
    for middle in rooms:
        for others in reached.values():
            if middle in others:
                others |= reached[middle]
    return {room for room, others in reached.items() if room in others}


def floors(rooms: dict[str, set[str]]) -> dict[str, int]:
    """The floor of each room in the order that CONTRIBUTING.md states, 0 at the top. benchmarks and workflow are above
    all; rooms that CONTRIBUTING.md does not name count as "the other stages"."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if line.startswith("`cli` >"))
    of_room = {"benchmarks": -1, "workflow": -1}
    stages = 0
    for floor, names in enumerate(line.split(" > ")):
        of_room |= dict.fromkeys(re.findall(r"`(\w+)`", names), floor)
        if "the other stages" in names:
            stages = floor
    return {room: of_room.get(room, stages) for room in rooms}


def upwards(rooms: dict[str, set[str]]) -> list[tuple[str, str]]:
    """The arrows to a higher floor."""
    floor = floors(rooms)
    return [(room, other) for room in rooms for other in rooms[room] if floor[other] < floor[room]]


def stations() -> list[str]:
    """The stations of a building. The stations of the fit are read from the code: the functions of its module that
    ``fit_building`` calls, in order. The other stations are rows of the table in the overview; a test of the
    documentation finds their functions in the code."""
    page = (ROOT / "docs/methods/overview.md").read_text(encoding="utf-8")
    rows = page.split("## ")[0].split("|---|---|---|\n")[1].strip().splitlines()
    cells = [row.split("|") for row in rows if row.startswith("|")]
    module = ast.parse((PACKAGE / _FIT).read_text(encoding="utf-8"))
    functions = {each.name: each for each in module.body if isinstance(each, ast.FunctionDef)}
    body = functions["fit_building"].body
    calls = [node for step in body for node in ast.walk(step) if isinstance(node, ast.Call)]
    calls.sort(key=lambda call: (call.lineno, call.col_offset))
    names = [call.func.id for call in calls if isinstance(call.func, ast.Name)]
    of_fit = [name for name in names if name in functions and not name.startswith("_")]
    before = [cell[1].strip() for cell in cells if _FIT not in cell[3]]
    place = next(number for number, cell in enumerate(cells) if _FIT in cell[3])
    return [*before[:place], *of_fit, *before[place:]]


def count(figures: Figures) -> None:
    """Add what can be read from the source."""
    statements: Counter[str] = Counter()
    functions: list[tuple[int, str, str]] = []
    numbers = 0
    for path in sorted(PACKAGE.rglob("*.py")):
        tree, room = ast.parse(path.read_text(encoding="utf-8")), room_of(path)
        statements[room] += num_statements(tree)
        if room in ("fit", "reconstruction"):
            numbers += num_module_numbers(tree)
        where = str(path.relative_to(PACKAGE))
        functions += [(num_arguments(n), where, n.name) for n in ast.walk(tree) if isinstance(n, Function)]
    functions = sorted((f for f in functions if f[0] >= FEW_ARGUMENTS), reverse=True)
    rooms = arrows()
    print(f"{'room':<14}{'floor':>5}{'statements':>12}  imports")
    for room, floor in sorted(floors(rooms).items(), key=lambda pair: (pair[1], pair[0])):
        print(f"{room:<14}{floor:>5}{statements[room]:>12}  {' '.join(sorted(rooms[room]))}")
    print(f"\nfunctions with {FEW_ARGUMENTS} arguments or more:")
    for number, where, name in functions:
        print(f"{number:>4}  {where}: {name}")
    up, circular = upwards(rooms), in_circles(rooms)
    print("upwards: " + (", ".join(" > ".join(arrow) for arrow in up) or "none"))
    print("in circles: " + (", ".join(sorted(circular)) or "none"))
    figures.row("statements by room", statements)
    figures.at_most("statements", statements.total(), 21_000)
    figures.at_most(f"functions with {FEW_ARGUMENTS} arguments or more", len(functions), 20)
    figures.at_most("longest list of arguments", functions[0][0] if functions else 0, 10)
    figures.at_most("numbers at module level in fit and reconstruction", numbers, 200)
    figures.at_most("rooms", len(rooms), 26)
    figures.at_most("arrows", sum(map(len, rooms.values())), 100)
    figures.at_most("rooms in circles", len(circular), 0)
    figures.at_most("arrows upwards", len(up), 0)
    steps = stations()
    print("stations: " + ", ".join(steps))
    figures.at_most("stations of a building", len(steps), 16)


def last_line(*command: object) -> dict[str, dict[str, float]]:
    """The figures that another benchmark prints in its last line."""
    words = [sys.executable, *map(str, command)]
    # the exit status tells whether the bars of that benchmark are met
    process = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False)
    figures: dict[str, dict[str, float]] = json.loads(process.stdout.splitlines()[-1])
    return figures


def measure(figures: Figures, data: Path, judge: Path) -> None:
    """Add what must be run."""
    benchmarks = ROOT / "benchmarks"
    first_use = last_line(benchmarks / "first_use.py")
    figures.at_most("first use compiles, CPU s", first_use["compilation, CPU s"]["value"], 60)
    options = ("--data", data, "--judge", judge, "--variant", "default")
    ablation = last_line(benchmarks / "fit_ablation.py", *options)
    for group, before in ACCURACY.items():
        for (name, more), value in zip(MORE.items(), before, strict=True):
            figures.at_most(f"{group}, {name}", ablation[f"default, {group}"][name], value + more)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--measure", action="store_true", help="compilation and accuracy, too")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--judge", type=Path, default=ROOT.parent / "shared/tools/evaluate_cityjson.py")
    options = parser.parse_args()
    figures = Figures()
    count(figures)
    if options.measure:
        measure(figures, options.data, options.judge)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
