"""One polygon as edge records, and the check that its rings are simple and correctly nested."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import inner
from p2wss.skeleton.records import MAX_EDGES
from p2wss.skeleton.rings import crosses
from p2wss.skeleton.status import (
    BAD_ANGLE,
    COURTYARD_OUTSIDE,
    EMPTY,
    NON_FINITE,
    NOT_CLEAN,
    NOT_SIMPLE,
    OK,
    TOO_MANY_EDGES,
)

_SHORTEST_EDGE_M = 1e-3
_CLEARANCE_M = 1e-4  # edges that are not neighbours stay at least this far apart
MIN_SLOPE_DEG, MAX_SLOPE_DEG = 5.0, 85.0


@inner
def load_footprint(
    xy_m: np.ndarray, ring_offset: np.ndarray, first_ring: int, last_ring: int, edge: np.ndarray
) -> tuple[int, int]:
    """Fill ``edge`` from rings ``first_ring:last_ring``; coordinates become relative to the first vertex.

    Returns (status, number of edges). Everything but the angle and the speeds is set.
    """
    first, last = ring_offset[first_ring], ring_offset[last_ring]
    n = last - first
    if n < 3:
        return EMPTY, 0
    if n > MAX_EDGES or n > len(edge):
        return TOO_MANY_EDGES, 0
    for i in range(first, last):
        if not (np.isfinite(xy_m[i, 0]) and np.isfinite(xy_m[i, 1])):
            return NON_FINITE, 0
    origin_x, origin_y = xy_m[first, 0], xy_m[first, 1]
    for ring in range(first_ring, last_ring):
        start, end = ring_offset[ring] - first, ring_offset[ring + 1] - first
        if end - start < 3:
            return EMPTY, 0
        for i in range(start, end):
            edge[i].x = xy_m[first + i, 0] - origin_x
            edge[i].y = xy_m[first + i, 1] - origin_y
            edge[i].next = i + 1 if i + 1 < end else start
            edge[i].prev = i - 1 if i > start else end - 1
    for i in range(n):
        j = edge[i].next
        dx, dy = edge[j].x - edge[i].x, edge[j].y - edge[i].y
        length = np.hypot(dx, dy)
        if not length >= _SHORTEST_EDGE_M or not np.isfinite(length):
            return NOT_CLEAN, 0
        edge[i].length = length
        edge[i].dir_x = dx / length
        edge[i].dir_y = dy / length
    return OK, n


@inner
def set_angles(edge: np.ndarray, num_edges: int, angle_deg: np.ndarray) -> int:
    """Set the angle and the speed cot(angle) of every edge; ``angle_deg``: float64, at least num_edges values.
    Returns a ``Status``."""
    slope_deg, speed = 0.0, 0.0
    for i in range(num_edges):
        angle = angle_deg[i]
        if angle == edge[i].angle_deg:
            continue  # the speed is that of this angle, as it is in the zeros of a new array
        if angle == 0.0 or angle == 90.0:
            edge[i].final_speed = 0.0
        elif MIN_SLOPE_DEG <= angle <= MAX_SLOPE_DEG:
            if angle != slope_deg:
                slope_deg, speed = angle, 1.0 / np.tan(angle * np.pi / 180.0)
            edge[i].final_speed = speed
        else:
            return BAD_ANGLE
        edge[i].angle_deg = angle
    return OK


@inner
def _point_to_piece2(x: float, y: float, edge: np.ndarray, i: int) -> float:
    """Squared distance of a point to edge i."""
    dx, dy = x - edge[i].x, y - edge[i].y
    along = dx * edge[i].dir_x + dy * edge[i].dir_y
    along = min(max(along, 0.0), edge[i].length)
    dx -= along * edge[i].dir_x
    dy -= along * edge[i].dir_y
    return dx * dx + dy * dy


@inner
def _edges_touch(edge: np.ndarray, i: int, j: int, clearance: float) -> bool:
    i2, j2 = edge[i].next, edge[j].next
    if (
        max(edge[i].x, edge[i2].x) + clearance < min(edge[j].x, edge[j2].x)
        or max(edge[j].x, edge[j2].x) + clearance < min(edge[i].x, edge[i2].x)
        or max(edge[i].y, edge[i2].y) + clearance < min(edge[j].y, edge[j2].y)
        or max(edge[j].y, edge[j2].y) + clearance < min(edge[i].y, edge[i2].y)
    ):
        return False
    side_j = (edge[j].x - edge[i].x) * edge[i].dir_y - (edge[j].y - edge[i].y) * edge[i].dir_x
    side_j2 = (edge[j2].x - edge[i].x) * edge[i].dir_y - (edge[j2].y - edge[i].y) * edge[i].dir_x
    side_i = (edge[i].x - edge[j].x) * edge[j].dir_y - (edge[i].y - edge[j].y) * edge[j].dir_x
    side_i2 = (edge[i2].x - edge[j].x) * edge[j].dir_y - (edge[i2].y - edge[j].y) * edge[j].dir_x
    if side_j * side_j2 < 0.0 and side_i * side_i2 < 0.0:
        return True
    nearest2 = min(
        _point_to_piece2(edge[i].x, edge[i].y, edge, j),
        _point_to_piece2(edge[i2].x, edge[i2].y, edge, j),
        _point_to_piece2(edge[j].x, edge[j].y, edge, i),
        _point_to_piece2(edge[j2].x, edge[j2].y, edge, i),
    )
    return nearest2 < clearance * clearance


@inner
def _inside_ring(edge: np.ndarray, first: int, last: int, x: float, y: float) -> bool:
    inside = False
    for i in range(first, last):
        j = edge[i].next
        if crosses(edge[i].x, edge[i].y, edge[j].x, edge[j].y, x, y):
            inside = not inside
    return inside


@inner
def ring_area(edge: np.ndarray, first: int, last: int) -> float:
    """Signed area, m2, of the ring of edges ``first:last``; positive when counter-clockwise."""
    area = 0.0
    for i in range(first, last):
        j = edge[i].next
        area += (edge[i].x - edge[first].x) * (edge[j].y - edge[first].y)
        area -= (edge[j].x - edge[first].x) * (edge[i].y - edge[first].y)
    return 0.5 * area


@inner
def check_rings(edge: np.ndarray, ring_offset: np.ndarray, first_ring: int, last_ring: int) -> int:
    """The ``Status`` of the rings: OK if the exterior is counter-clockwise, courtyards are clockwise and inside
    it, and no edges cross or touch."""
    base = ring_offset[first_ring]
    n = ring_offset[last_ring] - base
    for ring in range(first_ring, last_ring):
        area = ring_area(edge, ring_offset[ring] - base, ring_offset[ring + 1] - base)
        if (area > 0.0) != (ring == first_ring) or area == 0.0:
            return NOT_CLEAN
    for i in range(n):
        j = edge[i].next
        along = edge[i].dir_x * edge[j].dir_x + edge[i].dir_y * edge[j].dir_y
        across = edge[i].dir_x * edge[j].dir_y - edge[i].dir_y * edge[j].dir_x
        if along < 0.0 and abs(across) < 1e-6:
            return NOT_SIMPLE  # the ring reverses its direction
        for j in range(i + 1, n):
            if edge[i].next != j and edge[j].next != i and _edges_touch(edge, i, j, _CLEARANCE_M):
                return NOT_SIMPLE
    for ring in range(first_ring + 1, last_ring):
        k = ring_offset[ring] - base
        for other in range(first_ring, last_ring):
            start, end = ring_offset[other] - base, ring_offset[other + 1] - base
            is_inside = _inside_ring(edge, start, end, edge[k].x, edge[k].y)
            if other != ring and is_inside != (other == first_ring):
                return COURTYARD_OUTSIDE
    return OK
