"""Inputs of ``tests/real/*.yaml`` out of real data: footprints with the columns of BD TOPO, and links to the rest.

    python tests/real/make.py ../shared/data resources/real

The data, which is no part of this project: ``delft_ahn3`` (AHN3 with BGT footprints) and ``bresse_ign`` (IGN LiDAR
with BD Uni footprints), each with ``footprints.gpkg``, a cloud, ``dtm.asc`` and ``roofer_lod22.city.jsonl``,
what Roofer made of them.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import geopandas as gpd
import numpy as np

# data set: its cloud. The footprints have no heights; for the simulation they are drawn
SETS = {"delft_ahn3": "ahn3.laz", "bresse_ign": "lidar.laz"}


def make(data: Path, out: Path) -> None:
    """Write a folder per data set that is in ``data``."""
    for name, cloud in SETS.items():
        source, target = data / name, out / name
        if not source.is_dir():
            continue
        target.mkdir(parents=True, exist_ok=True)
        frame = gpd.read_file(source / "footprints.gpkg")
        frame["cleabs"] = frame["building_id"].astype(str)
        frame["hauteur"] = np.nan
        frame[["cleabs", "hauteur", "geometry"]].to_file(target / "footprints.gpkg", layer="batiment")
        for file in (cloud, "dtm.asc", "roofer_lod22.city.jsonl"):
            shutil.copy(source / file, target / file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    make(arguments.data, arguments.out)


if __name__ == "__main__":
    main()
