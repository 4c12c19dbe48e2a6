"""The points that a roof is fitted to."""

from __future__ import annotations

import numpy as np
import shapely

from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS

# noise and water, withheld or not
_NO_ROOF_CLASSES = (GROUND_CLASS, 7, 9, 18)
# with fewer points of class 6 a classifier has missed the building
_ENOUGH = 10
_ABOVE_GROUND_M = 2.0
_CELL_M = 0.5


def roof_points(
    polygon: shapely.Polygon, point_m: np.ndarray, classification: np.ndarray, ground_z_m: float
) -> np.ndarray:
    """The points (k, 3) inside the polygon that show its roof: those of class 6, or, if there are fewer than
    ten, all that are neither ground, noise nor water and at least 2 m above the ground.

    Never those of the ring around the footprint: in a row of houses they belong to the neighbours.
    """
    if not len(point_m):
        return point_m
    inside = shapely.contains_xy(polygon, point_m[:, 0], point_m[:, 1])
    chosen = inside & (classification == BUILDING_CLASS)
    if np.count_nonzero(chosen) < _ENOUGH:
        above = point_m[:, 2] - ground_z_m >= _ABOVE_GROUND_M
        others = inside & ~np.isin(classification, _NO_ROOF_CLASSES) & above
        chosen = others if others.any() else chosen
    return point_m[chosen]


def even_order(point_m: np.ndarray) -> np.ndarray:
    """Indices of points (m, 3) along a space-filling curve, whatever their order in the file: every k-th of
    them is an even sample."""
    cell = np.floor((point_m[:, :2] - point_m[:, :2].min(axis=0)) / _CELL_M).astype(np.uint64)
    code = _spread(cell[:, 0]) | (_spread(cell[:, 1]) << np.uint64(1))
    x, y, z = point_m.T
    order = np.lexsort((x, code))
    tie = (code[order[1:]] == code[order[:-1]]) & (x[order[1:]] == x[order[:-1]])
    return np.lexsort((z, y, x, code)) if tie.any() else order


def every_kth(num_points: int, wanted: int) -> np.ndarray:
    """Indices of at most ``wanted`` evenly spaced ones."""
    if num_points <= wanted:
        return np.arange(num_points)
    return ((np.arange(wanted) + 0.5) * num_points / wanted).astype(np.int64)


def _spread(value: np.ndarray) -> np.ndarray:
    """The lower 16 bits of each number, a zero between any two."""
    value = value & np.uint64(0xFFFF)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        value = (value | (value << np.uint64(shift))) & np.uint64(mask)
    return value
