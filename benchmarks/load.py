"""Memory and time of ``p2wss reconstruct`` on a large area: 7,844 buildings and 20.1 million points.

    python benchmarks/load.py --data ../shared/data                  # 106 copies, 10 CPU-minutes
    python benchmarks/load.py --data ../shared/data --copies 16      # 1,184 buildings

Needs ``delft_ahn3``, which is not part of the project.

The area is the cloud of Delft (AHN3) and its 74 footprints, repeated on a grid, one LAZ file per row of the grid. Each
run of the command is a process of its own: 1 copy, 4 copies, one tile of the large area with ``--tile``, again 1 and 4
copies, and all copies. Measured are the peak memory of the process and its children, and the CPU time per building: for
the whole process, and without the CPU time of the run of one copy (start of the program, network).

Whether a building is the same in every copy: coordinates are multiples of 2**-10 m and copies are moved by whole
metres, so that the movement is exact in binary numbers. Each copy of a building must then have the same attributes and
faces, and the same coordinates once they are moved back. The tile must have the same buildings as the whole run.
The last line is JSON.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import shapely
from figures import Figures

from p2wss.data.tiling import tiles_of_points
from p2wss.mesh.repair import SCALE_M as CITYJSON_SCALE_M

NUM_COPIES, NUM_SMALL = 106, 4
# a multiple of 8 m, the side of the squares whose lowest points are the ground where no ground is seen
SPACING_M = 320
SCALE_M = 2.0**-10
MAX_MB, MAX_RATIO = 2000.0, 1.2
# getrusage does not tell the memory: its figure starts with the memory of the parent
WRAPPER = """
import os, sys
from p2wss import cli
status = cli.main(sys.argv[2:])
lines = open("/proc/self/status").read().splitlines()
peak = next(line.split()[1] for line in lines if line.startswith("VmHWM"))
open(sys.argv[1], "w").write(f"{peak} {sum(os.times()[:4])}")
sys.exit(status)
"""


@dataclass(frozen=True)
class Run:
    """What a run of the command took, and what it wrote: the buildings of its CityJSONSeq by their ids."""

    peak_mb: float
    cpu_s: float
    num_bytes: int
    buildings: dict[str, Any]


def moves_m(num_copies: int) -> list[tuple[int, int]]:
    """The movement of each copy, metres, on a grid that is about square."""
    width = math.ceil(math.sqrt(num_copies))
    return [(SPACING_M * (i % width), SPACING_M * (i // width)) for i in range(num_copies)]


def write_area(place: Path, num_copies: int, folder: Path) -> tuple[gpd.GeoDataFrame, int]:
    """Write clouds and footprints; returns the footprints and the number of points."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "clouds").mkdir(parents=True)
    source, frame = laspy.read(place / "ahn3.laz"), gpd.read_file(place / "footprints.gpkg")
    frame.geometry = shapely.transform(frame.geometry.to_numpy(), lambda xy: np.round(xy / SCALE_M) * SCALE_M)
    xyz = np.column_stack([np.round(np.asarray(axis) / SCALE_M) for axis in (source.x, source.y, source.z)])
    moves = moves_m(num_copies)
    header = laspy.LasHeader(point_format=source.header.point_format, version=source.header.version)
    header.scales, header.offsets = [SCALE_M] * 3, [0.0] * 3
    for north_m in sorted({north_m for _, north_m in moves}):
        with laspy.open(folder / "clouds" / f"{north_m:05d}.laz", "w", header=header) as writer:
            for move in moves:
                if move[1] != north_m:
                    continue
                record = laspy.ScaleAwarePointRecord.zeros(len(source), header=header)
                for name in source.point_format.dimension_names:
                    if name not in "XYZ":
                        record[name] = source[name]
                record.X, record.Y, record.Z = (xyz + np.array([*move, 0]) / SCALE_M).T.astype(np.int32)
                writer.write_points(record)
    copies = []
    for number, move in enumerate(moves):
        names = [f"{number:04d}-{name}" for name in frame["building_id"]]
        copies.append(frame.set_geometry(frame.translate(*move)).assign(building_id=names))
    footprints = pd.concat(copies, ignore_index=True)
    footprints.to_file(folder / "footprints.gpkg")
    return footprints, len(source) * num_copies


def reconstruct(area: Path, name: str, *options: str) -> Run:
    """One run of the command on the area in a folder, with default formats. Its outputs and figures go to ``name``
    beside that folder. A run that has been made before is not repeated."""
    folder = area.parent / name
    out, done = folder / "out", folder / "done"
    if not done.exists():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        inputs = [area / "clouds", area / "footprints.gpkg", out, "--crs", "EPSG:28992"]
        command = [sys.executable, "-c", WRAPPER, folder / "peak", "reconstruct", *inputs, *options]
        with (folder / "log").open("w", encoding="utf-8") as log:
            process = subprocess.Popen(list(map(str, command)), stderr=log)
            tree_kb = 0.0
            while process.poll() is None:
                tree_kb = max(tree_kb, sum(map(rss_kb, tree(process.pid))))
                time.sleep(0.1)
        if process.returncode:
            raise SystemExit((folder / "log").read_text(encoding="utf-8"))
        done.write_text(f"{tree_kb} {(folder / 'peak').read_text(encoding='utf-8')}", encoding="utf-8")
    tree_kb, process_kb, cpu_s = map(float, done.read_text(encoding="utf-8").split())
    (sequence,) = out.glob("*.city.jsonl")
    run = Run(max(tree_kb, process_kb) * 1024 / 1e6, cpu_s, sequence.stat().st_size, buildings(sequence))
    rate_ms = 1000 * run.cpu_s / len(run.buildings)
    print(
        f"{name}: {len(run.buildings)} buildings, {run.peak_mb:.0f} MB, {rate_ms:.1f} CPU-ms each", flush=True
    )
    return run


