"""The polygon of two parts of a footprint that touch along a cut."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from p2wss.skeleton.compiled import entry

# parts touch along at least this length
_MIN_CONTACT_M = 0.4
_STRAIGHT = 1e-7


def merged_rings(rings: Sequence[np.ndarray], other_rings: Sequence[np.ndarray]) -> list[np.ndarray] | None:
    """The rings of the union of two polygons, exterior first and counter-clockwise; None unless they touch along an
    edge parallel to an axis, as the two sides of a cut do, and their union is one polygon. Vertices within a straight
    edge are dropped."""
    low, high = rings[0].min(axis=0), rings[0].max(axis=0)
    other_low, other_high = other_rings[0].min(axis=0), other_rings[0].max(axis=0)
    if (low > other_high + 1e-9).any() or (other_low > high + 1e-9).any():
        return None
    contact_m = sum(_contact_m(ring, other) for ring in rings for other in other_rings)
    if contact_m < _MIN_CONTACT_M:
        return None
    union = shapely.Polygon(rings[0], rings[1:]).union(shapely.Polygon(other_rings[0], other_rings[1:]))
    if not isinstance(union, shapely.Polygon):
        return None
    union = shapely.orient_polygons(union, exterior_cw=False)
    return [
        _without_straight(shapely.get_coordinates(ring)[:-1]) for ring in (union.exterior, *union.interiors)
    ]


@entry
def _contact_m(ring, other):
    """The length over which edges along the axes of two rings, (n, 2) and (m, 2), lie on each other."""
    result = 0.0
    for i in range(len(ring)):
        j = i + 1 if i + 1 < len(ring) else 0
        for axis in range(2):
            if ring[i, axis] != ring[j, axis]:
                continue
            low = min(ring[i, 1 - axis], ring[j, 1 - axis])
            high = max(ring[i, 1 - axis], ring[j, 1 - axis])
            for k in range(len(other)):
                m = k + 1 if k + 1 < len(other) else 0
                if other[k, axis] == ring[i, axis] and other[m, axis] == ring[i, axis]:
                    other_low = min(other[k, 1 - axis], other[m, 1 - axis])
                    other_high = max(other[k, 1 - axis], other[m, 1 - axis])
                    result += max(min(high, other_high) - max(low, other_low), 0.0)
    return result


@entry
def _without_straight(ring):
    """The ring (n, 2) without vertices within a straight edge."""
    n, count, result = len(ring), 0, np.empty_like(ring)
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        before_x, before_y = ring[i, 0] - ring[i - 1, 0], ring[i, 1] - ring[i - 1, 1]
        after_x, after_y = ring[j, 0] - ring[i, 0], ring[j, 1] - ring[i, 1]
        size = np.sqrt(before_x * before_x + before_y * before_y) * np.sqrt(
            after_x * after_x + after_y * after_y
        )
        if abs(before_x * after_y - before_y * after_x) > _STRAIGHT * size:
            result[count] = ring[i]
            count += 1
    return result[:count].copy()
