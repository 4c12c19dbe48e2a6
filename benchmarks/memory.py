"""Peak memory of the evaluation: of the miniature, of 20 times the miniature, and of 430,000 buildings.

    snakemake -c2 crops                     # the miniature's shards
    python benchmarks/memory.py

Needs torch and the crops of the miniature.

The large data sets are copies of the miniature's shards with other tiles. predict, fit, the baselines and measure run
on the miniature and on one group of 16 shards. 20 times the miniature has five such groups; the parts of the other four
are copies. merge and report run on everything. The 430,000 buildings (the paper's test) have clouds of 40 points, which
keeps the files small: only the report reads such clouds, and only a few of them. The last line is JSON.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from figures import Figures

from p2wss.data.manifest import Manifest, read_manifest
from p2wss.storage import files
from p2wss.storage.schemas.crops import CROPS, REAL, SIMULATED

ROOT = Path(__file__).resolve().parents[1]
WEIGHTS = ROOT / "models/point2wss.safetensors"
NUM_COPIES, NUM_PER_GROUP, NUM_BUILDINGS, NUM_POINTS = 20, 4, 430_000, 40
MAX_RATIO, MAX_MIB = 1.5, 4096
WITH_NETWORK = ("point2wss", "masked")
METHODS = (*WITH_NETWORK, "fit", "lod1", "constant")
# small numbers of samples: the memory is used by points and meshes, not by the samples on them
CONFIG = json.dumps({"eval": {"baselines": ["lod1", "constant"], "num_samples": 256, "max_num_points": 256}})
# getrusage does not tell the memory: its figure starts with the memory of the parent
WRAPPER = """
import sys
from p2wss import cli
status = cli.main(sys.argv[2:])
lines = open("/proc/self/status").read().splitlines()
open(sys.argv[1], "w").write(next(line.split()[1] for line in lines if line.startswith("VmHWM")))
sys.exit(status)
"""


class Evaluation:
    """Runs commands in a folder, and records the peak memory of each."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.peak_mib: dict[str, float] = {}

    def run(self, name: str, *words: object, config: str | None = CONFIG) -> None:
        """Run a command. config: None for a command without settings."""
        peak = self.folder / "peak"
        command = [sys.executable, "-c", WRAPPER, peak, *words]
        if config is not None:
            command += ["--config", config]
        run = subprocess.run(list(map(str, command)), cwd=ROOT, capture_output=True, text=True)
        if run.returncode:
            raise SystemExit(f"{name}:\n{run.stderr}")
        mib = int(peak.read_text()) / 1024
        self.peak_mib[name] = max(round(mib, 1), self.peak_mib.get(name, 0))
        print(f"{self.folder.name}: {name} {mib:.0f} MiB", flush=True)

    def evaluate(self, manifest: Path, shards: list[Path], part: Path) -> None:
        """Run everything that the jobs of one group do."""
        group: list[object] = ["--manifest", manifest, "--shards", *shards]
        out = self.folder / "medians.json"
        self.run("medians", "eval", "medians", "--manifest", manifest, "--out", out, config=None)
        for method in METHODS:
            words: list[object] = ["--method", method, *group, "--out", part / f"{method}.parquet"]
            if method in WITH_NETWORK:
                words += ["--model", WEIGHTS]
            if method == "constant":
                words += ["--medians", self.folder / "medians.json"]
            self.run(method, "eval", "reconstruct", *words)
        rows = [part / f"{method}.parquet" for method in METHODS]
        out = part / "measures.parquet"
        self.run("measure", "eval", "measure", *group, "--reconstructions", *rows, "--out", out)

    def report(self, manifest: Path, parts: list[Path]) -> int:
        """Run the report; returns the number of rows of the measures."""
        measures = [part / "measures.parquet" for part in parts]
        rows = [part / f"{method}.parquet" for part in parts for method in METHODS]
        place = ["--out", self.folder / "report", "--manifest", manifest]
        inputs = ["--measures", *measures, "--reconstructions", *rows, "--metrics"]
        self.run("report", "eval", "report", *place, *inputs)
        return sum(int(pq.read_metadata(path).num_rows) for path in measures)


def copied(table: pa.Table, copy: int) -> pa.Table:
    """The rows with another tile, which makes them other buildings."""
    tiles = pa.array([f"{copy:04d}/{tile}" for tile in table["tile"].to_pylist()])
    return table.set_column(table.schema.get_field_index("tile"), table.schema.field("tile"), tiles)


def copy_tables(paths: list[Path], copies: range, out: Path) -> None:
    """Write copies of the rows of tables of the same schema to one file."""
    schema = pq.read_schema(paths[0])
    with files.table_writer(out, schema) as writer:
        for copy in copies:
            for path in paths:
                writer.append_table(copied(pq.read_table(path), copy))
        writer.metadata = files.read_metadata(paths[0])


