"""``p2wss doctor``: what this computer has, and what each missing piece costs."""

import os
import platform
import shutil
import tempfile
from importlib.metadata import PackageNotFoundError, version

import click

import p2wss
from p2wss.cli.parser import Command
from p2wss.storage.arguments import EXTRAS

# programs and packages: without them
COSTS = {
    "pyarrow": "no Parquet files: GeoParquet, wedges, those between the stages of the workflow",
    "torch": "no parametric roofs from the network, no training",
    "filelock": "no training",
    "embreex": "no simulated surveys",
    "matplotlib": "no report of the evaluation",
    "PIL": "no report of the evaluation",
    "snakemake": "no pipeline",
    "slurm": "profiles/slurm cannot be used: snakemake says that --executor slurm is an invalid choice",
    "pdal": "fetch prepare cannot classify clouds that have no ground",
    "nvidia-smi": "no GPU: training and the network run on the CPU",
    "roofer": "the evaluation uses recorded results of Roofer, or none",
}
_DISTRIBUTIONS = {"PIL": "pillow", "slurm": "snakemake-executor-plugin-slurm"}


@click.command(cls=Command)
def doctor() -> None:
    """Show what is installed, and what each missing piece costs."""
    from p2wss.reconstruction.compiled import marker

    compiled, scratch = marker(with_scans=False), tempfile.gettempdir()
    state = "compiled anew by each run: no folder can be written"
    if compiled is not None:
        state = "all" if compiled.exists() else "not all: the rest once it is needed, or now by p2wss warm-up"
    rows = {
        "p2wss": f"{p2wss.__version__}, Python {platform.python_version()}, {platform.machine()}",
        "cores": str(os.cpu_count()),
        "compiled code": state,
        "temporary files": f"{shutil.disk_usage(scratch).free / 1e9:.0f} GB free in {scratch}",
    }
    for package in (*EXTRAS, "slurm"):
        distribution = _DISTRIBUTIONS.get(package, package)
        try:
            rows[package] = version(distribution)
        except PackageNotFoundError:
            needed = f"'p2wss[{EXTRAS[package]}]'" if package in EXTRAS else distribution
            rows[package] = f"missing: {COSTS[package]}; pip install {needed}"
    programs = ("nvidia-smi", "pdal", "roofer")
    rows |= {program: shutil.which(program) or f"missing: {COSTS[program]}" for program in programs}
    for name, text in rows.items():
        print(f"{name:<16} {text}")
