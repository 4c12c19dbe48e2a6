"""Removes an edge of a mesh, compiled: what may change around it, where planes meet without it, what has changed."""

import numpy as np

from p2wss.mesh.meeting import EXACT_M, NO_AREA_M2, equations, is_near, points
from p2wss.mesh.shell_kernels import Triangles, doubled_area, planes_at, planes_of
from p2wss.skeleton.compiled import allocating, entry, inner
from p2wss.skeleton.groups import find_reverses, num_slots
from p2wss.skeleton.ordering import sorted_by
from p2wss.skeleton.types import FaceKind

# metres: planes stay if a corner is still further from its plane than this, or moves off its plane by more than the
# second figure
_PLANAR_M, _MAX_MOVE_M = 2e-4, 0.06
# metres: ends of an edge that are nearer to each other may be one vertex in a file
_MERGED_M = 2e-3
_GROUND, _WALL = int(FaceKind.GROUND), int(FaceKind.WALL)


@inner
def _length_m(vertex_m: np.ndarray, start: int, end: int) -> float:
    total = 0.0
    for i in range(3):
        total += (vertex_m[start, i] - vertex_m[end, i]) ** 2
    return np.sqrt(total)


@entry
def beside_edge(
    mesh: Triangles, vertex: np.ndarray, plane: np.ndarray, end: int, gone: int, walls_stay: bool
) -> np.ndarray:
    """bool (t,): which triangles may change if the ends of an edge become one, or are beside such triangles.

    They are of the planes that may move so that planes meet at the edge, and of the planes that meet these, such as
    floors, on which walls stay. vertex, plane: all pairs of a vertex and the label of a triangle there, ascending.
    """
    triangle, kind, label = mesh.triangle, mesh.kind, mesh.label
    num_vertices, num_planes = len(mesh.vertex_m), label.max() + 1
    is_place, is_moved = np.zeros(num_vertices, np.bool_), np.zeros(num_planes, np.bool_)
    # floors and the walls on them stay
    is_on_floor, moves = np.zeros(num_vertices, np.bool_), np.ones(num_planes, np.bool_)
    is_on_floor[triangle[kind == _GROUND].ravel()], moves[label[kind == _GROUND]] = True, False
    for t in range(len(triangle)):
        for corner in triangle[t]:
            moves[label[t]] &= kind[t] != _WALL or not is_on_floor[corner]
    if not walls_stay:
        moves[plane[(vertex == end) | (vertex == gone)]] = True
    is_place[end] = is_place[gone] = True
    is_moved[plane[is_near(is_place, moves, vertex, plane, np.ones(len(vertex), np.bool_))]] = True
    is_place[vertex[is_moved[plane]]] = True
    # and the planes that meet them
    is_moved[plane[is_place[vertex]]] = True
    is_place[vertex[is_moved[plane]]] = True
    result = np.empty(len(triangle), np.bool_)
    for t in range(len(triangle)):
        num = 0
        for corner in triangle[t]:
            num += is_place[corner]
        result[t] = num >= 2
    return result


@entry
def contracted(
    mesh: Triangles, end: int, gone: int, short_m: float, walls_stay: bool
) -> tuple[bool, np.ndarray, np.ndarray, np.ndarray]:
    """(whether it is possible, vertices (v, 3), triangles (t, 3), which of them are left, bool (t,)) after the least
    changes of planes that make the ends of an edge one vertex. If ``end`` and ``gone`` are both -1, no edge is removed,
    and the planes at all vertices meet exactly."""
    vertex_m, triangle, kind, label = mesh
    joined, stays = triangle.copy(), np.ones(len(triangle), np.bool_)
    is_free, is_on_floor = np.zeros(label.max() + 1, np.bool_), False
    for t in range(len(triangle)):
        has_end, has_gone = False, False
        for k in range(3):
            has_end |= triangle[t, k] == end
            if triangle[t, k] == gone:
                has_gone, joined[t, k] = True, end
        stays[t] = gone == end or not (has_end and has_gone)
        is_on_floor |= has_gone and kind[t] == _GROUND
    if not walls_stay:
        vertex, plane = planes_at(triangle, label, len(vertex_m))
        for k, v in enumerate(vertex):
            # planes at only one of the ends are free
            if v in (end, gone):
                is_free[plane[k]] = not is_free[plane[k]]
    tried, place, origin, is_met, moved_m = mesh, joined, gone, False, vertex_m
    # first all planes of both ends, then only the planes that are left without the edge
    for attempt in range(1 if gone == end or is_on_floor else 2):
        if attempt == 1:
            place, origin, is_free[:] = joined[stays], end, False
            tried = Triangles(vertex_m, place, kind[stays], label[stays])
        is_met, moved_m = _met(tried, place, end, origin, short_m, is_free)
        if is_met:
            break
    return is_met, moved_m, joined, stays


