"""Measured costs per unit of work, from the benchmark files and the results of a run: ``config/costs.csv``.

    snakemake -c2 eval_report && python benchmarks/costs.py                    # of the miniature
    python benchmarks/costs.py --configfile config/regions/lyon.yaml --out costs.csv

``p2wss plan`` multiplies the table. CPU time of a unit is the median over the jobs of a stage, so that a job which
had to compile counts no more than others; the time of the shortest job is the start of a job and has a row of its own.
Memory is that of the largest job. GPU time is not measured but assumed.
The last line is JSON.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import sys
from dataclasses import asdict
from pathlib import Path
from statistics import median

from p2wss.config import Config, dataset_name, load, member_places, place_config
from p2wss.fetch import plan as fetch_plan
from p2wss.plan.costs import Cost, write_costs
from p2wss.plan.work import Region, Work, count_work

# (stage, unit, benchmark files of its jobs, results)
STAGES = [
    ("fetch/footprints", "member", "fetch/**/*footprints", "fetch/**/*footprints.gpkg"),
    ("fetch/dtm", "tile", "fetch/*/dtm_*", "resources/ign/{vintage}/dtm/*.tif"),
    ("fetch/lidar", "real building", "fetch/*/lidar_*", "resources/ign/{vintage}/lidar/*.laz"),
    ("fetch/prepare", "real building", "fetch/prepare/**/*", "fetch/lidar/**/*.laz"),
    ("scenes/index", "building", "scenes/index", "scenes/index.tsv"),
    ("scenes", "building", "scenes/**/*_*", "scenes/**/*_*"),
    ("buildings", "building", "buildings/**/*", "buildings/**/*.parquet"),
    ("scans", "million pulses", "scans/**/*", "scans/**/*"),
    ("crops/simulated", "building", "crops/simulated/**/*", "crops/simulated/**/*.parquet"),
    ("crops/real", "real building", "crops/real/**/*", "crops/real/**/*.parquet"),
    ("crops/manifest", "building", "crops/manifest", "crops/manifest.json"),
    ("dvae", "dvae tflop", "dvae/train", "dvae/*"),
    ("model", "model tflop", "model/train", "model/*"),
    ("eval/point2wss", "test tflop", "eval/*/point2wss", "eval/parts/*/point2wss.parquet"),
    ("eval/point2wss+fit", "test building", "eval/*/point2wss+fit", "eval/parts/*/point2wss+fit.parquet"),
    ("eval/masked", "test tflop", "eval/*/masked", "eval/parts/*/masked.parquet"),
    ("eval/fit", "test building", "eval/*/fit", "eval/parts/*/fit.parquet"),
    ("eval/lod1", "test building", "eval/*/lod1", "eval/parts/*/lod1.parquet"),
    ("eval/constant", "test building", "eval/*/constant", "eval/parts/*/constant.parquet"),
    ("eval/measure", "test building", "eval/*/measure", "eval/parts/*/measures.parquet"),
    ("eval/report", "run", "eval/report", "eval/*.html"),
    ("reconstruct", "real building", "reconstruct/**/*", "reconstruct/**/*"),
]
# stages that also run the network: the part of it in their CPU time goes by its own unit
WITH_NETWORK = {"eval/point2wss+fit": "test tflop", "reconstruct": "real tflop"}
# not measured
GPU_TFLOP_PER_S = 20.0
GPU_SOURCE = (
    f"GPU assumed at {GPU_TFLOP_PER_S:g} TFLOP/s sustained, a quarter of the float32 peak of an RTX 4090"
)


def work_of(config: Config) -> tuple[Work, dict[str, int]]:
    """The work that a run has done, and the buildings of each of its tiles."""
    with Path("results", dataset_name(config), "scenes/index.tsv").open(encoding="utf-8", newline="") as file:
        counts = {
            (row["place"], row["tile"]): int(row["num_buildings"])
            for row in csv.DictReader(file, delimiter="\t")
        }
    regions: list[Region] = []
    by_tile: dict[str, int] = {}
    for place in member_places(config):
        at = place_config(config, place)
        of_place = {tile: count for (name, tile), count in counts.items() if name == place}
        regions.append(Region(fetch_plan.tiles(at), fetch_plan.lidar_tiles(at), of_place))
        by_tile |= of_place
    return count_work(config, regions), by_tile


def cost_of(
    config: Config, work: Work, by_tile: dict[str, int], stage: tuple[str, str, str, str], start_s: float
) -> Cost | None:
    """The cost of a unit in a stage; None if the stage has not run. start_s: of a job, which does not count."""
    stage_name, unit, pattern, results = stage
    name = dataset_name(config)
    folder = Path("logs", name, "benchmarks")
    jobs = {path: job for path in sorted(folder.glob(f"{pattern}.tsv")) if (job := read_job(path))}
    amount = work.amounts[unit]
    if not jobs or not amount:
        return None
    amounts = {path: by_tile.get(path.stem, 0) if "building" in unit else 0 for path in jobs}
    cpu_s = median(
        (float(job["cpu_time"]) - start_s) / (amounts[path] or amount / len(jobs))
        for path, job in jobs.items()
    )
    if results.startswith("resources"):
        files = list(Path().glob(results.format(vintage=config.region.vintage)))
    else:
        files = list(Path("results", name).glob(results))
    size_mb = sum(path.stat().st_size for path in files if path.is_file()) / 1e6
    is_network = unit.endswith("tflop")
    return Cost(
        stage_name,
        unit,
        cpu_s,
        1 / GPU_TFLOP_PER_S if is_network else 0.0,
        # weights are of one size, however long the training
        0.0 if is_network else size_mb / amount,
        max(float(job["max_rss"]) for job in jobs.values()),
        measured_on(config) + (f"; {GPU_SOURCE}" if is_network else ""),
    )


def start_of_job(config: Config) -> Cost:
    """What the start of a job costs: the CPU time of the shortest one."""
    files = Path("logs", dataset_name(config), "benchmarks").rglob("*.tsv")
    cpu_s = min(float(job["cpu_time"]) for path in files if (job := read_job(path)))
    return Cost("start of a job", "job", cpu_s, 0.0, 0.0, 0.0, measured_on(config))


def measured_on(config: Config) -> str:
    """The source of a figure."""
    return f"CPU measured on {dataset_name(config)} ({os.cpu_count()} cores, {platform.machine()})"


def read_job(path: Path) -> dict[str, str] | None:
    """The row of a benchmark file; None for a job too short to be measured."""
    with path.open(encoding="utf-8", newline="") as file:
        row = next(csv.DictReader(file, delimiter="\t"))
    return None if row["cpu_time"] in ("NA", "-") or row["max_rss"] in ("NA", "-") else row


def with_network(costs: list[Cost], work: Work) -> list[Cost]:
    """The costs with the part of the network in rows of its own, where a stage runs it beside other work."""
    network = next((cost for cost in costs if cost.stage == "eval/point2wss"), None)
    if network is None:
        return costs
    split = []
    for cost in costs:
        unit = WITH_NETWORK.get(cost.stage)
        if unit is None:
            split.append(cost)
            continue
        of_network = network.cpu_s * work.amounts[unit] / work.amounts[cost.unit]
        parts = asdict(cost)
        split.append(Cost(**parts | {"cpu_s": max(cost.cpu_s - of_network, 0.0)}))
        row = {"unit": unit, "disk_mb": 0.0, "cpu_s": network.cpu_s, "gpu_s": network.gpu_s}
        split.append(Cost(**parts | row | {"source": network.source}))
    return split


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--configfile", type=Path, nargs="+", default=[], help="configs of the run (default: the miniature)"
    )
    parser.add_argument("--out", type=Path, default=Path("config/costs.csv"), help="table to write")
    options = parser.parse_args()
    config = load(*options.configfile)
    work, by_tile = work_of(config)
    start = start_of_job(config)
    measured = [cost_of(config, work, by_tile, stage, start.cpu_s) for stage in STAGES]
    costs = [start, *with_network([cost for cost in measured if cost is not None], work)]
    write_costs(options.out, costs)
    print(options.out.read_text())
    print(json.dumps({f"{cost.stage}, {cost.unit}": asdict(cost) for cost in costs}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
