"""Compiled loops over the points of each crop."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import entry


@entry
def gather_cm(value_m: np.ndarray, point: np.ndarray, offset: np.ndarray, origin_m: np.ndarray) -> np.ndarray:
    """``value_m[point] - origin`` of each pair's polygon, in whole centimetres, int16 (num_pairs,).

    What does not fit is -32768, which no value within 327.67 m of the origin is.
    """
    result = np.empty(len(point), np.int16)
    for p in range(len(offset) - 1):
        for k in range(offset[p], offset[p + 1]):
            value = np.rint(100 * (value_m[point[k]] - origin_m[p]))
            result[k] = np.int16(value) if abs(value) <= 32767 else np.int16(-32768)
    return result


@entry
def medians(value: np.ndarray, point: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Median of ``value[point]`` per polygon, NaN for a polygon without points."""
    result = np.full(len(offset) - 1, np.nan)
    for p in range(len(offset) - 1):
        if offset[p] < offset[p + 1]:
            result[p] = np.median(value[point[offset[p] : offset[p + 1]]])
    return result


@entry
def count_true(mask: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """True values of ``mask`` in each slice ``offset[i]:offset[i + 1]``, int64 (len(offset) - 1,)."""
    result = np.zeros(len(offset) - 1, np.int64)
    for i in range(len(offset) - 1):
        for k in range(offset[i], offset[i + 1]):
            result[i] += mask[k]
    return result


@entry
def own_kinds(
    building: np.ndarray, face: np.ndarray, point: np.ndarray, offset: np.ndarray, row: np.ndarray
) -> np.ndarray:
    """Kind of face (``face & 3``) of each pair's point, uint8 (num_pairs,), 0 if it is on another building
    than ``row[polygon]``. building, face: int32, one per point."""
    result = np.zeros(len(point), np.uint8)
    for p in range(len(offset) - 1):
        for k in range(offset[p], offset[p + 1]):
            if building[point[k]] == row[p]:
                result[k] = face[point[k]] & 3
    return result


@entry
def count_distinct(value: np.ndarray, point: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """How many values each polygon's points have, int32 (num_polygons,). value: uint16, one per point."""
    result = np.zeros(len(offset) - 1, np.int32)
    last_seen = np.full(1 << 16, -1, np.int64)  # polygon
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
    """Number of edges with ``min_points`` points on their wall or more, int32 (num_polygons,).

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
