"""CPU time of a dry run of the miniature. Every job of a cluster pays it again, as each job parses the Snakefile.

    python benchmarks/parsing.py

Needs Snakemake, no data.

Medians of three, in a fresh folder without results, against a bare import of Snakemake. The last line is JSON.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from figures import Figures

ROOT = Path(__file__).resolve().parents[1]
PARTS = ("Snakefile", "workflow", "profiles", "config", "envs", "models", "tests")
REPEATS = 3
BAR_S = 3.0


def cpu_seconds_of(command: list[str], folder: Path) -> float:
    """User and system time of a program and of the processes that it waits for; the median of a few runs after one that
    is not measured."""
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    seconds = []
    for _ in range(1 + REPEATS):
        before = os.times()
        run = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        after = os.times()
        if run.returncode:
            raise SystemExit(f"{' '.join(command)}:\n{run.stdout}{run.stderr}")
        seconds.append(
            after.children_user - before.children_user + after.children_system - before.children_system
        )
    return round(statistics.median(seconds[1:]), 2)


def main() -> int:
    figures = Figures()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in PARTS:
            (folder / part).symlink_to(ROOT / part)
        bare = cpu_seconds_of([sys.executable, "-c", "import snakemake.cli"], folder)
        config = cpu_seconds_of([sys.executable, "-c", "import snakemake.cli, p2wss.config"], folder)
        dry_run = cpu_seconds_of([sys.executable, "-m", "snakemake", "-n"], folder)
    print(f"import of snakemake.cli    {bare:.2f} CPU-seconds")
    print(f"import of the config too   {config:.2f}")
    print(f"snakemake -n               {dry_run:.2f}")
    figures.row("cpu_s", {"import_snakemake": bare, "import_config": config, "dry_run": dry_run})
    figures.at_most("dry_run_above_import_cpu_s", dry_run - bare, BAR_S)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
