"""Clouds over boxes, and their footprints as a stage gets them."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pyproj
import shapely

from p2wss.clouds.reading import Cloud
from p2wss.config import Scenes
from p2wss.footprints import cleaning
from p2wss.storage.features import Features

LAMBERT, RD, WGS84 = (pyproj.CRS.from_epsg(code) for code in (2154, 28992, 4326))


def cloud_over(*boxes: shapely.Polygon) -> Cloud:
    """Points at 8 m over boxes, and ground at 2 m around."""
    draw = np.random.default_rng(0)
    parts = [
        np.column_stack([draw.uniform(b.bounds[:2], b.bounds[2:], (300, 2)), np.full(300, 8.0)])
        for b in boxes
    ]
    ring = [
        np.array([[b.bounds[0] - 0.5, y, 2.0] for y in np.linspace(b.bounds[1], b.bounds[3], 30)])
        for b in boxes
    ]
    x, y, z = np.concatenate([*parts, *ring]).T
    classes = np.r_[np.full(300 * len(boxes), 6), np.full(30 * len(boxes), 2)].astype(np.uint8)
    return Cloud(x, y, z, classes, LAMBERT)


def cleaned(frame: gpd.GeoDataFrame) -> Features:
    return cleaning.clean_footprints(Features.of(frame), Scenes())
