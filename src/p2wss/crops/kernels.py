"""Compiled loops over the points of each polygon.

Pairs of a polygon and a point are in slices: polygon p has the pairs ``offset[p]:offset[p + 1]``, and ``point[k]``
is the index of the point of pair k (see :class:`p2wss.clouds.crops.CloudCrops`).
"""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import entry


@entry
def gather_cm(value_m: np.ndarray, point: np.ndarray, offset: np.ndarray, origin_m: np.ndarray) -> np.ndarray:
    """``value_m`` of each pair relative to the origin of its polygon, in whole centimetres, int16 (num_pairs,).

    -32768 if the value is more than 327.67 m from the origin.
    """
    result = np.empty(len(point), np.int16)
    for p in range(len(offset) - 1):
        for k in range(offset[p], offset[p + 1]):
            value = np.rint(100 * (value_m[point[k]] - origin_m[p]))
            result[k] = np.int16(value) if abs(value) <= 32767 else np.int16(-32768)
    return result


@entry
def medians(value: np.ndarray, point: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Median of ``value`` over the points of each polygon, float64 (num_polygons,); NaN without points."""
    result = np.full(len(offset) - 1, np.nan)
    for p in range(len(offset) - 1):
        if offset[p] < offset[p + 1]:
            result[p] = np.median(value[point[offset[p] : offset[p + 1]]])
    return result


@entry
def count_true(mask: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Number of true values of ``mask`` in each slice ``offset[i]:offset[i + 1]``, int64 (len(offset) - 1,)."""
    result = np.zeros(len(offset) - 1, np.int64)
    for i in range(len(offset) - 1):
        for k in range(offset[i], offset[i + 1]):
            result[i] += mask[k]
    return result


@entry
def face_kinds(
    building: np.ndarray, face: np.ndarray, point: np.ndarray, offset: np.ndarray, row: np.ndarray
) -> np.ndarray:
    """Kind of the face under the point of each pair (``face & 3``), uint8 (num_pairs,).

    0 if the point is not on the building of the pair's polygon, ``row[polygon]``. building, face: int32, one per
    point.
    """
    result = np.zeros(len(point), np.uint8)
    for p in range(len(offset) - 1):
        for k in range(offset[p], offset[p + 1]):
            if building[point[k]] == row[p]:
                result[k] = face[point[k]] & 3
    return result


@entry
def count_distinct(value: np.ndarray, point: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Number of distinct values over the points of each polygon, int32 (num_polygons,).

    value: uint16, one per point.
    """
    result = np.zeros(len(offset) - 1, np.int32)
    last_seen = np.full(1 << 16, -1, np.int64)  # polygon in which a value was last seen
    for p in range(len(offset) - 1):
        for k in range(offset[p], offset[p + 1]):
            v = value[point[k]]
            if last_seen[v] != p:
                last_seen[v] = p
                result[p] += 1
    return result


@entry
def walls_seen(
    face: np.ndarray, point: np.ndarray, on_wall: np.ndarray, offset: np.ndarray, min_points: int
) -> np.ndarray:
    """Number of edges whose wall has at least ``min_points`` points, int32 (num_polygons,).

    face: int32, one per point, whose edge is ``(face >> 2) - 1``; on_wall: bool (num_pairs,).
    """
    result = np.zeros(len(offset) - 1, np.int32)
    most = np.int64(0)
    for k in range(len(point)):
        if on_wall[k]:
            most = max(most, np.int64(face[point[k]] >> 2))
    count = np.zeros(most, np.int64)
    for p in range(len(offset) - 1):
        count[:] = 0
        for k in range(offset[p], offset[p + 1]):
            if on_wall[k]:
                count[(face[point[k]] >> 2) - 1] += 1
        result[p] = (count >= min_points).sum()
    return result
