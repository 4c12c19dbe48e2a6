"""Sionna RT in a reconstructed scene: time to load it, faces seen from behind, paths where roofs are shapes or not.

Usage::

    python benchmarks/sionna_rt.py --data ../shared/data

Needs Sionna RT, and data that are not part of the project.

``--data`` holds ``delft_ahn3`` (74 row houses). Sionna RT is run by the interpreter of ``--sionna``, by default that of
the environment that ``pytest -m slow tests/unit/formats/test_sionna_rt.py`` makes; ``DRJIT_LIBLLVM_PATH`` names an
LLVM for it. Paths lead from one transmitter above the roofs to 16 receivers above them and 32 low ones, with one
reflection or diffraction.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import rasterio
from figures import Figures

from p2wss import cli

SCRIPT = Path(__file__).parents[1] / "tests/unit/sionna_tracing.py"
DEFAULT = Path.home() / ".cache/p2wss-tests/sionna-rt-2.2.0/bin/python"
SCENES = {
    "a shape per building": [],
    "a shape per block (--skin)": ["--skin"],
    "a shape per material (--split-materials)": ["--materials", "roof=tile", "--split-materials"],
}
MAX_LOAD_S = 2.0


def traced(python: Path, data: Path, folder: Path, options: list[str]) -> dict:
    """What ``tests/unit/sionna_tracing.py`` measures in the scene that these options make."""
    terrain = folder / "dtm.tif"
    with rasterio.open(data / "dtm.asc") as source:
        profile = source.profile | {"driver": "GTiff", "crs": "EPSG:28992"}
        with rasterio.open(terrain, "w", **profile) as target:
            target.write(source.read())
    files = [str(data / "ahn3.laz"), str(data / "footprints.gpkg"), str(folder)]
    status = cli.main(["reconstruct", *files, "--format", "sionna", "--terrain", str(terrain), *options])
    assert status == 0
    run = subprocess.run([python, SCRIPT, folder / "ahn3_sionna"], capture_output=True, text=True, check=True)
    return json.loads(run.stdout.splitlines()[-1])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--sionna", type=Path, default=DEFAULT, help="interpreter that has Sionna RT")
    arguments = parser.parse_args()
    figures = Figures()
    rows = {}
    for name, options in SCENES.items():
        with tempfile.TemporaryDirectory() as folder:
            answer = traced(arguments.sionna, arguments.data / "delft_ahn3", Path(folder), options)
        behind = answer["down"][1] + answer["slanted"][1]
        rows[name] = {
            "shapes": len(answer["shapes"]),
            "load_s": answer["load_s"],
            "rays": answer["down"][0] + answer["slanted"][0],
            "behind": behind,
            "reflected": answer["reflected"],
            "diffracted": answer["diffracted"],
            "cells": answer["cells"],
            "map_s": answer["map_s"],
        }
        print(f"{name}: {rows[name]}")
        figures.row(name, rows[name])
    figures.at_most("rays that meet a face from behind", sum(row["behind"] for row in rows.values()), 0)
    figures.at_most("longest load, s", max(row["load_s"] for row in rows.values()), MAX_LOAD_S)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
