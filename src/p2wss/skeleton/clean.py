"""The clean-up of a batch of footprints: from polygons in any state to polygons that the skeleton can take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2wss.skeleton.compiled import ZERO, entry, inner
from p2wss.skeleton.footprint import check_rings, load_footprint
from p2wss.skeleton.records import EDGE, MAX_EDGES
from p2wss.skeleton.status import Status
from p2wss.skeleton.straighten import LINE, straighten
from p2wss.skeleton.types import IntArray, Polygons, writable

_OK = int(Status.OK)
_EMPTY = int(Status.EMPTY)
_NON_FINITE = int(Status.NON_FINITE)
_TOO_SMALL = int(Status.TOO_SMALL)
_TOO_MANY_EDGES = int(Status.TOO_MANY_EDGES)
_FARTHEST_M = 1e9  # beyond this, float64 cannot resolve micrometres

_MAX_RAW_VERTICES = 65536


@dataclass(frozen=True)
class Cleaned:
    """Clean polygons, and the edges of the input from which their edges come.

    polygons: as many as in the input; a rejected one has no rings. edge_source: int64 (num_vertices,), for
    every edge the index into the input's ``xy_m`` of the edge whose angle it inherits, the longest of those
    that were merged into it. status: int32 (num_polygons,), a ``Status``.
    """

    polygons: Polygons
    edge_source: IntArray
    status: IntArray


@inner
def _removable_offset(x, y, before, here, after, min_edge, max_cos, min_offset):
    """Distance of a vertex from the line between its neighbours if it has to be removed, or -1 if it may
    stay."""
    a, b, c = before[here], here, after[here]
    u_x, u_y = x[b] - x[a], y[b] - y[a]
    v_x, v_y = x[c] - x[b], y[c] - y[b]
    u, v = np.hypot(u_x, u_y), np.hypot(v_x, v_y)
    cross = abs(u_x * v_y - u_y * v_x)
    along = u_x * v_x + u_y * v_y
    if along <= -max_cos * u * v:  # a spike, or an edge of no length
        return cross / max(u, v, 1e-12)
    chord = np.hypot(x[c] - x[a], y[c] - y[a])
    offset = cross / max(chord, 1e-12)
    if min(u, v) < min_edge or along >= max_cos * u * v or offset < min_offset:
        return offset
    return -1.0


@inner
def _thin_out_ring(x, y, source, source_length, before, after, offset_of, n, min_edge, max_cos, min_offset):
    """Remove vertices, the one with the least offset first, until the others may stay. Returns (their number,
    one of them)."""
    for k in range(n):
        offset_of[k] = _removable_offset(x, y, before, k, after, min_edge, max_cos, min_offset)
    head = 0
    left = n
    while left >= 3:
        worst, least = -1, np.inf
        k = head
        for _ in range(left):
            # of equal offsets the last vertex is removed, so that of the two ends of a closed ring the first stays
            if offset_of[k] >= 0.0 and (offset_of[k] < least or (offset_of[k] == least and k > worst)):
                worst, least = k, offset_of[k]
            k = after[k]
        if worst < 0 or left == 3:
            # a triangle with a vertex to remove has collapsed
            return (left if worst < 0 else 0), head
        a, c = before[worst], after[worst]
        if source_length[worst] > source_length[a]:
            source[a], source_length[a] = source[worst], source_length[worst]
        after[a] = c
        before[c] = a
        head = a
        left -= 1
        offset_of[a] = _removable_offset(x, y, before, a, after, min_edge, max_cos, min_offset)
        offset_of[c] = _removable_offset(x, y, before, c, after, min_edge, max_cos, min_offset)
    return 0, head


@entry
def _clean_all(
    xy_m, ring_offset, polygon_offset, min_edge, max_cos, min_offset, min_area, max_sine, max_shift,
    longest_ring, edge, line,
):  # fmt: skip
    num_polygons = len(polygon_offset) - 1
    status = np.zeros(num_polygons, np.int32)
    out_xy = np.empty((len(xy_m), 2))
    out_source = np.empty(len(xy_m), np.int64)
    out_ring_offset = np.zeros(len(ring_offset), np.int64)
    out_polygon_offset = np.zeros(num_polygons + 1, np.int64)
    num_kept = max(longest_ring, len(edge))
    x, y = np.empty(num_kept), np.empty(num_kept)
    corner = np.empty((len(edge), 2))
    source, length = np.empty(longest_ring, np.int64), np.empty(longest_ring)
    before, after = np.empty(longest_ring, np.int64), np.empty(longest_ring, np.int64)
    offset_of = np.empty(longest_ring)
    num_vertices, num_rings = ZERO, ZERO
    for p in range(num_polygons):
        first_vertex, first_ring = num_vertices, num_rings
        code = _EMPTY if polygon_offset[p + 1] <= polygon_offset[p] else _OK
        for ring in range(polygon_offset[p], polygon_offset[p + 1]):
            start, n = ring_offset[ring], ring_offset[ring + 1] - ring_offset[ring]
            if n > _MAX_RAW_VERTICES:
                code = _TOO_MANY_EDGES
                break
            for k in range(n):
                if not (abs(xy_m[start + k, 0]) < _FARTHEST_M and abs(xy_m[start + k, 1]) < _FARTHEST_M):
                    code = _NON_FINITE
            if code != _OK:
                break
            exterior = ring == polygon_offset[p]
            if n < 3:
                if exterior:
                    code = _EMPTY
                    break
                continue
            area = 0.0
            for k in range(n):
                x[k], y[k] = xy_m[start + k, 0] - xy_m[start, 0], xy_m[start + k, 1] - xy_m[start, 1]
            for k in range(n):
                m = k + 1 if k + 1 < n else 0
                area += 0.5 * (x[k] * y[m] - x[m] * y[k])
            # reverse a ring of the wrong orientation; its edges then start where they ended
            forward = (area > 0.0) == exterior
            for k in range(n):
                m = k if forward else n - 1 - k
                x[k], y[k] = xy_m[start + m, 0] - xy_m[start, 0], xy_m[start + m, 1] - xy_m[start, 1]
                source[k] = start + (m if forward else (m - 1 if m > 0 else n - 1))
                before[k] = k - 1 if k > 0 else n - 1
                after[k] = k + 1 if k + 1 < n else 0
            for k in range(n):
                length[k] = np.hypot(x[after[k]] - x[k], y[after[k]] - y[k])
            left, head = _thin_out_ring(
                x, y, source, length, before, after, offset_of, n, min_edge, max_cos, min_offset
            )
            area = 0.0
            lowest = head
            k = head
            for _ in range(left):
                m = after[k]
                area += 0.5 * (x[k] * y[m] - x[m] * y[k])
                lowest = min(lowest, k)
                k = m
            if left < 3 or abs(area) < min_area:
                if exterior:
                    code = _TOO_SMALL
                    break
                continue  # a courtyard this small is dropped
            k = lowest  # the first of the vertices that stay remains the first
            for _ in range(left):
                out_xy[num_vertices, 0] = x[k] + xy_m[start, 0]
                out_xy[num_vertices, 1] = y[k] + xy_m[start, 1]
                out_source[num_vertices] = source[k]
                num_vertices += 1
                k = after[k]
            num_rings += 1
            out_ring_offset[num_rings] = num_vertices
        if code == _OK and num_vertices - first_vertex > len(edge):
            code = _TOO_MANY_EDGES
        if code == _OK:
            code, _ = load_footprint(out_xy, out_ring_offset, first_ring, num_rings, edge)
        if code == _OK and max_sine > 0.0:
            n = num_vertices - first_vertex
            if straighten(edge, n, max_sine, max_shift, min_offset, line, corner):
                origin_x, origin_y = out_xy[first_vertex, 0], out_xy[first_vertex, 1]
                for k in range(n):
                    x[k], y[k] = out_xy[first_vertex + k, 0], out_xy[first_vertex + k, 1]
                    if corner[k, 0] != edge[k].x or corner[k, 1] != edge[k].y:
                        out_xy[first_vertex + k, 0] = corner[k, 0] + origin_x
                        out_xy[first_vertex + k, 1] = corner[k, 1] + origin_y
                code, _ = load_footprint(out_xy, out_ring_offset, first_ring, num_rings, edge)
                if code == _OK:
                    code = check_rings(edge, out_ring_offset, first_ring, num_rings)
                if code != _OK:  # straightening would make it invalid
                    for k in range(n):
                        out_xy[first_vertex + k, 0], out_xy[first_vertex + k, 1] = x[k], y[k]
                    code, _ = load_footprint(out_xy, out_ring_offset, first_ring, num_rings, edge)
        if code == _OK:
            code = check_rings(edge, out_ring_offset, first_ring, num_rings)
        if code != _OK:
            num_vertices, num_rings = first_vertex, first_ring
        status[p] = code
        out_polygon_offset[p + 1] = num_rings
    return (
        out_xy[:num_vertices],
        out_ring_offset[: num_rings + 1],
        out_polygon_offset,
        out_source[:num_vertices],
        status,
    )


def clean(
    polygons: Polygons,
    *,
    min_edge_m: float = 0.05,
    min_turn_deg: float = 3.0,
    min_offset_m: float = 0.02,
    min_area_m2: float = 0.1,
    parallel_deg: float = 2.5,
    max_shift_m: float = 0.05,
) -> Cleaned:
    """Clean polygons in any state; see :class:`Cleaned`.

    A vertex is removed if one of its edges is shorter than ``min_edge_m`` (a repeated vertex is such a case),
    if the ring turns there by less than ``min_turn_deg``, or by less than that from a full reversal (a
    spike), or if the vertex is within ``min_offset_m`` of the line between its neighbours; the one nearest to
    that line is removed first. Exteriors become counter-clockwise, courtyards clockwise. A courtyard smaller
    than ``min_area_m2`` is dropped. A polygon that is then not simple, smaller than ``min_area_m2``, or has a
    courtyard outside its exterior is rejected: it stays in its row, without rings.

    Finally, edges that are parallel to within ``parallel_deg`` (0: none) become exactly parallel, in their
    mean direction weighted by squared length, and edges of one direction within ``min_offset_m`` of one line
    become collinear, as far as no corner moves by more than ``max_shift_m``. Otherwise a millimetre would
    decide which of two wavefront edges continues where they meet.

    Never raises for any coordinates.
    """
    xy_m = writable(polygons.xy_m, np.float64).reshape(-1, 2)
    ring_offset = writable(polygons.ring_offset, np.int64)
    longest = int(min(np.diff(ring_offset).max(initial=3), _MAX_RAW_VERTICES))
    largest = int(min(max(np.diff(polygons.vertex_offset).max(initial=3), 16), MAX_EDGES))
    xy, ring, polygon, source, status = _clean_all(
        xy_m,
        ring_offset,
        writable(polygons.polygon_offset, np.int64),
        float(min_edge_m),
        float(np.cos(np.radians(min_turn_deg))),
        float(min_offset_m),
        float(min_area_m2),
        float(np.sin(np.radians(parallel_deg))),
        float(max_shift_m),
        longest,
        np.zeros(largest, EDGE),
        np.zeros(largest, LINE),
    )
    return Cleaned(Polygons(xy, ring, polygon), source, status)
