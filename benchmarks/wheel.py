"""The first minutes of a new user: the wheel in an empty environment, without the checkout, up to a page of buildings.

    python benchmarks/wheel.py

Builds the wheel, installs it without extras, and runs ``p2wss demo``, ``p2wss view``, ``p2wss check``, ``config``
and ``p2wss workflow init`` in an empty folder, and there a stage of the pipeline. Needs a package index, or a warm
cache of pip. Most of what is installed is llvmlite, scipy, pandas and two copies of GDAL. CPU time, which other work
on the machine changes little; what is measured uses one core. The last line is JSON.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from figures import Figures

ROOT = Path(__file__).resolve().parents[1]
# must not be installed, as they were before extras existed: torch with CUDA, Snakemake and others
_FORBIDDEN = ("torch", "snakemake", "embreex", "matplotlib", "pyarrow")


def size_mb(folder: Path) -> float:
    """The size of all files in a folder, megabytes."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def main() -> int:
    figures = Figures()
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)

        def run(*words: str | Path, below: str = "") -> float:
            start = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([str(word) for word in words], cwd=folder / below, env=environment, check=True)
            end = resource.getrusage(resource.RUSAGE_CHILDREN)
            return end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime

        # a copy, since setuptools leaves folders beside the sources
        run("git", "clone", "--quiet", "--depth", "1", ROOT.as_uri(), folder / "source")
        run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, folder / "source")
        (wheel,) = folder.glob("*.whl")
        run(sys.executable, "-m", "venv", "--without-pip", "venv")
        python, program = folder / "venv/bin/python", folder / "venv/bin/p2wss"
        install_s = run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", wheel)
        packages = next((folder / "venv/lib").glob("*/site-packages"))
        installed_mb = size_mb(packages)
        demo_s = run(program, "demo")
        run(program, "view", "p2wss-demo/out")
        run(program, "check", "p2wss-demo/out/lidar.city.json")
        run(program, "config", "--schema")
        run(program, "workflow", "init", "project")
        run(program, "fetch", "footprints", "--out", "footprints.gpkg", below="project")
        summary = json.loads((folder / "p2wss-demo/out/lidar.json").read_text(encoding="utf-8"))["buildings"]
        page_kb = (folder / "p2wss-demo/out/lidar.html").stat().st_size / 1e3
        present = [name for name in _FORBIDDEN if (packages / name).exists()]
    figures.row("wheel", {"buildings of the demo": summary["total"], "page, kB": round(page_kb)})
    figures.at_most("installed, MB", round(installed_mb), 1000)
    figures.at_most("installation, CPU s", round(install_s), 60)
    figures.at_most("demo with its compilation, CPU s", round(demo_s), 90)
    figures.at_most("from nothing to a picture, CPU s", round(install_s + demo_s), 120)
    figures.at_most("packages of extras", len(present), 0)
    figures.at_most("buildings without a mesh", summary["status"].get("none", 0), 0)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
