"""Speed, memory and realism of the simulated LiDAR and of cropping, against peers in the same run.

    python benchmarks/lidar.py [--quick] [--data FOLDER]

Needs embreex and trimesh (the extra ``scan``); real LiDAR for the comparison with it.

Speeds are CPU time of one core. The scene is 1 km2 of terrain with 5,000 buildings under about 10 million
pulses; --quick takes a sixteenth of it, whose times mean little. FOLDER contains real LiDAR (default:
../shared/data; absent files are skipped). The last line is JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")
# where memory is fragmented, the kernel compacts it for each huge page that numpy asks for: 1.5 s per scene
os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")

import pyarrow as pa
from figures import Figures, peak_mib
from lidar_peers import compare_cast, compare_crop
from lidar_realism import print_table, real_clouds, simulated_clouds
from lidar_scene import (
    CRS,
    TILE,
    TILE_SIZE_M,
    Run,
    make_buildings,
    make_terrain,
    run_scene,
    settings,
    warm_up,
)

from p2wss.clouds.scan_files import read_scan
from p2wss.config import Clutter
from p2wss.data.terrain import Terrain
from p2wss.scans import scan as scans

ROOT = Path(__file__).resolve().parents[1]
STEP_BARS_S = {
    "pulses generated and culled": 0.5,
    "scene built": 2.5,
    "cast": 2.2,
    "noise, drop-out, tags": 0.8,
    "crop": 1.3,
    "shard written": 0.8,
    "whole scene": 8.0,
}


def steps(figures: Figures, buildings: pa.Table, terrain: Terrain, size_m: float) -> Run:
    """CPU time of each step of one scene."""
    with tempfile.TemporaryDirectory() as folder:
        warm_up(Path(folder))
        run = run_scene(buildings, terrain, size_m, Path(folder), keep_scan=True)
        print(f"{run.num_pulses:,} pulses, {run.num_points:,} points, preset hd without clutter")
        for name, bar in STEP_BARS_S.items():
            figures.at_most(f"{name}, CPU s", run.step_s[name], bar)
        print(f"of the whole: simulated {run.simulate_s:.2f} CPU s, cropped {run.crop_s:.2f}")
        figures.at_least("cast, M rays per CPU-second", run.num_pulses / run.step_s["cast"] / 1e6, 4.5)

        # the file between the stages is not among the steps with a bar
        path = Path(folder) / "scan.laz"
        assert run.scan is not None
        start = time.process_time()
        scans.write_scan(path, run.scan, CRS)
        written = time.process_time()
        read_scan(path)
        read = time.process_time()
        print(
            f"LAZ between the stages, without a bar: written {written - start:.2f} s, "
            f"read {read - written:.2f} s"
        )
    return run


def peers(
    figures: Figures, run: Run, buildings: pa.Table, terrain: Terrain, size_m: float, num_slow: int
) -> None:
    """The crop and the cast against shapely, embreex and trimesh."""
    crop_ratio, is_same = compare_crop(buildings, run.cloud, min(len(run.cloud), 500_000))
    figures.at_least("crop, times the speed of shapely dwithin", crop_ratio, 8)
    figures.at_least("crop, the same result", is_same, 1)
    ratio = compare_cast(buildings, terrain, size_m, num_slow)
    print(
        f"M rays per CPU-second: {ratio.million_rays_per_s}; "
        f"trees and rays, times trimesh's: {ratio.to_trimesh_with_trees:.1f}"
    )
    figures.at_least("cast, share of the speed of embreex alone", ratio.to_embreex, 0.85)
    figures.at_least("cast, times the speed of trimesh intersects_location", ratio.to_trimesh, 10)


def clutter_costs(buildings: pa.Table, terrain: Terrain, size_m: float) -> None:
    """Print the CPU time of a scan with clutter, which has no bar."""
    config = settings(clutter=Clutter())
    start = time.process_time()
    scans.simulate(buildings, terrain, TILE, size_m, config)
    print(f"simulated with clutter, without a bar: {time.process_time() - start:.2f} s")


def two_at_once(figures: Figures, is_quick: bool) -> None:
    """One scene against two in two processes at once: wall and CPU seconds, and peak memory.

    Wall time means something only on a machine that does nothing else; the CPU time shows what the two cost
    each other in caches and memory.
    """

    def run(num_processes: int) -> dict[str, float]:
        """The largest of each figure over the processes."""
        command = [sys.executable, __file__, "--one", *(["--quick"] if is_quick else [])]
        processes = [
            subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(num_processes)
        ]
        answers = [json.loads(process.communicate()[0].splitlines()[-1]) for process in processes]
        return {name: max(answer[name] for answer in answers) for name in answers[0]}

    one, two = run(1), run(2)
    for kind in ("wall_s", "cpu_s"):
        ratio = two[kind] / one[kind]
        print(f"{kind}: one scene {one[kind]:.1f}, two at once {two[kind]:.1f}: {ratio:.2f} times")
    figures.at_most("two scenes at once, times the wall time of one", two["wall_s"] / one["wall_s"], 1.25)
    figures.at_most("peak memory of one scene, GB", two["peak_gb"], 1.5)


def one_scene(num: int, size_m: float) -> dict[str, float]:
    """A scene in this process: wall and CPU seconds from buildings to shard, and peak memory."""
    buildings, terrain = make_buildings(num, size_m), make_terrain(size_m)
    with tempfile.TemporaryDirectory() as folder:
        warm_up(Path(folder))
        start, cpu = time.perf_counter(), time.process_time()
        run_scene(buildings, terrain, size_m, Path(folder))
        return {
            "wall_s": time.perf_counter() - start,
            "cpu_s": time.process_time() - cpu,
            "peak_gb": peak_mib() / 1024,
        }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a sixteenth of the scene")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="real LiDAR")
    arguments = parser.parse_args()
    num, size_m = (312, 250.0) if arguments.quick else (5000, TILE_SIZE_M)
    if arguments.one:
        print(json.dumps(one_scene(num, size_m)))
        return 0

    figures = Figures()
    buildings, terrain = make_buildings(num, size_m), make_terrain(size_m)
    run = steps(figures, buildings, terrain, size_m)
    peers(figures, run, buildings, terrain, size_m, 100_000 if arguments.quick else 1_000_000)
    del run
    clutter_costs(buildings, terrain, size_m)
    two_at_once(figures, arguments.quick)
    realism = simulated_clouds(250.0) | real_clouds(arguments.data)
    print_table(realism)
    for name, row in realism.items():
        figures.row(f"realism, {name}", row.as_json())
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
