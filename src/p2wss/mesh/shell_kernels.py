"""Triangles of a solid, compiled: crossings, thin triangles, whether an edge can be removed, and their planes."""

from typing import NamedTuple

import numpy as np

from p2wss.mesh.polygon_kernels import TOUCH_M
from p2wss.skeleton.compiled import ZERO, both, entry, inner
from p2wss.skeleton.ordering import order_of, sorted_by
from p2wss.skeleton.rings import segment_distance_m2
from p2wss.skeleton.types import FaceKind

# radians: two faces with a common edge lie on each other if they enclose a smaller angle
_FOLD_RAD = 1e-3
# metres: a triangle of less height counts as without height, as the rounding of a file may turn its normal
NO_HEIGHT_M = 1e-3
_WALL = int(FaceKind.WALL)


class Triangles(NamedTuple):
    """A mesh for compiled code. vertex_m: float64 (v, 3). triangle: int64 (t, 3). kind: uint8 (t,). label: int64
    (t,)."""

    vertex_m: np.ndarray
    triangle: np.ndarray
    kind: np.ndarray
    label: np.ndarray


@entry
def any_intersect(vertex_m: np.ndarray, triangle: np.ndarray, asked: np.ndarray) -> bool:
    """Whether one of the triangles with the indices ``asked``, int64 (k,), intersects another triangle beyond a common
    vertex or edge. triangle: int64 (t, 3)."""
    num_near, normal = 0, np.empty((len(triangle), 3))
    near, low, high = (
        np.empty(len(triangle), np.int64),
        np.empty((len(triangle), 3)),
        np.empty((len(triangle), 3)),
    )
    # triangles that reach into the box around all triangles that are asked
    least, most = np.full(3, np.inf), np.full(3, -np.inf)
    for s in asked:
        _box(vertex_m, triangle[s], low[0], high[0])
        for i in range(3):
            least[i], most[i] = min(least[i], low[0, i]), max(most[i], high[0, i])
    for t in range(len(triangle)):
        _box(vertex_m, triangle[t], low[num_near], high[num_near])
        is_near = True
        for i in range(3):
            is_near &= low[num_near, i] <= most[i] and high[num_near, i] >= least[i]
        if is_near:
            normal[t] = doubled_area(vertex_m, triangle[t])
            length = max(np.sqrt(normal[t, 0] ** 2 + normal[t, 1] ** 2 + normal[t, 2] ** 2), 1e-300)
            for i in range(3):
                normal[t, i] /= length
            near[num_near], num_near = t, num_near + 1
    # sorted by where they begin along x, so that few are compared
    order = order_of(low[:num_near, 0].copy())
    near, from_m, to_m = near[order], low[order], high[order]
    begin, widest = from_m[:, 0].copy(), (to_m[:, 0] - from_m[:, 0]).max() if num_near else 0.0
    is_done = np.zeros(len(triangle), np.bool_)
    for s in asked:
        is_done[s] = True
        _box(vertex_m, triangle[s], least, most)
        for k in range(np.searchsorted(begin, least[0] - widest), np.searchsorted(begin, most[0])):
            if least[0] > to_m[k, 0] or least[1] > to_m[k, 1] or from_m[k, 1] > most[1]:
                continue
            if least[2] > to_m[k, 2] or from_m[k, 2] > most[2]:
                continue
            t = near[k]
            if not is_done[t] and _triangles_intersect(vertex_m, triangle, normal, s, t):
                return True
    return False


