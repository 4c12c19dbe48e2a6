"""The points that a roof is fitted to."""

from __future__ import annotations

import numpy as np
import shapely

from p2wss.data.las_classes import GROUND_CLASS
from p2wss.data.points import points_on_building

_CELL_M = 0.5


def roof_points(
    polygon: shapely.Polygon, point_m: np.ndarray, classification: np.ndarray, ground_z_m: float
) -> np.ndarray:
    """The points (k, 3) on the building over the polygon, which show its roof."""
    return point_m[points_on_building(polygon, point_m, classification, ground_z_m)]


def ground_points(
    polygon: shapely.Polygon, point_m: np.ndarray, classification: np.ndarray, inside_m: float
) -> np.ndarray:
    """The points (k, 3) of class ground that lie more than ``inside_m`` within the polygon, where a roof would hide
    the ground."""
    ground_m = point_m[classification == GROUND_CLASS]
    if not shapely.contains_xy(polygon, ground_m[:, 0], ground_m[:, 1]).any():
        return np.zeros((0, 3))
    within = polygon.buffer(-inside_m)
    return ground_m[shapely.contains_xy(within, ground_m[:, 0], ground_m[:, 1])]


def even_order(point_m: np.ndarray) -> np.ndarray:
    """Indices of points (m, 3) along a space-filling curve, whatever their order in the file. Every k-th point in
    this order makes an even sample."""
    cell = np.floor((point_m[:, :2] - point_m[:, :2].min(axis=0)) / _CELL_M).astype(np.uint64)
    code = _spread(cell[:, 0]) | (_spread(cell[:, 1]) << np.uint64(1))
    x, y, z = point_m.T
    order = np.lexsort((x, code))
    tie = (code[order[1:]] == code[order[:-1]]) & (x[order[1:]] == x[order[:-1]])
    return np.lexsort((z, y, x, code)) if tie.any() else order


def every_kth(num_points: int, max_count: int) -> np.ndarray:
    """At most ``max_count`` of the indices 0 to ``num_points`` - 1, evenly spaced."""
    if num_points <= max_count:
        return np.arange(num_points)
    return ((np.arange(max_count) + 0.5) * num_points / max_count).astype(np.int64)


def _spread(value: np.ndarray) -> np.ndarray:
    """The lower 16 bits of each number with a zero bit between any two."""
    value = value & np.uint64(0xFFFF)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        value = (value | (value << np.uint64(shift))) & np.uint64(mask)
    return value
