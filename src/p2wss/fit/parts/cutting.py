"""One side of a polygon that is cut along a line x = c or y = c, as compiled code."""

from __future__ import annotations

import numpy as np

from p2wss.fit.roof.work import Polygon, fit_work_at
from p2wss.fit.settings import SEARCHING
from p2wss.skeleton.compiled import ZERO, allocating, by_address, entry, inner
from p2wss.skeleton.footprint import check_rings, load_footprint, set_angles
from p2wss.skeleton.kinetic import simulate_at
from p2wss.skeleton.ordering import stable_order
from p2wss.skeleton.records import NUM_NODES
from p2wss.skeleton.status import Status

_OK = int(Status.OK)
# vertices within this distance of the line count as on it
_ON_CUT_M = 1e-6
_MIN_AREA_M2, _HALF_WIDTH_M, _CLEARANCE_M = 2.0, 0.45, 0.05
_ON_EDGE_M = 1e-4


@allocating
def _crossings(polygon: Polygon, axis: int, position: float):
    """(positions along the line, numbers of the edges) where the rings cross the line, in order along it."""
    xy_m, ring_offset = polygon
    n = len(xy_m)
    place, edge = np.empty(n), np.empty(n, np.int64)
    count = 0
    for ring in range(len(ring_offset) - 1):
        for i in range(ring_offset[ring], ring_offset[ring + 1]):
            j = i + 1 if i + 1 < ring_offset[ring + 1] else ring_offset[ring]
            a, b = xy_m[i, axis] - position, xy_m[j, axis] - position
            if (a >= -_ON_CUT_M) == (b >= -_ON_CUT_M):
                continue
            share = 0.0 if abs(a) < _ON_CUT_M else 1.0 if abs(b) < _ON_CUT_M else a / (a - b)
            place[count] = xy_m[i, 1 - axis] + share * (xy_m[j, 1 - axis] - xy_m[i, 1 - axis])
            edge[count] = i
            count += 1
    order = stable_order(place[:count])
    ordered_place, ordered_edge = np.empty(count), np.empty(count, np.int64)
    for c in range(count):
        ordered_place[c], ordered_edge[c] = place[order[c]], edge[order[c]]
    return ordered_place, ordered_edge


@entry
def side_of_cut(polygon: Polygon, axis: int, position: float, is_high: bool):
    """The part of a polygon with coordinate ``axis`` above (or below) ``position``, exterior first and
    counter-clockwise; vertices on the cut have exactly its coordinate.

    Empty if that side is not a single polygon. The polygon may touch itself: see :func:`is_sound`.
    """
    xy_m, ring_offset = polygon
    n, num_rings = len(xy_m), len(ring_offset) - 1
    nothing = Polygon(np.zeros((0, 2)), np.zeros(1, np.int64))
    place, edge = _crossings(polygon, axis, position)
    count = len(place)
    if count == 0 or count % 2 == 1:
        return nothing
    next_vertex, crossing_of, cut_ring = np.empty(n, np.int64), np.full(n, -1), np.zeros(num_rings, np.int64)
    for ring in range(num_rings):
        for i in range(ring_offset[ring], ring_offset[ring + 1]):
            next_vertex[i] = i + 1 if i + 1 < ring_offset[ring + 1] else ring_offset[ring]
    for c in range(count):
        crossing_of[edge[c]] = c
        for ring in range(num_rings):
            if ring_offset[ring] <= edge[c] < ring_offset[ring + 1]:
                cut_ring[ring] = 1
    out = np.empty((n + 2 * count, 2))
    # follow the boundary until it leaves this side, then the cut to where the boundary comes back
    size, num_used = 0, 0
    start = -1
    for c in range(count):
        if (xy_m[next_vertex[edge[c]], axis] >= position - _ON_CUT_M) == is_high:
            start = c
            break
    c = start
    while True:
        if (xy_m[next_vertex[edge[c]], axis] >= position - _ON_CUT_M) != is_high:
            return nothing
        out[size, axis], out[size, 1 - axis] = position, place[c]
        size, num_used = size + 1, num_used + 2
        i = next_vertex[edge[c]]
        while crossing_of[i] < 0:
            out[size, 0], out[size, 1] = xy_m[i, 0], xy_m[i, 1]
            size += 1
            i = next_vertex[i]
        out[size, 0], out[size, 1] = xy_m[i, 0], xy_m[i, 1]
        c = crossing_of[i]
        out[size + 1, axis], out[size + 1, 1 - axis] = position, place[c]
        size += 2
        c ^= 1  # the other end of this segment of the cut
        if c == start:
            break
        if num_used >= count:
            return nothing
    if num_used != count:
        return nothing
    rings_xy, offset = np.empty((size + n, 2)), np.zeros(num_rings + 1, np.int64)
    total = _clean_ring(out, size, axis, position, rings_xy)
    offset[1] = total
    num_out = 1
    for ring in range(num_rings):
        first, last = ring_offset[ring], ring_offset[ring + 1]
        if cut_ring[ring] == 0 and (xy_m[first, axis] >= position - _ON_CUT_M) == is_high:
            for i in range(first, last):
                rings_xy[total, 0], rings_xy[total, 1] = xy_m[i, 0], xy_m[i, 1]
                total += 1
            num_out += 1
            offset[num_out] = total
    return Polygon(rings_xy[:total].copy(), offset[: num_out + 1].copy())


side_of_cut_at = by_address(side_of_cut)


