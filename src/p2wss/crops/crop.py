"""Stage crops: the points of each building, from a simulated scan or from real LiDAR (paper, section 5.1)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pyarrow as pa
import pyproj

from p2wss.config import Crops
from p2wss.crops.kernels import count_distinct, count_true, gather_cm, medians, own_kinds, walls_seen
from p2wss.crops.splits import assign_splits
from p2wss.data import files, polygon_arrays, tiling
from p2wss.data.clouds import Cloud, read_clouds, same_crs
from p2wss.data.cropping import seen_share
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS
from p2wss.data.points import GROUND_RINGS_M, Cropped, crop_cloud
from p2wss.data.schemas.crops import CROPS
from p2wss.errors import InputError
from p2wss.skeleton.types import FaceKind, Polygons

_REACH_M = 320.0  # int16 centimetres end at 327 m
_NOT_INT16 = -32768
_WALL_SEEN_POINTS = 10


def crop_simulated(
    buildings: pa.Table, scan: tuple[Cloud, np.ndarray, np.ndarray], settings: Crops
) -> tuple[dict[str, Any], Counter[str]]:
    """Rows of ``io.CROPS`` for the buildings of one tile, with labels, and the number left out per reason.

    ``buildings`` has the columns of ``io.BUILDINGS``; those of the margin only decide which rows are on
    guard.
    """
    cloud, building_of_point, face = scan
    polygons = _absolute(buildings)
    split = assign_splits(polygons, settings)
    left_out: Counter[str] = Counter()
    own = np.flatnonzero(buildings["in_tile"].to_numpy())
    status = np.array(buildings["status"].to_pylist(), dtype=object)
    left_out.update(status[own][status[own] != "ok"].tolist())
    rows = own[status[own] == "ok"]
    origin = np.stack([buildings["origin_x_m"].to_numpy(), buildings["origin_y_m"].to_numpy()], axis=1)

    chosen = polygon_arrays.take(polygons, rows)
    cropped = crop_cloud(cloud, chosen, settings.buffer_m)
    kind = own_kinds(building_of_point, face, cropped.point, cropped.offset, rows)
    on_roof = (kind == FaceKind.ROOF) | (kind == FaceKind.FLAT)
    on_wall = kind == FaceKind.WALL
    kept, columns = _rows(cloud, cropped, chosen, origin[rows], on_roof, settings, left_out)
    labels = buildings.take(rows[kept])
    columns |= {name: labels[name].combine_chunks() for name in _LABELS}
    columns |= {
        "label_terrain_z_m": labels["terrain_z_m"].combine_chunks(),
        "split": split[rows[kept]],
        "num_wall_points": count_true(on_wall, cropped.offset)[kept].astype(np.int32),
        "num_walls_seen": walls_seen(face, cropped.point, on_wall, cropped.offset, _WALL_SEEN_POINTS)[kept],
    }
    return columns, left_out


def crop_real(
    frame: gpd.GeoDataFrame,
    clouds: Sequence[str | Path],
    tile: str,
    tile_size_m: float,
    settings: Crops,
) -> tuple[dict[str, Any], Counter[str]]:
    """Rows of ``io.CROPS`` without labels for the footprints whose middle is in ``tile``, and what was
    left out.

    ``frame`` is what ``scenes.clean_footprints`` gives: ``building_id``, ``status``, the middle of each
    footprint, which decides its tile as in the scenes, and polygons in its CRS. ``clouds`` are the tile's
    and its neighbours' files. Raises :class:`InputError` if a cloud is unreadable or in another CRS.
    """
    bounds = tiling.tile_bounds(tile, tile_size_m)
    frame = frame[np.isfinite(frame["middle_x_m"])]
    own = frame[tiling.tiles_of_points(frame["middle_x_m"], frame["middle_y_m"], tile_size_m) == tile]
    usable = own["status"].to_numpy() == "ok"
    left_out = Counter(own["status"].to_numpy()[~usable])
    own = own[usable]
    polygons = polygon_arrays.to_polygons(own.geometry.to_numpy())
    cloud = read_clouds(clouds, _bounds_around(polygons, bounds))
    check_crs(cloud.crs, frame.crs, f"{clouds[0]}")

    cropped = crop_cloud(cloud, polygons, settings.buffer_m)
    classification = cloud.classification[cropped.point]
    on_roof = (classification == BUILDING_CLASS) & cropped.inside
    # a classifier may miss a building altogether: then all that is above it counts
    missed = np.repeat(count_true(on_roof, cropped.offset) == 0, np.diff(cropped.offset))
    on_roof |= missed & cropped.inside & (classification != GROUND_CLASS)
    kept, columns = _rows(
        cloud, cropped, polygons, polygon_arrays.origins(polygons), on_roof, settings, left_out
    )
    for field in CROPS:
        if field.nullable:
            columns[field.name] = pa.nulls(len(kept), field.type)
    columns["building_id"] = own["building_id"].to_numpy()[kept]
    columns["tile"] = np.full(len(kept), tile, dtype=object)
    columns["split"] = np.full(len(kept), "none", dtype=object)
    return columns, left_out


def check_crs(cloud: pyproj.CRS | None, wanted: Any, name: str) -> None:
    """Raise :class:`InputError` if a cloud tells another CRS than ``wanted``; one that tells none is
    believed."""
    wanted = pyproj.CRS.from_user_input(wanted) if wanted is not None else None
    if cloud is not None and wanted is not None and not same_crs(cloud, wanted):
        raise InputError(
            f"{name} is in {cloud.name}, but the footprints are in {wanted.name}; reproject one of them"
        )


def _bounds_around(polygons: Polygons, bounds: tiling.Bounds) -> tiling.Bounds:
    """What a cloud must cover: the polygons (the tile if there are none) and the ground around them."""
    low = polygons.xy_m.min(axis=0, initial=np.inf)
    high = polygons.xy_m.max(axis=0, initial=-np.inf)
    if not len(polygons.xy_m):
        low, high = np.array(bounds[:2]), np.array(bounds[2:])
    margin_m = GROUND_RINGS_M[-1]
    return (
        float(low[0]) - margin_m,
        float(low[1]) - margin_m,
        float(high[0]) + margin_m,
        float(high[1]) + margin_m,
    )


_LABELS = ("building_id", "tile", "eave_height_m", "angle_deg", "roof_type")


def _absolute(buildings: pa.Table) -> Polygons:
    """Footprints in the CRS of the file."""
    local = polygon_arrays.from_columns(buildings)
    origin = np.stack([buildings["origin_x_m"].to_numpy(), buildings["origin_y_m"].to_numpy()], axis=1)
    return Polygons(local.xy_m + _per_vertex(local, origin), local.ring_offset, local.polygon_offset)


def _per_vertex(polygons: Polygons, value: np.ndarray) -> np.ndarray:
    return np.repeat(value, np.diff(polygons.vertex_offset), axis=0)


def _rows(
    cloud: Cloud,
    cropped: Cropped,
    polygons: Polygons,
    origin_xy_m: np.ndarray,
    on_roof: np.ndarray,
    settings: Crops,
    left_out: Counter[str],
) -> tuple[np.ndarray, dict[str, Any]]:
    """Which polygons make a row, and the columns of ``io.CROPS`` that simulated and real clouds share.

    Adds to ``left_out`` the number of polygons that are too large or have too few points.
    """
    offset = cropped.offset
    local = Polygons(
        polygons.xy_m - _per_vertex(polygons, origin_xy_m), polygons.ring_offset, polygons.polygon_offset
    )
    origin_z_m = np.round(medians(cloud.z_m, cropped.point, offset))
    x_cm = gather_cm(cloud.x_m, cropped.point, offset, origin_xy_m[:, 0].copy())
    y_cm = gather_cm(cloud.y_m, cropped.point, offset, origin_xy_m[:, 1].copy())
    z_cm = gather_cm(cloud.z_m, cropped.point, offset, origin_z_m)
    usable = z_cm != _NOT_INT16  # what is 300 m above or below the rest is no part of the building

    reach = np.abs(local.xy_m).max(axis=1) + settings.buffer_m
    large = count_true(reach > _REACH_M, local.vertex_offset) > 0
    few = ~large & (count_true(usable, offset) < settings.min_points)
    left_out["too-large"] += int(large.sum())
    left_out["too-few-points"] += int(few.sum())
    kept = np.flatnonzero(~(large | few))
    strip = np.zeros(len(cloud), np.uint16) if cloud.strip is None else cloud.strip
    pairs = usable & np.repeat(~(large | few), np.diff(offset))
    chosen = slice(None) if pairs.all() else pairs  # mostly nothing is left out, and nothing copied
    num_points = count_true(usable, offset)[kept]
    point_offset = np.concatenate([[0], np.cumsum(num_points)])
    shape = polygon_arrays.take(local, kept)
    columns = {
        "num_points": num_points.astype(np.int32),
        "origin_x_m": origin_xy_m[kept, 0],
        "origin_y_m": origin_xy_m[kept, 1],
        "origin_z_m": origin_z_m[kept],
        "x_cm": files.ragged(x_cm[chosen], point_offset),
        "y_cm": files.ragged(y_cm[chosen], point_offset),
        "z_cm": files.ragged(z_cm[chosen], point_offset),
        "classification": files.ragged(cloud.classification[cropped.point[chosen]], point_offset),
        **polygon_arrays.to_columns(shape, np.zeros((len(kept), 2))),
        "ground_z_m": cropped.ground_z_m[kept],
        "num_roof_points": count_true(on_roof & usable, offset)[kept].astype(np.int32),
        "num_strips": count_distinct(strip, cropped.point, offset)[kept],
        "is_truncated": num_points > settings.max_points,
        "visible_roof_share": seen_share(
            x_cm[chosen],
            y_cm[chosen],
            on_roof[chosen],
            point_offset,
            shape.xy_m,
            shape.ring_offset,
            shape.polygon_offset,
        ),
    }
    return kept, columns