@inner
def _box(vertex_m: np.ndarray, triangle: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """Sets the low and the high end (3,) of the box around a triangle (3,), larger by the distance of a touch."""
    for i in range(3):
        a, b, c = vertex_m[triangle[0], i], vertex_m[triangle[1], i], vertex_m[triangle[2], i]
        low[i], high[i] = min(a, min(b, c)) - TOUCH_M, max(a, max(b, c)) + TOUCH_M


@inner
def doubled_area(vertex_m: np.ndarray, triangle: np.ndarray) -> tuple[float, float, float]:
    """The normal of a triangle (3,), as long as twice its area."""
    one, two, three = triangle
    ux, uy, uz = (
        vertex_m[two, 0] - vertex_m[one, 0],
        vertex_m[two, 1] - vertex_m[one, 1],
        vertex_m[two, 2] - vertex_m[one, 2],
    )
    vx, vy, vz = (
        vertex_m[three, 0] - vertex_m[one, 0],
        vertex_m[three, 1] - vertex_m[one, 1],
        vertex_m[three, 2] - vertex_m[one, 2],
    )
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@entry
def thin_triangles(mesh: Triangles) -> np.ndarray:
    """bool (t,): whether a triangle has no height."""
    result = np.empty(len(mesh.triangle), np.bool_)
    for t in range(len(mesh.triangle)):
        result[t] = is_thin(mesh.vertex_m, mesh.triangle[t])
    return result


@inner
def is_thin(vertex_m: np.ndarray, triangle: np.ndarray) -> bool:
    """Whether a triangle (3,) has no height."""
    x, y, z = doubled_area(vertex_m, triangle)
    longest_m2 = 0.0
    for i in range(3):
        length_m2 = 0.0
        for k in range(3):
            length_m2 += (vertex_m[triangle[i], k] - vertex_m[triangle[i - 1], k]) ** 2
        longest_m2 = max(longest_m2, length_m2)
    return x * x + y * y + z * z < NO_HEIGHT_M * NO_HEIGHT_M * longest_m2


@both
def planes_at(triangle: np.ndarray, label: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """(vertices, labels), int64 (k,): all pairs of a vertex and the label of a triangle there, ascending."""
    begin, corner = sorted_by(triangle.ravel(), num_vertices)
    vertex, plane, num = np.empty(len(corner), np.int64), np.empty(len(corner), np.int64), 0
    for v in range(num_vertices):
        first = num
        for each in corner[begin[v] : begin[v + 1]]:
            here, k = label[each // 3], num
            while k > first and plane[k - 1] > here:
                k -= 1
            if k == first or plane[k - 1] != here:
                for i in range(num, k, -1):
                    plane[i] = plane[i - 1]
                plane[k], vertex[num], num = here, v, num + 1
    return vertex[:num].copy(), plane[:num].copy()


@both
def planes_of(mesh: Triangles, num: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(kinds (p,), unit normals (p, 3), areas (p,)) of the planes of the labels below ``num``.

    A normal is the mean of the normals of its triangles weighted by area, as the normal of a sliver alone is
    unreliable. It is level for walls, which are upright, and 0 for a plane without area.
    """
    vertex_m, triangle, kind, number = mesh
    plane_kind, normal, area_m2 = np.zeros(num, np.uint8), np.zeros((num, 3)), np.empty(num)
    for t in range(len(triangle)):
        plane_kind[number[t]] = kind[t]
        for i, each in enumerate(doubled_area(vertex_m, triangle[t])):
            normal[number[t], i] += each
    for p in range(num):
        if plane_kind[p] == _WALL:
            normal[p, 2] = 0.0
        twice_m2 = np.sqrt(normal[p, 0] ** 2 + normal[p, 1] ** 2 + normal[p, 2] ** 2)
        area_m2[p] = twice_m2 / 2
        for i in range(3):
            normal[p, i] /= max(twice_m2, 1e-12)
    return plane_kind, normal, area_m2


@entry
def can_merge(triangle: np.ndarray, num_vertices: int, end: int, gone: int) -> bool:
    """Whether triangles, int64 (t, 3), stay a manifold if the vertices ``end`` and ``gone`` of an edge become one: they
    have two triangles in common, and no common neighbours but the third corners of these."""
    one, two, three = triangle[:, 0], triangle[:, 1], triangle[:, 2]
    has_end, has_gone = (
        (one == end) | (two == end) | (three == end),
        (one == gone) | (two == gone) | (three == gone),
    )
    is_at_end, is_at_gone = np.zeros(num_vertices, np.bool_), np.zeros(num_vertices, np.bool_)
    is_at_end[triangle[has_end].ravel()], is_at_gone[triangle[has_gone].ravel()] = True, True
    return (has_end & has_gone).sum() == 2 and (is_at_end & is_at_gone).sum() == 4


@inner
def _triangles_intersect(
    vertex_m: np.ndarray, triangle: np.ndarray, normal: np.ndarray, s: int, t: int
) -> bool:
    num_common, free_s, free_t = ZERO, ZERO, ZERO
    for i in range(3):
        for j in range(3):
            if triangle[s, i] == triangle[t, j]:
                num_common += 1
                free_s += i
                free_t += j
    if num_common == 3:
        return True
    if num_common == 2:
        # the corners that are not on the common edge
        return _lie_on_each_other(vertex_m, triangle, s, 3 - free_s, t, 3 - free_t)
    if num_common == 1:
        return _edge_meets(vertex_m, triangle, normal, s, free_s, t) or _edge_meets(
            vertex_m, triangle, normal, t, free_t, s
        )
    if _is_beside(vertex_m, triangle, normal, s, t) or _is_beside(vertex_m, triangle, normal, t, s):
        return False
    for i in range(3):
        if _edge_meets(vertex_m, triangle, normal, s, i, t) or _edge_meets(
            vertex_m, triangle, normal, t, i, s
        ):
            return True
    return False


@inner
def _height(vertex_m: np.ndarray, triangle: np.ndarray, normal: np.ndarray, t: int, v: int) -> float:
    """Signed distance of vertex v from the plane of triangle t."""
    result = 0.0
    for i in range(3):
        result += (vertex_m[v, i] - vertex_m[triangle[t, 0], i]) * normal[t, i]
    return result


@inner
def _is_beside(vertex_m: np.ndarray, triangle: np.ndarray, normal: np.ndarray, s: int, t: int) -> bool:
    """Whether triangle t is wholly on one side of the plane of triangle s."""
    a = _height(vertex_m, triangle, normal, s, triangle[t, 0])
    b = _height(vertex_m, triangle, normal, s, triangle[t, 1])
    c = _height(vertex_m, triangle, normal, s, triangle[t, 2])
    return min(a, min(b, c)) > TOUCH_M or max(a, max(b, c)) < -TOUCH_M


@inner
def _lie_on_each_other(vertex_m: np.ndarray, triangle: np.ndarray, s: int, i: int, t: int, j: int) -> bool:
    """Whether two triangles with a common edge are folded onto each other. Corner i of triangle s and corner j of
    triangle t are not on that edge."""
    a, b = triangle[s, (i + 1) % 3], triangle[s, (i + 2) % 3]
    c, d = triangle[s, i], triangle[t, j]
    length2, c_along, d_along = 0.0, 0.0, 0.0
    for k in range(3):
        u = vertex_m[b, k] - vertex_m[a, k]
        length2 += u * u
        c_along += u * (vertex_m[c, k] - vertex_m[a, k])
        d_along += u * (vertex_m[d, k] - vertex_m[a, k])
    dot, c2, d2 = 0.0, 0.0, 0.0
    for k in range(3):
        u = vertex_m[b, k] - vertex_m[a, k]
        x = vertex_m[c, k] - vertex_m[a, k] - u * c_along / length2
        y = vertex_m[d, k] - vertex_m[a, k] - u * d_along / length2
        dot += x * y
        c2 += x * x
        d2 += y * y
    if c2 < TOUCH_M * TOUCH_M or d2 < TOUCH_M * TOUCH_M:
        return True
    return dot > np.sqrt(c2 * d2) * np.cos(_FOLD_RAD)


@inner
def _edge_meets(
    vertex_m: np.ndarray, triangle: np.ndarray, normal: np.ndarray, s: int, i: int, t: int
) -> bool:
    """Whether the edge opposite corner i of triangle s touches triangle t."""
    p, q = triangle[s, (i + 1) % 3], triangle[s, (i + 2) % 3]
    p_height, q_height = (
        _height(vertex_m, triangle, normal, t, p),
        _height(vertex_m, triangle, normal, t, q),
    )
    if min(p_height, q_height) > TOUCH_M or max(p_height, q_height) < -TOUCH_M:
        return False
    # the triangle seen along the axis in which it is largest
    axis = 0
    for k in range(1, 3):
        if abs(normal[t, k]) > abs(normal[t, axis]):
            axis = k
    x, y = (axis + 1) % 3, (axis + 2) % 3
    from_share, to_share = 0.0, 1.0
    if abs(p_height - q_height) > 2.0 * TOUCH_M:
        # the piece of the edge within the distance of a touch from the plane
        one = (p_height - TOUCH_M) / (p_height - q_height)
        two = (p_height + TOUCH_M) / (p_height - q_height)
        from_share, to_share = max(min(one, two), 0.0), min(max(one, two), 1.0)
    along_x, along_y = vertex_m[q, x] - vertex_m[p, x], vertex_m[q, y] - vertex_m[p, y]
    a = vertex_m[p, x] + from_share * along_x, vertex_m[p, y] + from_share * along_y
    b = vertex_m[p, x] + to_share * along_x, vertex_m[p, y] + to_share * along_y
    near2 = TOUCH_M * TOUCH_M
    num_left, num_right = 0, 0
    for k in range(3):
        start, end = triangle[t, k], triangle[t, (k + 1) % 3]
        c, d = (vertex_m[start, x], vertex_m[start, y]), (vertex_m[end, x], vertex_m[end, y])
        if segment_distance_m2(a, b, c, d) < near2:
            return True
        side = (d[0] - c[0]) * (a[1] - c[1]) - (d[1] - c[1]) * (a[0] - c[0])
        if side > 0.0:
            num_left += 1
        else:
            num_right += 1
    return num_left == 3 or num_right == 3