@inner
def _clean_ring(ring: np.ndarray, size: int, axis: int, position: float, out: np.ndarray):
    """Copies a ring to ``out`` without repeated vertices and without vertices within the cut. Returns the number of
    vertices."""
    count = 0
    for i in range(size):
        if abs(ring[i, axis] - position) < _ON_CUT_M:
            ring[i, axis] = position
        if count > 0 and abs(ring[i, 0] - ring[count - 1, 0]) + abs(ring[i, 1] - ring[count - 1, 1]) < 1e-9:
            continue
        ring[count, 0], ring[count, 1] = ring[i, 0], ring[i, 1]
        count += 1
    while count > 1 and abs(ring[0, 0] - ring[count - 1, 0]) + abs(ring[0, 1] - ring[count - 1, 1]) < 1e-9:
        count -= 1
    num_kept = 0
    for i in range(count):
        before, after = ring[(i - 1) % count, axis], ring[(i + 1) % count, axis]
        if ring[i, axis] == position and before == position and after == position:
            continue
        out[num_kept, 0], out[num_kept, 1] = ring[i, 0], ring[i, 1]
        num_kept += 1
    return num_kept


@inner
def _squared_clearance_m2(edge, n):
    """Smallest squared distance between two vertices, or between a vertex and an edge that does not end there."""
    result = np.inf
    for v in range(n):
        for e in range(n):
            dx, dy = edge[v].x - edge[e].x, edge[v].y - edge[e].y
            if e == v or edge[e].next == v:
                if e != v:
                    result = min(result, edge[e].length * edge[e].length)
                continue
            along = min(max(dx * edge[e].dir_x + dy * edge[e].dir_y, 0.0), edge[e].length)
            dx -= along * edge[e].dir_x
            dy -= along * edge[e].dir_y
            result = min(result, dx * dx + dy * dy)
    return result


@entry
def clearance_m(polygon: Polygon, work_at: int):
    """The smallest distance between a vertex of a polygon and another vertex or an edge that does not end there."""
    work, num_rings = fit_work_at(work_at), len(polygon.ring_offset) - 1
    status, n = load_footprint(polygon.xy_m, polygon.ring_offset, ZERO, num_rings, work.skeleton.edge)
    return np.sqrt(_squared_clearance_m2(work.skeleton.edge, n)) if status == _OK else 0.0


@entry
def is_sound(polygon: Polygon, min_clearance_m: float, work_at: int):
    """Whether the side of a cut is a simple polygon, neither small nor thin, whose clearance is at least
    ``min_clearance_m``."""
    work = fit_work_at(work_at)
    xy_m, ring_offset = polygon
    num_rings = len(ring_offset) - 1
    skeleton = work.skeleton
    if len(xy_m) < 3 or len(xy_m) > len(skeleton.edge):
        return False
    edge = skeleton.edge
    status, n = load_footprint(xy_m, ring_offset, ZERO, num_rings, edge)
    if status != _OK or check_rings(edge, ring_offset, ZERO, num_rings) != _OK:
        return False
    area, perimeter = 0.0, 0.0
    for e in range(n):
        perimeter += edge[e].length
        area += 0.5 * (edge[e].x * edge[edge[e].next].y - edge[edge[e].next].x * edge[e].y)
    if area < _MIN_AREA_M2 or _squared_clearance_m2(edge, n) < min(_CLEARANCE_M, min_clearance_m) ** 2:
        return False
    # the radius of the largest circle within a polygon is at least its area by its perimeter
    if n > SEARCHING.many_edges and area > _HALF_WIDTH_M * perimeter:
        # with many edges, a skeleton takes long
        return True
    # the highest point of a 45 degree roof is as high as it is far from the edges
    for e in range(n):
        work.solution_deg[e] = 45.0
    set_angles(edge, n, work.solution_deg)
    status = simulate_at(skeleton.code, skeleton, n, num_rings, np.inf)
    if status != _OK:
        return False
    for k in range(n, skeleton.counts[NUM_NODES]):  # noqa: SIM110 - compiled
        if skeleton.node[k].z > _HALF_WIDTH_M:
            return True
    return False


is_sound_at = by_address(is_sound)


@entry
def inherited_angles(
    parent: Polygon, parent_deg: np.ndarray, polygon: Polygon, axis: int, position: float, on_cut_deg: float
):
    """Angles for the edges of one side of a cut: those of the parent where an edge lies on one of the parent's,
    ``on_cut_deg`` along the cut at ``position``, and 90 degrees elsewhere."""
    parent_xy_m, parent_offset = parent
    xy_m, ring_offset = polygon
    result = np.full(len(xy_m), 90.0)
    for ring in range(len(ring_offset) - 1):
        for i in range(ring_offset[ring], ring_offset[ring + 1]):
            j = i + 1 if i + 1 < ring_offset[ring + 1] else ring_offset[ring]
            if xy_m[i, axis] == position and xy_m[j, axis] == position:
                result[i] = on_cut_deg
            x, y = 0.5 * (xy_m[i, 0] + xy_m[j, 0]), 0.5 * (xy_m[i, 1] + xy_m[j, 1])
            nearest = _ON_EDGE_M
            for other in range(len(parent_offset) - 1):
                first, last = parent_offset[other], parent_offset[other + 1]
                for k in range(first, last):
                    m = k + 1 if k + 1 < last else first
                    along_x = parent_xy_m[m, 0] - parent_xy_m[k, 0]
                    along_y = parent_xy_m[m, 1] - parent_xy_m[k, 1]
                    dx, dy = x - parent_xy_m[k, 0], y - parent_xy_m[k, 1]
                    share = (dx * along_x + dy * along_y) / (along_x * along_x + along_y * along_y)
                    share = min(max(share, 0.0), 1.0)
                    gap = np.hypot(dx - share * along_x, dy - share * along_y)
                    if gap < nearest:
                        nearest, result[i] = gap, parent_deg[k]
    return result
