"""A cloud over one building, its footprint and a file of weights, and ``p2wss reconstruct`` on them."""

from __future__ import annotations

import json
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pyproj
import shapely
from safetensors.numpy import save_file

from p2wss import cli

BOX = shapely.box(652000, 6861000, 652010, 6861008)


def write_survey(folder: Path) -> None:
    """cloud.laz (one building, Lambert-93), footprints.gpkg and m.safetensors, which states to be a model."""
    write_cloud(folder / "cloud.laz")
    gpd.GeoDataFrame({"cleabs": ["A"]}, geometry=[BOX], crs=2154).to_file(folder / "footprints.gpkg")
    write_weights(folder / "m.safetensors")


def write_cloud(path: Path, roof_class: int = 6, ground_class: int = 2, crs: int | None = 2154) -> None:
    """A flat roof at 107 m on ground at 101 m."""
    draw = np.random.default_rng(0)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.01), np.array([652000, 6861000, 0])
    if crs is not None:
        header.add_crs(pyproj.CRS.from_epsg(crs))
    las = laspy.LasData(header)
    las.x = np.r_[draw.uniform(652000, 652010, 400), draw.uniform(651999.2, 651999.8, 50)]
    las.y = draw.uniform(6861000, 6861008, 450)
    las.z = np.r_[np.full(400, 107.0), np.full(50, 101.0)]
    las.classification = np.r_[np.full(400, roof_class), np.full(50, ground_class)].astype(np.uint8)
    las.write(path)


def write_weights(path: Path, kind: str = "model") -> Path:
    """A file that states to be weights, and has none."""
    save_file({}, path, {"p2wss": json.dumps({"kind": kind})})
    return path


def run(place: Path, *more: str, cloud: str = "cloud.laz", footprints: str = "footprints.gpkg") -> int:
    files = [str(place / name) for name in (cloud, footprints, "out")]
    return cli.main(["reconstruct", *files, "--model", str(place / "m.safetensors"), *more])
