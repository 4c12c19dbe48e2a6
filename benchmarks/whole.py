"""What a whole run of ``p2wss reconstruct`` costs, of houses and of large blocks; the last line is JSON.

    python benchmarks/whole.py --data ../shared/data [--copies 106]

Needs data that are not part of the project (AHN3, 15 points per m², row houses in Delft; LiDAR HD, five blocks). Runs
of all houses, of a quarter of them and of the blocks alternate, so that other work on the machine slows all of them.
CPU time is divided by how much slower than usual the machine is just before and after the run (``figures.slowness``).
The median run counts. The difference of the two runs of houses gives the cost of a further house, and so the cost of
the start, which is subtracted from the blocks. Without the network, on one thread, with default outputs. ``--copies``:
also a town of this many copies of the houses, first with the default outputs, then as a scene for radar: skins, GLB and
Sionna's files. Another program for comparison: ``beside_roofer.py``.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
from figures import Figures, Run, run, slowness

NUM_FEW = 18
# distance of the copies of a town, and number of copies beside each other
STEP_M, NUM_COLUMNS = (125.0, 150.0), 10
# prints what writing takes
WRITING = """
import json, sys, time
from p2wss.cli import main
from p2wss.reconstruction.outputs import exports
write = exports.write
def timed(*arguments):
    start = time.process_time()
    written = write(*arguments)
    print(json.dumps({"cpu_s": time.process_time() - start}), flush=True)
    return written
exports.write = timed
main(sys.argv[1:])
"""
RADAR_SCENE = json.dumps({"reconstruct": {"outputs": ["glb", "sionna"], "skin": True}})


def town(place: Path, num_copies: int, folder: Path) -> tuple[Path, Path]:
    """(clouds, footprints) of ``num_copies`` copies of a place."""
    cloud, houses = laspy.read(place / "ahn3.laz"), gpd.read_file(place / "footprints.gpkg")
    (folder / "clouds").mkdir()
    copies, x_m, y_m = [], np.array(cloud.x), np.array(cloud.y)
    for number in range(num_copies):
        east_m, north_m = np.multiply(divmod(number, NUM_COLUMNS), STEP_M)
        cloud.x, cloud.y = x_m + east_m, y_m + north_m
        cloud.write(folder / "clouds" / f"{number}.laz")
        copies.append(houses[["geometry"]].set_geometry(houses.translate(east_m, north_m)))
    gpd.GeoDataFrame(pd.concat(copies, ignore_index=True)).to_file(folder / "town.gpkg")
    return folder / "clouds", folder / "town.gpkg"


def measured(command: Sequence[object]) -> Run:
    """A run, with its CPU time on a machine that is as fast as usual."""
    before = slowness()
    each = run(command)
    return each._replace(cpu_s=2 * each.cpu_s / (before + slowness()))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with delft_ahn3, lidarhd_crops")
    parser.add_argument(
        "--copies", type=int, default=0, help="of the houses, as a town: 106 are 7,844 houses"
    )
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    place = arguments.data / "delft_ahn3"
    cloud, footprints = place / "ahn3.laz", place / "footprints.gpkg"
    figures = Figures()
    houses = gpd.read_file(footprints)
    blocks = arguments.data / "lidarhd_crops"
    num_blocks = len(gpd.read_file(blocks / "footprints.gpkg"))
    runs: dict[str, list[Run]] = {}
    with tempfile.TemporaryDirectory() as name:
        few = Path(name, "few.gpkg")
        houses.iloc[:NUM_FEW].to_file(few)
        out = Path(name, "out")
        p2wss = [sys.executable, "-m", "p2wss.cli", "reconstruct", cloud]
        commands = {
            "all houses": [*p2wss, footprints, out, "--model", "none"],
            "few houses": [*p2wss, few, out, "--model", "none"],
            "two threads": [*p2wss, footprints, out, "--model", "none", "--threads", "2"],
            "blocks": [
                *p2wss[:-1],
                *blocks.glob("*69.laz"),
                blocks / "footprints.gpkg",
                out,
                "--model",
                "none",
            ],
        }
        run(commands["few houses"])  # compiles what is not compiled yet
        for _ in range(arguments.repeats):
            for title, command in commands.items():
                runs.setdefault(title, []).append(measured(command))
        if arguments.copies:
            inputs = [*town(place, arguments.copies, Path(name)), out, "--model", "none", "--quiet"]
            runs["town"] = [measured([*p2wss[:-1], *inputs])]
            runs["town, two threads"] = [measured([*p2wss[:-1], *inputs, "--threads", "2"])]
            timed = [sys.executable, "-c", WRITING, "reconstruct", *inputs, "--config", RADAR_SCENE]
            runs["radar scene"] = [measured(timed)]
    typical = {title: sorted(each)[len(each) // 2] for title, each in runs.items()}
    for title, each in typical.items():
        print(f"{title:<12} {each.cpu_s:6.2f} CPU s {each.wall_s:6.2f} s {each.peak_mib:6.0f} MiB")
        figures.row(title, {"CPU s": each.cpu_s, "s": each.wall_s, "MiB": each.peak_mib})
    whole, further = typical["all houses"], typical["all houses"].cpu_s - typical["few houses"].cpu_s
    further_s = further / (len(houses) - NUM_FEW)
    start_s = typical["few houses"].cpu_s - NUM_FEW * further_s
    figures.at_most("whole run, CPU s", whole.cpu_s, 3.5)
    figures.at_most("a further house, CPU ms", 1e3 * further_s, 22)
    figures.at_most("peak, MiB", whole.peak_mib, 300)
    wall_s = [min(each.wall_s for each in runs[title]) for title in ("two threads", "all houses")]
    figures.at_most("wall of two threads over one", wall_s[0] / wall_s[1], 0.6)
    block_s = (typical["blocks"].cpu_s - start_s) / num_blocks
    figures.at_most("a large block without the start, CPU ms", 1e3 * block_s, 150)
    if arguments.copies:
        house_s = typical["town"].cpu_s / (arguments.copies * len(houses))
        figures.at_most("a house of the town, CPU ms", 1e3 * house_s, 20)
        figures.at_most("peak of the town, MiB", typical["town"].peak_mib, 800)
        share = typical["town, two threads"].wall_s / typical["town"].wall_s
        figures.at_most("wall of two threads over one, town", share, 0.6)
        lines = typical["radar scene"].output.splitlines()
        writing_s = next(json.loads(line)["cpu_s"] for line in lines if line.startswith("{"))
        figures.at_most("skins, Sionna and GLB of the town, CPU s", writing_s, 30)
        figures.at_most("peak of the radar scene, MiB", typical["radar scene"].peak_mib, 2000)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