@allocating
def _met(
    mesh: Triangles, joined: np.ndarray, end: int, gone: int, short_m: float, is_free: np.ndarray
) -> tuple[bool, np.ndarray]:
    """(whether planes meet after a change of centimetres, without turning walls if possible; the vertices then).

    joined: the triangles, (t, 3), with ``end`` in place of ``gone``, as both become one point. The planes at ``end``
    shall meet; if it is -1, the planes at all vertices. is_free: see :func:`p2wss.mesh.meeting.equations`.
    """
    vertex_m, triangle, kind, label = mesh
    num_vertices, walls_stay = len(vertex_m), not is_free.any()
    vertex, plane = planes_at(triangle, label, num_vertices)
    at, plane_at = planes_at(joined, label, num_vertices)
    plane_kind, normal, area_m2 = planes_of(mesh, len(is_free))
    first_m = vertex_m.copy()
    # either end may stand for the point, as the conditions are linear
    first_m[end] = vertex_m[min(end, gone)]
    # large roofs change less than small ones; if that is too much for these, all alike
    for by_area, turns in ((1.0, False), (1.0, True), (0.0, False), (0.0, True)):
        row, scale = equations(
            vertex_m, vertex, plane, (plane_kind, normal, by_area * area_m2), is_free, turns
        )
        counts = (np.arange(num_vertices) == end) | (end < 0)
        point_m, apart_m = points(first_m, row, scale, at, plane_at, counts, walls_stay)
        if apart_m.max() > _PLANAR_M:
            continue
        moved_m, is_moved = vertex_m.copy(), np.zeros(num_vertices, np.bool_)
        for v in range(num_vertices):
            place = end if v == gone else v
            for i in range(3):
                if abs(point_m[place, i] - vertex_m[v, i]) >= EXACT_M:
                    moved_m[v, i], is_moved[v] = point_m[place, i], True
        if not is_moved.any():
            return True, moved_m
        most_m, num_over, floors_stay = 0.0, 0, True
        # only the move off a plane counts: along it, a vertex may move further, as where roofs of nearly the same
        # slope meet
        for k, v in enumerate(vertex):
            off_m = 0.0
            for i in range(3):
                off_m += (moved_m[v, i] - vertex_m[v, i]) * normal[plane[k], i]
            most_m = max(most_m, abs(off_m))
        for t in range(len(triangle)):
            num_over += _is_turned_over(moved_m, triangle[t], normal[label[t]])
            num_over -= _is_turned_over(vertex_m, triangle[t], normal[label[t]])
            for corner in triangle[t]:
                floors_stay &= kind[t] != _GROUND or not is_moved[corner]
        # walls on floors stay unless they are free
        if (floors_stay or not walls_stay) and most_m <= max(_MAX_MOVE_M, short_m) and num_over <= 0:
            return True, moved_m
    return False, vertex_m


@inner
def _is_turned_over(vertex_m: np.ndarray, triangle: np.ndarray, normal: np.ndarray) -> bool:
    x, y, z = doubled_area(vertex_m, triangle)
    return x * normal[0] + y * normal[1] + z * normal[2] < -NO_AREA_M2


@entry
def changes(
    mesh: Triangles, num_same: int, before: Triangles, is_changed: np.ndarray
) -> tuple[bool, np.ndarray]:
    """(whether a change has kept a mesh as closed as it was; int64 (k,), the triangles that may cross others now).

    The mesh is as closed as before if the sides without a second triangle are the same, in the same places, no more
    sides are repeated, and the shortest edge is long enough for a file or no shorter than the shortest before. The
    first ``num_same`` triangles are as before; the others replace the triangles ``is_changed``, bool (t,), of
    ``before``.
    """
    vertex_m, before_m = mesh.vertex_m, before.vertex_m
    own, old = mesh.triangle[num_same:], before.triangle[is_changed]
    num_vertices, least_m, least_before_m = len(vertex_m), np.inf, _MERGED_M
    for corner in own:
        for k in range(3):
            least_m = min(least_m, _length_m(vertex_m, corner[k], corner[k - 1]))
    for corner in before.triangle:
        for k in range(3):
            least_before_m = min(least_before_m, _length_m(before_m, corner[k], corner[k - 1]))
    (start, end, num_more), (old_start, old_end, num_before) = (
        _open_sides(own, num_vertices),
        _open_sides(old, num_vertices),
    )
    is_as_closed = len(start) == len(old_start) and num_more <= num_before and least_m >= least_before_m
    for k in range(len(start) if is_as_closed else 0):
        is_as_closed &= start[k] == old_start[k] and end[k] == old_end[k]
        for i in range(3):
            is_as_closed &= vertex_m[start[k], i] == before_m[start[k], i]
    asked, num = np.empty(len(own), np.int64), 0
    begin, at = sorted_by(old.ravel(), num_vertices)
    for t in range(len(own)):
        a, b, c = own[t]
        is_same = False
        for each in at[begin[a] : begin[a + 1]]:
            has_b, has_c = False, False
            for other in old[each // 3]:
                has_b |= other == b
                has_c |= other == c
            is_same |= has_b and has_c
        for v in own[t]:
            for i in range(3):
                is_same &= vertex_m[v, i] == before_m[v, i]
        if not is_same:
            asked[num], num = num_same + t, num + 1
    return is_as_closed, asked[:num].copy()


@allocating
def _open_sides(triangle: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray, int]:
    """(starts, ends, number): the ends of the sides that have no triangle on the other hand, ascending; and how often
    two triangles have the same side in the same direction."""
    corner, num_half, num, num_more = triangle.ravel(), triangle.size, 0, 0
    ahead = np.empty(num_half, np.int64)
    for half in range(num_half):
        ahead[half] = corner[half + 1 if half % 3 < 2 else half - 2]
    by_end = sorted_by(ahead, num_vertices)[1]
    order = by_end[sorted_by(corner[by_end], num_vertices)[1]]
    reverse, slot = np.empty(num_half, np.int64), np.empty(num_slots(num_half), np.int64)
    find_reverses(corner, ahead, slot, reverse)
    start, end = np.empty(num_half, np.int64), np.empty(num_half, np.int64)
    for k, half in enumerate(order):
        before = order[max(k - 1, 0)]
        num_more += k > 0 and corner[half] == corner[before] and ahead[half] == ahead[before]
        if reverse[half] < 0:
            start[num], end[num], num = corner[half], ahead[half], num + 1
    return start[:num].copy(), end[:num].copy(), num_more
