"""The polygon of two parts of a footprint that touch along a cut."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

# parts touch along at least this length
_MIN_CONTACT_M = 0.4
_STRAIGHT = 1e-7


def merged_rings(rings: Sequence[np.ndarray], other_rings: Sequence[np.ndarray]) -> list[np.ndarray] | None:
    """The rings of the union of two polygons, exterior first and counter-clockwise; None unless they touch along an
    edge and their union is one polygon. Vertices within a straight edge are dropped."""
    low, high = rings[0].min(axis=0), rings[0].max(axis=0)
    other_low, other_high = other_rings[0].min(axis=0), other_rings[0].max(axis=0)
    if (low > other_high + 1e-9).any() or (other_low > high + 1e-9).any():
        return None
    polygon = shapely.Polygon(rings[0], rings[1:])
    other = shapely.Polygon(other_rings[0], other_rings[1:])
    if polygon.intersection(other).length < _MIN_CONTACT_M:
        return None
    union = polygon.union(other)
    if not isinstance(union, shapely.Polygon):
        return None
    union = shapely.orient_polygons(union, exterior_cw=False)
    return [_without_straight(np.asarray(ring.coords)[:-1]) for ring in (union.exterior, *union.interiors)]


def _without_straight(ring: np.ndarray) -> np.ndarray:
    before, after = ring - np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0) - ring
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    size = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    return ring[np.abs(cross) > _STRAIGHT * size]
