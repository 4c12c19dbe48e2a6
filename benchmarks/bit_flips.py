"""Whether damage is noticed: one flipped bit in a file of every kind that stages pass on, and what the check costs.

    python benchmarks/bit_flips.py [--num 50] [--results results/mini]

Needs no data; for the cost, the results of a run with Snakemake.

Each file is written by the package, and read by the reader of the stage that follows, with one random bit flipped; a
quarter of the flips are in the last kilobyte, where footers are. "told": an error or, for caches and checkpoints, which
are made again, a warning names the file in one line; "same": the same content was read; "silent": other content was
read, and nothing was said.

With the results of a run, the cost: the time to verify the inputs of every job of a stage, as a share of the time that
Snakemake measured for its jobs. The last line is JSON.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "unit"))
from figures import Figures  # noqa: E402
from file_kinds import KINDS, flip_bits  # noqa: E402

from p2wss.storage import integrity  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--num", type=int, default=50, help="flips per kind of file")
    parser.add_argument("--results", type=Path, help="results of a run, for the cost")
    arguments = parser.parse_args()
    figures = Figures()
    silent = traceback = 0
    print(f"{'file':<34}{'told':>6}{'same':>6}{'silent':>8}{'traceback':>11}")
    for name, kind in KINDS.items():
        with tempfile.TemporaryDirectory() as folder:
            outcome = flip_bits(kind, Path(folder), arguments.num)
        print(f"{name:<34}{outcome.told:>6}{outcome.same:>6}{outcome.silent:>8}{outcome.traceback:>11}")
        figures.row(name, vars(outcome))
        silent += outcome.silent
        traceback += outcome.traceback
    figures.at_least("kinds of files", len(KINDS), 20)
    figures.at_least("flips per kind", arguments.num, 50)
    figures.at_most("silent", silent, 0)
    figures.at_most("tracebacks", traceback, 0)
    if arguments.results:
        for stage, (verify_s, stage_s) in costs(arguments.results).items():
            figures.at_most(f"checksums of {stage}, share of its time", verify_s / stage_s, 0.03)
    return figures.end()


# files that each job of a stage reads of the results, by folder
INPUTS = {
    "scenes": ["fetch/footprints.gpkg"],
    "buildings": ["scenes/{tile}.parquet"],
    "scans": ["scenes/{tile}.parquet", "scenes/{tile}.tif", "buildings/{tile}.parquet"],
    "crops/simulated": ["buildings/{tile}.parquet", "scans/{tile}.laz"],
    "crops/real": ["fetch/footprints.gpkg", "fetch/lidar/*.laz"],
    "dvae": ["crops/manifest.json", "crops/*/*.parquet"],
    "model": ["crops/manifest.json", "crops/*/*.parquet", "dvae/model.safetensors"],
    "reconstruct": ["fetch/footprints.gpkg", "fetch/lidar/*.laz", "model/model.safetensors"],
    "eval": ["crops/manifest.json", "crops/*/*.parquet", "eval/parts/*/*.parquet", "eval/measures.parquet"],
}


def costs(results: Path) -> dict[str, tuple[float, float]]:
    """Seconds to verify what the jobs of each stage read and to fill in what they wrote, and seconds of the jobs."""
    logs = results.parents[1] / "logs" / results.name / "benchmarks"
    seconds: defaultdict[str, float] = defaultdict(float)
    checks: defaultdict[str, float] = defaultdict(float)
    for stage, patterns in INPUTS.items():
        for record in sorted((logs / stage).rglob("*.tsv")):
            with record.open() as file:
                seconds[stage] += sum(float(row["s"]) for row in csv.DictReader(file, delimiter="\t"))
            for pattern in patterns:
                for path in results.glob(pattern.format(tile=record.stem)):
                    integrity._verified.clear()
                    start = time.perf_counter()
                    integrity.is_intact(path)
                    checks[stage] += time.perf_counter() - start
    return {stage: (checks[stage], seconds[stage]) for stage in seconds if seconds[stage]}


if __name__ == "__main__":
    sys.exit(main())
