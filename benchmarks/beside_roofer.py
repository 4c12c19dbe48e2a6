"""``p2wss reconstruct`` and Roofer on the same data, one after the other, on this machine; the last line is JSON.

    python benchmarks/beside_roofer.py --data ../shared/data [--places delft dallas] [--repeats 3]

Needs the data, which are not part of the project, and for the comparison Roofer (https://github.com/3DBAG/roofer) as
``roofer`` on the PATH: without Roofer its columns are empty, and bars that compare are not checked. A place whose
folder is absent is skipped. For *blocks*, touching footprints are merged, as in maps of old cities.

Both are whole commands with default outputs, Roofer with LoD2.2 alone. They run in turn, so that other work on the
machine slows both. The run with the least CPU time counts for each program; compilation, if needed, is in the first.
CPU time is user and system time of all processes of a command, peak memory is the peak of its largest process. Nothing
is scaled by the speed of the machine. The *start* is what ``p2wss reconstruct`` takes for one drawn house of 80 m² with
5 points per m² (imports, compiled functions, the files of a run), in turn with the two programs. *times* is the CPU
time of p2wss without the start, divided by the whole CPU time of Roofer. Triangles: polygons are divided without
further vertices. A run that takes longer than ``--limit`` is stopped, and misses its bars.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from figures import Figures, Run, run


class Place(NamedTuple):
    """Data of a folder. id_column: of the footprints. roofer: further options of Roofer. is_merged: whether footprints
    that touch are merged."""

    folder: str
    clouds: tuple[str, ...] = ("cloud.laz",)
    id_column: str = "id"
    roofer: tuple[str, ...] = ()
    is_merged: bool = False


CROPS = ("77050_627755_LA93_IGN69.laz", "77050_627760_LA93_IGN69.laz", "77055_627755_LA93_IGN69.laz")
PLACES = {
    "delft": Place("delft_ahn3", ("ahn3.laz",), "building_id"),
    "dallas": Place("dallas"),
    "adelaide": Place("adelaide"),
    # its points have no classes
    "toronto": Place("toronto", roofer=("--bld-class", "1")),
    "house": Place("house"),
    "bresse": Place("bresse_ign", ("lidar.laz",), "building_id"),
    "lidar hd": Place("lidarhd_crops", CROPS, "building_id"),
    "nyc": Place("nyc_roofn3d"),
    "trondheim": Place("trondheim"),
    "blocks of delft": Place("delft_ahn3", ("ahn3.laz",), is_merged=True),
    # the border of the data cuts them
    "blocks of amsterdam": Place("amsterdam_ahn", ("ahn_2386_9702.laz", "ahn_2397_9705.laz"), is_merged=True),
}
# bars: CPU time of p2wss without the start, divided by the CPU time of Roofer
MOST_TIMES = {"delft": 1.2, "dallas": 3.0, "adelaide": 3.0, "house": 3.0, "toronto": 6.0}
MOST_TIMES |= dict.fromkeys(("blocks of delft", "blocks of amsterdam"), 1.5)
MOST_MIB = dict.fromkeys(("dallas", "adelaide", "house", "toronto"), 300.0)
# in a process of its own: peaks of small programs would include the memory that this process has used
DRAW = """
import sys
import geopandas, laspy, numpy, shapely
rng = numpy.random.default_rng(0)
x, y = rng.uniform((0, 0), (10, 8), (400, 2)).T
las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
las.header.scales = [1e-3] * 3
las.x, las.y, las.z = x, y, 5 + 0.7 * numpy.minimum(y, 8 - y) + rng.normal(0, 0.03, 400)
las.classification[:] = 6
las.write(sys.argv[1] + "/cloud.laz")
house = geopandas.GeoDataFrame({"id": ["a"]}, geometry=[shapely.box(0, 0, 10, 8)], crs="EPSG:28992")
house.to_file(sys.argv[1] + "/footprints.gpkg")
"""
MERGE = """
import sys
import geopandas, shapely
footprints = geopandas.read_file(sys.argv[1])
# gaps of less than 30 cm are party walls
wide = shapely.union_all(footprints.buffer(0.15, join_style="mitre"))
blocks = shapely.get_parts(shapely.buffer(wide, -0.15, join_style="mitre"))
blocks = blocks[shapely.area(blocks) > 40]
ids = [str(number) for number in range(len(blocks))]
geopandas.GeoDataFrame({"id": ids}, geometry=blocks, crs=footprints.crs).to_file(sys.argv[2])
"""
OF_PROGRAM = {"solids": "d", "triangles": ",d", "CPU s": ".2f", "MiB": ".0f"}
# columns of the table: figures and how they are shown
COLUMNS = {
    **{f"{program} {name}": layout for program in ("p2wss", "roofer") for name, layout in OF_PROGRAM.items()},
    "start CPU s": ".2f",
    "times": ".2f",
    "times with the start": ".2f",
}
P2WSS = (sys.executable, "-m", "p2wss.cli", "reconstruct")


def commands(place: Place, data: Path, out: Path) -> dict[str, list[object]]:
    """The command of each program for a place. Results go to the folders p2wss and roofer in ``out``."""
    folder = data / place.folder
    footprints = folder / "footprints.gpkg"
    if place.is_merged:
        out.mkdir(parents=True)
        run([sys.executable, "-c", MERGE, footprints, out / "blocks.gpkg"])
        footprints = out / "blocks.gpkg"
    inputs = [*(folder / cloud for cloud in place.clouds), footprints]
    result: dict[str, list[object]] = {"p2wss": [*P2WSS, *inputs, out / "p2wss", "--quiet"]}
    if shutil.which("roofer"):
        options = ["-j", str(os.cpu_count()), "--id-attribute", place.id_column, "--lod22", *place.roofer]
        result["roofer"] = ["roofer", *options, *inputs, out / "roofer"]
    return result


def num_triangles(boundaries: Sequence[Any]) -> int:
    """Triangles of the polygons of a solid in CityJSON, each a list of rings.

    >>> num_triangles([[[[0, 1, 2, 3]], [[0, 1, 2, 3], [4, 5, 6]]]])
    9
    """
    polygons = [polygon for shell in boundaries for polygon in shell]
    return sum(sum(map(len, rings)) + 2 * (len(rings) - 1) - 2 for rings in polygons)


def written(folder: Path) -> tuple[int, int]:
    """(buildings with a solid, triangles) of the CityJSONSeq files in a folder."""
    ids, triangles = set(), 0
    for path in folder.rglob("*.city.jsonl"):
        with path.open(encoding="utf-8") as file:
            for line in file:
                feature = json.loads(line)
                for part in feature["CityObjects"].values():
                    for geometry in part.get("geometry", []):
                        if geometry["type"] == "Solid":
                            ids.add(feature["id"])
                            triangles += num_triangles(geometry["boundaries"])
    return len(ids), triangles


def in_turn(each: dict[str, list[object]], repeats: int, limit_s: float) -> dict[str, Run | None]:
    """The run with the least CPU time of each program; None for a program that takes too long."""
    best: dict[str, Run | None] = {}
    for _ in range(repeats):
        for name, command in each.items():
            if name in best and best[name] is None:
                continue
            try:
                done = run(command, limit_s)
            except TimeoutError as error:
                print(error)
                best[name] = None
                continue
            before = best.get(name)
            best[name] = done if before is None else min(before, done)
    return best


def line(title: str, row: dict[str, float | None]) -> str:
    """A row of the table; nothing where a figure is missing."""
    cells = ["" if row.get(name) is None else format(row[name], layout) for name, layout in COLUMNS.items()]
    return f"{title:<20}" + "".join(
        f"{text:>{len(name) + 2}}" for name, text in zip(COLUMNS, cells, strict=True)
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with the folders of the places")
    parser.add_argument("--places", nargs="+", choices=PLACES, default=list(PLACES))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--limit", type=float, default=300.0, help="seconds after which a run is stopped")
    arguments = parser.parse_args()
    figures = Figures()
    has_roofer = shutil.which("roofer") is not None
    if has_roofer:
        version = subprocess.run(
            ["roofer", "--version"],
            capture_output=True,
            text=True,
            cwd=tempfile.gettempdir(),  # it writes a log
        ).stdout.strip()
        print(f"Roofer: {version}; load of the machine before: {os.getloadavg()[0]:.1f}")
    else:
        print("roofer is not on the PATH: nothing to compare with, its columns stay empty")
    data = arguments.data.resolve()
    # Roofer leaves a log where it is started
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        folder = Path(name)
        run([sys.executable, "-c", DRAW, folder])
        start = [*P2WSS, folder / "cloud.laz", folder / "footprints.gpkg", folder / "start", "--quiet"]
        print(f"{'':<20}" + "".join(f"  {name}" for name in COLUMNS))
        for title in arguments.places:
            place, out = PLACES[title], folder / title
            if not (data / place.folder).is_dir():
                print(f"{title:<20}skipped: no folder {place.folder}")
                continue
            row = measure({"start": start} | commands(place, data, out), arguments, out)
            figures.row(title, row)
            print(line(title, row), flush=True)
            check(title, row, figures, has_roofer)
    return figures.end()


def measure(
    each: dict[str, list[object]], arguments: argparse.Namespace, out: Path
) -> dict[str, float | None]:
    """What the programs needed for a place, and what they made."""
    runs = in_turn(each, arguments.repeats, arguments.limit)
    row: dict[str, float | None] = {f"{name} CPU s": best and best.cpu_s for name, best in runs.items()}
    for program in (name for name in runs if name != "start"):
        best = runs[program]
        solids, triangles = written(out / program) if best else (None, None)
        row |= {f"{program} solids": solids, f"{program} triangles": triangles}
        row[f"{program} MiB"] = best and best.peak_mib
    start_s, ours_s, roofers_s = (row.get(f"{name} CPU s") for name in ("start", "p2wss", "roofer"))
    if start_s and ours_s:
        row["less the start"] = ours_s - start_s
    if start_s and ours_s and roofers_s:
        row |= {"times": (ours_s - start_s) / roofers_s, "times with the start": ours_s / roofers_s}
    shutil.rmtree(out, ignore_errors=True)
    return row


def check(title: str, row: dict[str, float | None], figures: Figures, has_roofer: bool) -> None:
    """Add the bars of a place; a run that was not done in time misses them."""
    is_done = row["p2wss CPU s"] is not None

    def at_most(name: str, value: float | None, bar: float) -> None:
        figures.at_most(f"{title}, {name}", value if is_done else float("inf"), bar)

    if title in MOST_TIMES and has_roofer:
        at_most("CPU less the start, times Roofer's", row.get("times"), MOST_TIMES[title])
    if title in MOST_MIB:
        at_most("peak, MiB", row["p2wss MiB"], MOST_MIB[title])


if __name__ == "__main__":
    sys.exit(main())
