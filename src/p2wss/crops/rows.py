"""The columns of crops that are the same for simulated and for real clouds."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import Any

import numpy as np

from p2wss.clouds.cropping import seen_share
from p2wss.clouds.crops import CloudCrops
from p2wss.clouds.reading import Cloud
from p2wss.config import Crops
from p2wss.data import polygon_arrays, reasons
from p2wss.skeleton.types import Polygons
from p2wss.storage import files

_MAX_REACH_M = 320.0  # int16 centimetres end at 327 m
_OUT_OF_RANGE = -32768


def crop_columns(
    cloud: Cloud,
    cropped: CloudCrops,
    polygons: Polygons,
    origin_xy_m: np.ndarray,
    on_roof: np.ndarray,
    settings: Crops,
    num_excluded: Counter[str],
) -> tuple[np.ndarray, dict[str, Any]]:
    """The indices of the polygons that get a row, and their columns of :data:`p2wss.storage.schemas.crops.CROPS`.

    cropped: the crops of ``polygons`` from ``cloud``. origin_xy_m: float64 (num_polygons, 2). on_roof: bool
    (num_pairs,), which of the cropped points are on the roof of their building. Polygons that are too large or have too
    few points are excluded, and added to ``num_excluded``.
    """
    offset = cropped.offset
    num_pairs = np.diff(offset)
    local = polygon_arrays.moved(polygons, -origin_xy_m)
    heights = np.split(cloud.z_m[cropped.point], offset[1:-1])
    origin_z_m = np.round([np.median(z) if len(z) else np.nan for z in heights[: len(polygons)]])

    def relative_cm(value_m: np.ndarray, origin_m: np.ndarray) -> np.ndarray:
        value_cm = np.rint(100 * (value_m[cropped.point] - np.repeat(origin_m, num_pairs)))
        return np.where(np.abs(value_cm) <= 32767, value_cm, _OUT_OF_RANGE).astype(np.int16)

    x_cm = relative_cm(cloud.x_m, origin_xy_m[:, 0])
    y_cm = relative_cm(cloud.y_m, origin_xy_m[:, 1])
    z_cm = relative_cm(cloud.z_m, origin_z_m)
    in_range = z_cm != _OUT_OF_RANGE  # points 300 m above or below the others do not belong to the building

    reach_m = np.abs(local.xy_m).max(axis=1) + settings.buffer_m
    is_large = count_true(reach_m > _MAX_REACH_M, local.vertex_offset) > 0
    has_few = ~is_large & (count_true(in_range, offset) < settings.min_points)
    num_excluded[reasons.TOO_LARGE] += int(is_large.sum())
    num_excluded[reasons.TOO_FEW_POINTS] += int(has_few.sum())
    is_row = ~(is_large | has_few)
    selection = np.flatnonzero(is_row)
    mask = in_range & np.repeat(is_row, num_pairs)
    pairs = slice(None) if mask.all() else mask  # mostly all pairs are used, and none need be copied
    num_points = count_true(in_range, offset)[selection]
    point_offset = np.concatenate([[0], np.cumsum(num_points)])
    footprints = polygon_arrays.take(local, selection)
    shapes = polygon_arrays.to_geometries(footprints)
    xy_m, is_on = np.column_stack([x_cm[pairs], y_cm[pairs]]) / 100, on_roof[pairs]
    columns = {
        "num_points": num_points.astype(np.int32),
        "origin_x_m": origin_xy_m[selection, 0],
        "origin_y_m": origin_xy_m[selection, 1],
        "origin_z_m": origin_z_m[selection],
        "x_cm": files.ragged(x_cm[pairs], point_offset),
        "y_cm": files.ragged(y_cm[pairs], point_offset),
        "z_cm": files.ragged(z_cm[pairs], point_offset),
        "classification": files.ragged(cloud.classification[cropped.point[pairs]], point_offset),
        **polygon_arrays.to_columns(footprints, np.zeros((len(selection), 2))),
        "ground_z_m": cropped.ground_z_m[selection],
        "num_roof_points": count_true(on_roof & in_range, offset)[selection].astype(np.int32),
        "visible_roof_share": np.array(
            [
                seen_share(shape, *xy_m[first:last][is_on[first:last]].T)
                for shape, (first, last) in zip(shapes, pairwise(point_offset), strict=True)
            ],
            np.float32,
        ),
    }
    return selection, columns


def count_true(mask: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Number of true values of ``mask`` in each slice ``offset[i]:offset[i + 1]``, int64 (len(offset) - 1,)."""
    return np.diff(np.concatenate([[0], np.cumsum(mask)])[offset])
