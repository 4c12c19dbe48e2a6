"""Crop the points of each building from a simulated scan, with labels."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from p2wss.clouds.crops import crop_cloud
from p2wss.clouds.reading import Cloud
from p2wss.clouds.scan_files import read_scan
from p2wss.config import Crops
from p2wss.crops.rows import count_true, crop_columns
from p2wss.crops.splits import assign_splits
from p2wss.data import polygon_arrays
from p2wss.data.crs import check_crs
from p2wss.skeleton.types import FaceKind

Scan = tuple[Cloud, np.ndarray, np.ndarray]
_LABELS = ("building_id", "tile", "eave_height_m", "angle_deg", "roof_type")


def scan_of(path: Path, crs: str) -> Scan:
    """The scan in a file (:func:`p2wss.clouds.scan_files.read_scan`). Raises :class:`InputError` if its CRS is not
    ``crs``, the CRS of the buildings."""
    scan = read_scan(path)
    check_crs(scan[0].crs, crs, path, "the footprints are", "reproject one of them")
    return scan


def crop_simulated(buildings: pa.Table, scan: Scan, settings: Crops) -> tuple[dict[str, Any], Counter[str]]:
    """The columns of :data:`p2wss.storage.schemas.crops.CROPS` with labels, and the number of excluded buildings per
    reason.

    buildings: the columns of :data:`p2wss.storage.schemas.buildings.BUILDINGS`. Buildings in the margin of the tile are
    not cropped, but may make buildings of the tile guards (:func:`p2wss.crops.splits.assign_splits`). scan: see
    :func:`scan_of`.
    """
    cloud, building_of_point, face_of_point = scan
    polygons = polygon_arrays.in_crs(buildings)
    split = assign_splits(polygons, settings)
    num_excluded: Counter[str] = Counter()
    tile_rows = np.flatnonzero(buildings["in_tile"].to_numpy())
    status = np.array(buildings["status"].to_pylist(), dtype=object)[tile_rows]
    num_excluded.update(status[status != "ok"].tolist())
    rows = tile_rows[status == "ok"]

    footprints = polygon_arrays.take(polygons, rows)
    cropped = crop_cloud(cloud, footprints, settings.buffer_m)
    is_own = building_of_point[cropped.point] == np.repeat(rows, np.diff(cropped.offset))
    kind = np.where(is_own, face_of_point[cropped.point] & 3, 0)
    on_roof = (kind == FaceKind.ROOF) | (kind == FaceKind.FLAT)
    on_wall = kind == FaceKind.WALL
    origin_xy_m = np.column_stack([buildings["origin_x_m"].to_numpy(), buildings["origin_y_m"].to_numpy()])
    selection, columns = crop_columns(
        cloud, cropped, footprints, origin_xy_m[rows], on_roof, settings, num_excluded
    )
    labels = buildings.take(rows[selection])
    columns |= {name: labels[name].combine_chunks() for name in _LABELS}
    columns |= {
        "label_terrain_z_m": labels["terrain_z_m"].combine_chunks(),
        "split": split[rows[selection]],
        "num_wall_points": count_true(on_wall, cropped.offset)[selection].astype(np.int32),
    }
    return columns, num_excluded
