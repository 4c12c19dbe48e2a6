"""One side of a polygon that is cut along a line x = c or y = c, as compiled code."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import ZERO, allocating, by_address, entry, inner
from p2wss.skeleton.footprint import check_rings, load_footprint, set_angles
from p2wss.skeleton.kinetic import simulate_at
from p2wss.skeleton.ordering import stable_order
from p2wss.skeleton.records import NUM_NODES
from p2wss.skeleton.status import Status

_OK = int(Status.OK)
# a vertex this near to the line is on it
_ON_CUT_M = 1e-6
_LEAST_AREA_M2, _HALF_WIDTH_M, _CLEARANCE_M = 2.0, 0.45, 0.05
_ON_EDGE_M = 1e-4


@allocating
def _crossings(xy_m, ring_offset, axis, position):
    """Where rings cross the line, in the order along it: (place along the line, number of the edge) each."""
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
def side_of_cut(xy_m, ring_offset, axis, position, is_high):
    """(vertices (k, 2), offsets of the rings) of the part of a polygon with coordinate ``axis`` above (or
    below) ``position``, exterior first and counter-clockwise; vertices on the cut have exactly its coordinate.

    Empty if that is not one polygon. It may touch itself: see :func:`is_sound`.
    """
    n, num_rings = len(xy_m), len(ring_offset) - 1
    nothing, no_offset = np.zeros((0, 2)), np.zeros(1, np.int64)
    place, edge = _crossings(xy_m, ring_offset, axis, position)
    count = len(place)
    if count == 0 or count % 2 == 1:
        return nothing, no_offset
    following, crossing_of, cut_ring = np.empty(n, np.int64), np.full(n, -1), np.zeros(num_rings, np.int64)
    for ring in range(num_rings):
        for i in range(ring_offset[ring], ring_offset[ring + 1]):
            following[i] = i + 1 if i + 1 < ring_offset[ring + 1] else ring_offset[ring]
    for c in range(count):
        crossing_of[edge[c]] = c
        for ring in range(num_rings):
            if ring_offset[ring] <= edge[c] < ring_offset[ring + 1]:
                cut_ring[ring] = 1
    out = np.empty((n + 2 * count, 2))
    # along the boundary until it leaves this side, then along the cut to where it comes back
    size, used = 0, 0
    start = -1
    for c in range(count):
        if (xy_m[following[edge[c]], axis] >= position - _ON_CUT_M) == is_high:
            start = c
            break
    c = start
    while True:
        if (xy_m[following[edge[c]], axis] >= position - _ON_CUT_M) != is_high:
            return nothing, no_offset
        out[size, axis], out[size, 1 - axis] = position, place[c]
        size, used = size + 1, used + 2
        i = following[edge[c]]
        while crossing_of[i] < 0:
            out[size, 0], out[size, 1] = xy_m[i, 0], xy_m[i, 1]
            size += 1
            i = following[i]
        out[size, 0], out[size, 1] = xy_m[i, 0], xy_m[i, 1]
        c = crossing_of[i]
        out[size + 1, axis], out[size + 1, 1 - axis] = position, place[c]
        size += 2
        c ^= 1  # the other end of the same piece of the line
        if c == start:
            break
        if used >= count:
            return nothing, no_offset
    if used != count:
        return nothing, no_offset
    rings_xy, offset = np.empty((size + n, 2)), np.zeros(num_rings + 1, np.int64)
    total = _cleaned(out, size, axis, position, rings_xy)
    offset[1] = total
    made = 1
    for ring in range(num_rings):
        first, last = ring_offset[ring], ring_offset[ring + 1]
        if cut_ring[ring] == 0 and (xy_m[first, axis] >= position - _ON_CUT_M) == is_high:
            for i in range(first, last):
                rings_xy[total, 0], rings_xy[total, 1] = xy_m[i, 0], xy_m[i, 1]
                total += 1
            made += 1
            offset[made] = total
    return rings_xy[:total].copy(), offset[: made + 1].copy()


side_of_cut_at = by_address(side_of_cut)


@inner
def _cleaned(ring, size, axis, position, out):
    """Copies a ring without repeated vertices and without those between two collinear pieces of the cut.
    Returns the number of vertices."""
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
    kept = 0
    for i in range(count):
        before, after = ring[(i - 1) % count, axis], ring[(i + 1) % count, axis]
        if ring[i, axis] == position and before == position and after == position:
            continue
        out[kept, 0], out[kept, 1] = ring[i, 0], ring[i, 1]
        kept += 1
    return kept


@inner
def _clearance2(edge, n):
    """Least squared distance of vertices to each other and to edges that are not theirs."""
    least = np.inf
    for v in range(n):
        for e in range(n):
            dx, dy = edge[v].x - edge[e].x, edge[v].y - edge[e].y
            if e == v or edge[e].next == v:
                if e != v:
                    least = min(least, edge[e].length * edge[e].length)
                continue
            along = min(max(dx * edge[e].dir_x + dy * edge[e].dir_y, 0.0), edge[e].length)
            dx -= along * edge[e].dir_x
            dy -= along * edge[e].dir_y
            least = min(least, dx * dx + dy * dy)
    return least


@entry
def clearance_m(xy_m, ring_offset, work):
    """How near a polygon comes to touching itself."""
    status, n = load_footprint(xy_m, ring_offset, ZERO, len(ring_offset) - 1, work.skeleton.edge)
    return np.sqrt(_clearance2(work.skeleton.edge, n)) if status == _OK else 0.0


@entry
def is_sound(xy_m, ring_offset, least_clearance_m, work):
    """Whether the side of a cut is a polygon of its own, neither small nor thin, that comes no nearer to
    touching itself than ``least_clearance_m``."""
    num_rings = len(ring_offset) - 1
    skeleton = work.skeleton
    if len(xy_m) < 3 or len(xy_m) > len(skeleton.edge):
        return False
    edge = skeleton.edge
    status, n = load_footprint(xy_m, ring_offset, ZERO, num_rings, edge)
    if status != _OK or check_rings(edge, ring_offset, ZERO, num_rings) != _OK:
        return False
    area = 0.0
    for e in range(n):
        area += 0.5 * (edge[e].x * edge[edge[e].next].y - edge[edge[e].next].x * edge[e].y)
    if area < _LEAST_AREA_M2 or _clearance2(edge, n) < min(_CLEARANCE_M, least_clearance_m) ** 2:
        return False
    # at 45 degrees everywhere a roof is as high as its middle is far from the edges
    for e in range(n):
        work.solved[e] = 45.0
    set_angles(edge, n, work.solved)
    status = simulate_at(
        skeleton.code, edge, n, num_rings, np.inf, skeleton.node, skeleton.vertex, skeleton.arc, skeleton.cap_height,
        skeleton.counts,
    )  # fmt: skip
    if status != _OK:
        return False
    for k in range(n, skeleton.counts[NUM_NODES]):  # noqa: SIM110 - compiled
        if skeleton.node[k].z > _HALF_WIDTH_M:
            return True
    return False


is_sound_at = by_address(is_sound)


@entry
def inherited_angles(parent_xy_m, parent_offset, parent_deg, xy_m, ring_offset, axis, position, on_cut_deg):
    """Angles of a parent for the edges that lie on its own, ``on_cut_deg`` for those along the cut at
    ``position``, 90 for others."""
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
