"""One polygon as edge records, and the check that its rings are simple and correctly nested."""

import numpy as np

from p2wss.skeleton.compiled import inner
from p2wss.skeleton.records import MAX_EDGES
from p2wss.skeleton.rings import are_apart, is_inside, segment_distance_m2, signed_area
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
            edge[i].x, edge[i].y = xy_m[first + i, 0] - origin_x, xy_m[first + i, 1] - origin_y
            edge[i].next = i + 1 if i + 1 < end else start
            edge[i].prev = i - 1 if i > start else end - 1
    for i in range(n):
        j = edge[i].next
        dx, dy = edge[j].x - edge[i].x, edge[j].y - edge[i].y
        length = np.hypot(dx, dy)
        if not length >= _SHORTEST_EDGE_M or not np.isfinite(length):
            return NOT_CLEAN, 0
        edge[i].length, edge[i].dir_x, edge[i].dir_y = length, dx / length, dy / length
    return OK, n


@inner
def set_angles(edge: np.ndarray, num_edges: int, angle_deg: np.ndarray) -> int:
    """Set the angle and the speed cot(angle) of every edge; ``angle_deg``: float64, at least num_edges values.
    Returns a ``Status``."""
    for i in range(num_edges):
        angle = angle_deg[i]
        if angle == edge[i].angle_deg:
            continue  # the speed is already right, also for the angle 0 in a new array
        if angle == 0.0 or angle == 90.0:
            edge[i].final_speed = 0.0
        elif MIN_SLOPE_DEG <= angle <= MAX_SLOPE_DEG:
            edge[i].final_speed = 1.0 / np.tan(angle * np.pi / 180.0)
        else:
            return BAD_ANGLE
        edge[i].angle_deg = angle
    return OK


@inner
def _edges_touch(edge: np.ndarray, i: int, j: int, clearance: float) -> bool:
    i2, j2 = edge[i].next, edge[j].next
    a, b = (edge[i].x, edge[i].y), (edge[i2].x, edge[i2].y)
    c, d = (edge[j].x, edge[j].y), (edge[j2].x, edge[j2].y)
    return not are_apart(a, b, c, d, clearance) and segment_distance_m2(a, b, c, d) < clearance * clearance


@inner
def check_rings(
    edge: np.ndarray, xy_m: np.ndarray, ring_offset: np.ndarray, first_ring: int, last_ring: int
) -> int:
    """The ``Status`` of the rings: OK if the exterior is counter-clockwise, courtyards are clockwise and inside
    it, and no edges cross or touch."""
    n = ring_offset[last_ring] - ring_offset[first_ring]
    for ring in range(first_ring, last_ring):
        area = signed_area(xy_m, ring_offset[ring], ring_offset[ring + 1])
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
        x, y = xy_m[ring_offset[ring], 0], xy_m[ring_offset[ring], 1]
        for other in range(first_ring, last_ring):
            is_in = is_inside(xy_m, ring_offset[other], ring_offset[other + 1], x, y)
            if other != ring and is_in != (other == first_ring):
                return COURTYARD_OUTSIDE
    return OK
