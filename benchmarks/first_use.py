"""What a first use costs: compilation, and the start of p2wss reconstruct after it; the last line is JSON.

    python benchmarks/first_use.py

Compilation: CPU seconds of one process that compiles all that ``p2wss reconstruct`` needs, less the CPU seconds of the
same process when all is compiled. ``p2wss warm-up`` and a first run use several processes for that. Start: a whole run
with three buildings, mostly imports. A cache folder of its own leaves out what is compiled already. CPU time leaves out
other work on the machine, and is divided by how much slower than usual the machine is (``figures.slowness``).
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import laspy
from figures import Figures, slowness

from p2wss.reconstruction.warm_up import sample

BARS = {
    "compilation, CPU s": 60,
    "functions compiled twice": 0,
    "start after warm-up, CPU s": 10,
    "warm-up again, CPU s": 5,
    "warm-up, wall over the CPU of one process": 0.75,
}
# compiles everything in its process, and prints which functions of p2wss it compiled
COMPILE = """
import collections, json, time
from numba.core import event
from p2wss.reconstruction import warm_up
class Names(event.Listener):
    names = collections.Counter()
    def on_start(self, begun):
        function = begun.data["dispatcher"].py_func
        self.names[f"{function.__module__}.{function.__qualname__}"] += function.__module__.startswith("p2wss.")
    def on_end(self, ended): pass
event.register("numba:compile", Names())
warm_up.warm_product()
print(json.dumps({"cpu_s": time.process_time(), "compiled": +Names.names}))
"""


def compilation(cache: Path) -> tuple[float, dict[str, int]]:
    """(CPU seconds that compilation takes, how often each function is compiled)."""
    cold, warm = (json.loads(run([sys.executable, "-c", COMPILE], cache)) for _ in range(2))
    if warm["compiled"]:
        print("compiled though it had been before: " + ", ".join(warm["compiled"]))
    return cold["cpu_s"] - warm["cpu_s"], cold["compiled"]


def run(command: list[str], cache: Path) -> str:
    """What a command writes to its standard output, with a cache folder."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    return subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout


def p2wss(cache: Path, *arguments: object) -> tuple[float, float]:
    """(wall, CPU) seconds of a command, from the start of its process."""
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    run([sys.executable, "-m", "p2wss.cli", *map(str, arguments)], cache)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - start, cpu_s


def write_sample(folder: Path) -> tuple[Path, Path]:
    """(cloud, footprints) of three buildings."""
    features, cloud = sample()
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.x, las.y, las.z, las.classification = cloud.x_m, cloud.y_m, cloud.z_m, cloud.classification
    las.write(folder / "cloud.laz")
    features.to_frame()[["building_id", "geometry"]].to_file(folder / "footprints.gpkg")
    return folder / "cloud.laz", folder / "footprints.gpkg"


def main() -> int:
    figures, factor = Figures(), slowness()
    print(f"the machine is {factor:.2f} times as slow as usual")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cpu_s, compiled = compilation(folder / "one")
        twice = sorted(function for function, count in compiled.items() if count > 1)
        print(
            f"{len(compiled)} functions in {cpu_s:.1f} CPU s on it; compiled twice: {', '.join(twice) or 'none'}"
        )
        all_wall_s, all_s = p2wss(folder / "two", "warm-up")
        print(f"p2wss warm-up: {all_wall_s:.1f} s, {all_s:.1f} CPU s")
        wall_s, again_s = p2wss(folder / "two", "warm-up")
        print(f"again: {wall_s:.1f} s, {again_s:.1f} CPU s")
        files = write_sample(folder)
        wall_s, start_s = p2wss(folder / "two", "reconstruct", *files, folder / "out", "--crs", "EPSG:2154")
        print(f"first p2wss reconstruct, of three buildings: {wall_s:.1f} s, {start_s:.1f} CPU s")
    measured = {
        "compilation, CPU s": cpu_s / factor,
        "functions compiled twice": len(twice),
        "start after warm-up, CPU s": start_s / factor,
        "warm-up again, CPU s": again_s / factor,
        "warm-up, wall over the CPU of one process": all_wall_s / cpu_s,
    }
    for figure, value in measured.items():
        figures.at_most(figure, value, BARS[figure])
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
