"""Compiles all that the simulated survey calls, by surveying one small made-up house."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from p2wss import skeleton
from p2wss.config import Scans
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import tile_bounds
from p2wss.scans.scan import simulate
from p2wss.storage.schemas.buildings import BUILDINGS

_TILE, _TILE_SIZE_M, _MARGIN_M = "0652500_6862000", 100.0, 40.0
_DENSITY_PER_M2 = 2.0


def warm_survey() -> None:
    """A survey of each preset."""
    x_min, _, x_max, y_max = tile_bounds(_TILE, _TILE_SIZE_M, _MARGIN_M)
    size = int(x_max - x_min)
    terrain = Terrain(
        np.random.default_rng(0).uniform(80, 81, (size, size)).astype(np.float32), x_min, y_max, 1.0
    )
    for preset in ("none", "paper", "hd"):
        settings = Scans(preset=preset, density_per_m2=_DENSITY_PER_M2)
        simulate(_house(), terrain, _TILE, _TILE_SIZE_M, settings)


def _house() -> pa.Table:
    """A row of ``schemas.buildings.BUILDINGS`` with a gable roof, in the middle of the tile."""

    x_min, y_min, _, _ = tile_bounds(_TILE, _TILE_SIZE_M)
    corners, angle_deg = np.array([[0, 0], [10, 0], [10, 12], [0, 12.0]]), np.array([90.0, 40.0, 90.0, 40.0])
    built = skeleton.build(
        skeleton.Polygons.from_rings([[corners]]), angle_deg, np.full(1, 6.0), base_height_m=-1.0
    )
    vertex_m, triangle, kind, edge = built.mesh(0)
    row = {
        "building_id": "house",
        "tile": _TILE,
        "in_tile": True,
        "status": "ok",
        "eave_height_m": 6.0,
        "terrain_z_m": 80.5,
        "base_z_m": 79.5,
        "roof_type": "gable",
        "angle_deg": angle_deg,
        "origin_x_m": x_min + 45.0,
        "origin_y_m": y_min + 45.0,
        "footprint_xy_m": corners.ravel(),
        "ring_offset": [0, 4],
        "vertex_xyz_m": vertex_m.ravel(),
        "triangle": triangle.ravel(),
        "triangle_kind": kind,
        "triangle_edge": edge,
    }
    return pa.table({f.name: pa.array([row[f.name]], f.type) for f in BUILDINGS}, schema=BUILDINGS)