def copy_shards(manifest: Manifest, copies: range, folder: Path, thin: bool) -> list[tuple[str, Path]]:
    """Copies of the shards. thin: only the buildings that are evaluated, with a few points each."""
    shards = []
    for shard in manifest.shards:
        path, dataset = shard.path, shard.dataset
        table = files.read_table(path, CROPS)
        if thin:
            table = thinned(table.filter(pa.array(manifest.select(table, dataset, ["test"]))))
        for copy in copies:
            out = folder / dataset / f"{copy:04d}" / path.name
            with files.table_writer(out, CROPS) as writer:
                writer.append_table(copied(table, copy).cast(CROPS))
                writer.metadata = files.read_metadata(path)
            shards.append((dataset, out))
    return shards


def thinned(table: pa.Table) -> pa.Table:
    """The first points of each building."""
    for name in ("x_cm", "y_cm", "z_cm", "classification"):
        values = [row[:NUM_POINTS] for row in table[name].to_pylist()]
        index = table.schema.get_field_index(name)
        field = table.schema.field(name)
        table = table.set_column(index, field, pa.array(values, field.type))
    return table


def write_manifest(evaluation: Evaluation, shards: list[tuple[str, Path]], config: object) -> Path:
    """The manifest of shards, by the command."""
    out = evaluation.folder / "manifest.json"
    paths = {name: [path for dataset, path in shards if dataset == name] for name in (SIMULATED, REAL)}
    words = ["--simulated", *paths[SIMULATED], "--real", *paths[REAL], "--out", out]
    evaluation.run("manifest", "crops", "manifest", *words, config=json.dumps({"dataset": config}))
    return out


def copy_part(part: Path, copies: range, out: Path) -> None:
    """The part of a group of copies of all shards of ``part``."""
    (out / "cpu").mkdir(parents=True, exist_ok=True)
    for name in (*METHODS, "measures"):
        copy_tables([part / f"{name}.parquet"], copies, out / f"{name}.parquet")
    for path in part.rglob("*.json"):
        (out / path.relative_to(part)).write_bytes(path.read_bytes())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--manifest", type=Path, default=ROOT / "results/mini/crops/manifest.json")
    parser.add_argument("--buildings", type=int, default=NUM_BUILDINGS, help="of the largest data set")
    options = parser.parse_args()
    miniature, figures = read_manifest(options.manifest), Figures()
    with tempfile.TemporaryDirectory() as name:
        one, twenty, paper = (Evaluation(Path(name) / size) for size in ("miniature", "twenty", "paper"))
        for evaluation in (one, twenty, paper):
            evaluation.folder.mkdir()
        paths = [shard.path for shard in miniature.shards]
        part = one.folder / "parts/0000"
        one.evaluate(options.manifest, paths, part)
        num_rows = one.report(options.manifest, [part])
        num_buildings = int(pq.read_metadata(part / "lod1.parquet").num_rows)

        shards = copy_shards(miniature, range(NUM_COPIES), twenty.folder, thin=False)
        manifest = write_manifest(twenty, shards, {})
        copies = [f"{copy:04d}" for copy in range(NUM_PER_GROUP)]
        group = [path for _, path in shards if path.parent.name in copies]
        parts = [twenty.folder / f"parts/{i:04d}" for i in range(NUM_COPIES // NUM_PER_GROUP)]
        twenty.evaluate(manifest, group, parts[0])
        for i, other in enumerate(parts[1:], 1):
            copy_part(part, range(i * NUM_PER_GROUP, (i + 1) * NUM_PER_GROUP), other)
        if twenty.report(manifest, parts) != NUM_COPIES * num_rows:
            raise SystemExit("the merged measures lack rows")

        num_copies = -(-options.buildings // num_buildings)
        shards = copy_shards(miniature, range(num_copies), paper.folder, thin=True)
        counts = {"num_lidar_test": int(1e6), "num_lidar_dvae": 1, "num_pairs": int(1e7)}
        manifest = write_manifest(paper, shards, counts)
        ranges = np.array_split(np.arange(num_copies), max(num_copies // NUM_PER_GROUP, 1))
        parts = [paper.folder / f"parts/{i:04d}" for i in range(len(ranges))]
        for copies_of_group, other in zip(ranges, parts, strict=True):
            copy_part(part, range(copies_of_group[0], copies_of_group[-1] + 1), other)
        paper.report(manifest, parts)

    for evaluation in (one, twenty, paper):
        figures.row(f"{evaluation.folder.name}_peak_mib", evaluation.peak_mib)
    figures.row("buildings", {"miniature": num_buildings, "paper": num_buildings * num_copies})
    for stage, mib in one.peak_mib.items():
        figures.at_most(f"twenty_times_{stage}", twenty.peak_mib[stage] / mib, MAX_RATIO)
    figures.at_most("twenty_times", max(twenty.peak_mib.values()) / max(one.peak_mib.values()), MAX_RATIO)
    figures.at_most("paper_mib", max(paper.peak_mib.values()), MAX_MIB)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
