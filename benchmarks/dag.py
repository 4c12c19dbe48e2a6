"""Time and memory of planning: ``snakemake -n`` for 10 to 1,500 tiles and for the paper's experiment.

    python benchmarks/dag.py [--tiles 10 100 1000 1500]

Needs Snakemake, no data.

All tiles are named and have real LiDAR. CPU seconds are of the whole process, its start and the printed commands
included. The last line is JSON.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import yaml
from figures import Figures

ROOT = Path(__file__).resolve().parents[1]
# the paper's experiment: CPU seconds, jobs
PAPER_BARS = {"s": 60, "jobs": 10_000}
# bar: time per job with the most tiles, divided by the time per job with 100 tiles
BAR_LINEAR = 1.5


class Planning(NamedTuple):
    """CPU and wall seconds of the process, and its peak memory in MB."""

    num_jobs: int
    cpu_s: float
    wall_s: float
    peak_mb: float


def planning(*configs: Path) -> Planning:
    """One ``snakemake -n`` with these configs. Raises ``RuntimeError`` with its output if it fails."""
    with tempfile.TemporaryFile("w+", encoding="utf-8") as output:
        command = ["snakemake", "-n", "--configfile", *map(str, configs)]
        start = time.perf_counter()
        process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
        wall_s = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        text = output.read()
    totals = re.findall(r"^total +(\d+)$", text, re.M)
    if process.returncode or not totals:
        raise RuntimeError(text[-2000:])
    return Planning(int(totals[-1]), usage.ru_utime + usage.ru_stime, wall_s, usage.ru_maxrss / 1024)


def square_of_tiles(num: int) -> list[str]:
    """The names of ``num`` tiles that form about a square."""
    side = next(side for side in range(1, num + 1) if side * side >= num)
    return [f"{500 + i % side:04d}_{6500 + i // side:04d}" for i in range(num)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tiles", type=int, nargs="+", default=[10, 100, 1000, 1500])
    options = parser.parse_args()
    figures = Figures()
    per_job_ms = {}
    print(f"{'tiles':>8}{'jobs':>8}{'CPU s':>8}{'wall s':>8}{'ms per job':>12}{'MB':>7}")

    def show(name: str, plan: Planning) -> None:
        per_job = 1000 * plan.cpu_s / plan.num_jobs
        print(
            f"{name:>8}{plan.num_jobs:8}{plan.cpu_s:8.1f}{plan.wall_s:8.1f}{per_job:12.2f}{plan.peak_mb:7.0f}",
            flush=True,
        )
        values = {"jobs": plan.num_jobs, "CPU s": plan.cpu_s, "ms per job": per_job, "MB": plan.peak_mb}
        figures.row(f"{name} tiles" if name.isdigit() else name, values)

    with tempfile.TemporaryDirectory() as folder:
        config, every_tile = Path(folder, "config.yaml"), Path(folder, "every_tile.yaml")
        for num in options.tiles:
            tiles = square_of_tiles(num)
            region = {"name": f"dag-{num}", "vintage": "dag", "tiles": tiles, "lidar_tiles": tiles}
            config.write_text(yaml.safe_dump({"region": region}), encoding="utf-8")
            plan = planning(config)
            per_job_ms[num] = 1000 * plan.cpu_s / plan.num_jobs
            show(str(num), plan)
        paper = ROOT / "config/paper.yaml"
        every_tile.write_text(yaml.safe_dump({"region": {"tiles": ["all"]}}), encoding="utf-8")
        plan = planning(paper, every_tile)
        show("paper", plan)
    most = max(options.tiles)
    if 100 in per_job_ms and most > 100:
        figures.at_most(
            f"time per job of {most} tiles, times that of 100", per_job_ms[most] / per_job_ms[100], BAR_LINEAR
        )
    figures.at_most("paper: CPU s", plan.cpu_s, PAPER_BARS["s"])
    figures.at_most("paper: jobs", plan.num_jobs, PAPER_BARS["jobs"])
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
