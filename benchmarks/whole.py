"""What a whole run of ``p2wss reconstruct`` costs beside Roofer, on 74 houses; the last line is JSON.

    python benchmarks/whole.py --data ../shared/data

The data (AHN3, 15 points per m², row houses in Delft) are not part of the project. Runs of p2wss, of p2wss with a
quarter of the footprints and of Roofer (https://github.com/3DBAG/roofer, if ``roofer`` is installed) alternate, so that
other work on the machine slows all of them. Each figure is that of the run with the least CPU time, divided by how much
slower than usual the machine is (``figures.slowness``). A further house: the difference of the two runs of p2wss.
Without the network, on one thread, with the default outputs.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import geopandas as gpd
from figures import Figures, Run, run, slowness

# CPU seconds per building of Roofer 1.1.0-beta.1, recorded on two cores with other work
ROOFER_S = 2.85 / 160
NUM_FEW = 18


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with delft_ahn3")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    place = arguments.data / "delft_ahn3"
    cloud, footprints = place / "ahn3.laz", place / "footprints.gpkg"
    figures = Figures()
    houses = gpd.read_file(footprints)
    runs: dict[str, list[Run]] = {}
    factors = []
    with tempfile.TemporaryDirectory() as name:
        few = Path(name, "few.gpkg")
        houses.iloc[:NUM_FEW].to_file(few)
        out = Path(name, "out")
        p2wss = [sys.executable, "-m", "p2wss.cli", "reconstruct", cloud]
        commands = {
            "all houses": [*p2wss, footprints, out, "--model", "none"],
            "few houses": [*p2wss, few, out, "--model", "none"],
            "two threads": [*p2wss, footprints, out, "--model", "none", "--threads", "2"],
        }
        if shutil.which("roofer"):
            commands["Roofer"] = ["roofer", "-j", "2", cloud, footprints, Path(name, "roofer")]
        run(commands["few houses"])  # compiles what is not compiled yet
        for _ in range(arguments.repeats):
            factors.append(slowness())
            for title, command in commands.items():
                runs.setdefault(title, []).append(run(command))
    factor = min(factors)
    best = {title: min(each) for title, each in runs.items()}
    for title, each in best.items():
        print(f"{title:<12} {each.cpu_s:6.2f} CPU s {each.wall_s:6.2f} s {each.peak_mib:6.0f} MiB")
        figures.row(title, {"CPU s": each.cpu_s, "s": each.wall_s, "MiB": each.peak_mib})
    figures.row("machine", {"slower than usual": factor})
    whole, further = best["all houses"], best["all houses"].cpu_s - best["few houses"].cpu_s
    roofer_s = best["Roofer"].cpu_s / len(houses) if "Roofer" in best else ROOFER_S * factor
    further_s = further / (len(houses) - NUM_FEW)
    print(f"a further house costs {further_s / roofer_s:.1f} times as much as one of Roofer's")
    wall_s = [min(each.wall_s for each in runs[title]) for title in ("two threads", "all houses")]
    figures.at_most("whole run, CPU s", whole.cpu_s / factor, 3.5)
    figures.at_most("a further house, CPU ms", 1e3 * further_s / factor, 22)
    figures.at_most("peak, MiB", whole.peak_mib, 300)
    figures.at_most("wall of two threads over one", wall_s[0] / wall_s[1], 0.6)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