def tree(process: int) -> list[int]:
    """A process and all its children."""
    result = [process]
    for thread in Path(f"/proc/{process}/task").glob("*/children"):
        try:
            for child in thread.read_text(encoding="ascii").split():
                result += tree(int(child))
        except OSError:  # it has ended
            continue
    return result


def rss_kb(process: int) -> int:
    """Resident memory."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


def buildings(sequence: Path) -> dict[str, Any]:
    """The written content of each building: its attributes, faces, and the vertices in whole units of the file's
    scale."""
    with sequence.open(encoding="utf-8") as file:
        transform = json.loads(next(file))["transform"]
        origin = np.round(np.divide(transform["translate"], transform["scale"])).astype(np.int64)
        result = {}
        for line in file:
            feature = json.loads(line)
            vertex = np.array(feature["vertices"], np.int64).reshape(-1, 3) + origin
            result[feature["id"]] = (feature["CityObjects"][feature["id"]], vertex)
    return result


def num_different(written: dict[str, Any], num_copies: int) -> int:
    """The number of buildings that differ from the moved building of the first copy."""
    count = 0
    for number, move in enumerate(moves_m(num_copies)):
        moved = np.round(np.array([*move, 0]) / CITYJSON_SCALE_M).astype(np.int64)
        for name in (name for name in written if name.startswith("0000-")):
            first, copy = written[name], written[f"{number:04d}-{name[5:]}"]
            count += first[0] != copy[0] or not np.array_equal(first[1] + moved, copy[1])
    return count


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with delft_ahn3")
    parser.add_argument("--copies", type=int, default=NUM_COPIES)
    parser.add_argument(
        "--folder", type=Path, help="keep areas and runs there, and continue from those that it has"
    )
    arguments = parser.parse_args()
    figures, place = Figures(), arguments.data / "delft_ahn3"
    with tempfile.TemporaryDirectory() as name:
        folder = arguments.folder or Path(name)
        sizes = {"one": 1, "small": NUM_SMALL, "large": arguments.copies}
        areas = {size: write_area(place, count, folder / size) for size, count in sizes.items()}
        before = [reconstruct(folder / size, f"{size}_before") for size in ("one", "small")]
        centre = areas["large"][0].centroid
        tiles = Counter(tiles_of_points(centre.x, centre.y, 1000))
        ((fullest, _),) = tiles.most_common(1)
        tile = reconstruct(folder / "large", f"tile_{fullest}", "--tile", fullest)
        after = [reconstruct(folder / size, f"{size}_after") for size in ("one", "small")]
        large = reconstruct(folder / "large", f"large_{arguments.copies}")
    one_s, small_s = ((first.cpu_s + second.cpu_s) / 2 for first, second in zip(before, after, strict=True))
    num_one, num_small, num_large = (len(frame) for frame, _ in areas.values())
    small_ms = 1000 * (small_s - one_s) / (num_small - num_one)
    large_ms = 1000 * (large.cpu_s - one_s) / (num_large - num_one)
    tile_ms = 1000 * (tile.cpu_s - one_s) / (len(tile.buildings) - num_one)
    figures.row(
        "area",
        {
            "buildings": num_large,
            "points": areas["large"][1],
            "tiles": len(tiles),
            "of_tile": len(tile.buildings),
        },
    )
    figures.row("cpu_ms_per_building", {"small": small_ms, "large": large_ms, "tile": tile_ms})
    figures.row("peak_mb", {"one": before[0].peak_mb, "small": before[1].peak_mb})
    figures.row(
        "bytes_per_building", {"small": before[1].num_bytes / num_small, "large": large.num_bytes / num_large}
    )
    growth_mb = (large.peak_mb - before[1].peak_mb) / (num_large - num_small) * 1000
    figures.row("growth", {"mb_per_1000_buildings": growth_mb})
    figures.at_most("peak_mb_large", large.peak_mb, MAX_MB)
    figures.at_most("peak_mb_tile", tile.peak_mb, MAX_MB)
    figures.at_most("cpu_ratio_large", large.cpu_s / num_large / (small_s / num_small), MAX_RATIO)
    figures.at_most("cpu_ratio_large_without_start", large_ms / small_ms, MAX_RATIO)
    figures.at_most("cpu_ratio_tile_without_start", tile_ms / small_ms, MAX_RATIO)
    figures.at_least("buildings", len(large.buildings), 7400 if arguments.copies == NUM_COPIES else num_large)
    figures.at_most("copies_that_differ", num_different(large.buildings, arguments.copies), 0)
    differ = [not same(large.buildings[name], building) for name, building in tile.buildings.items()]
    figures.at_most("buildings_of_tile_that_differ", sum(differ), 0)
    return figures.end()


def same(first: tuple[Any, np.ndarray], second: tuple[Any, np.ndarray]) -> bool:
    """Whether two buildings have the same attributes, faces and coordinates."""
    return bool(first[0] == second[0]) and np.array_equal(first[1], second[1])


if __name__ == "__main__":
    sys.exit(main())
