"""Moves the planes of a mesh by as little as possible so that the planes at a place meet in one point."""

from collections.abc import Collection

import numpy as np

from p2wss.mesh.mesh import Mesh
from p2wss.skeleton.compiled import allocating, both, entry, inner
from p2wss.skeleton.groups import grouped
from p2wss.skeleton.ordering import sorted_by
from p2wss.skeleton.types import FaceKind, distinct, writable

# metres: vertices that would move by less than this stay, to the bit
EXACT_M = 1e-6
# how much more the heights count that result from tilting a level roof; roofs narrower than the second share of their
# length have no slope across
_STIFF, _THIN = 100.0, 1e-12
# square metres: smaller and larger roofs count as these
_LEAST_M2, _MOST_M2 = 0.01, 1e6
# planes that nearly meet in a line, to this share, do not move their point along the line
_RANK = 1e-2
# added to the diagonal of the normal equations: changes of planes that hardly move a vertex are not made
_NO_CHANGE = 1e-10
# larger changes of planes are no solution, and their squares may overflow
_NO_SOLUTION_M = 1e6
_NUM_ROUNDS = 4
# rotations after which a matrix of three rows is diagonal to the last bit
_NUM_TURNS = 18
# a smaller share off the diagonal counts as zero
_NO_TURN = 1e-30
# planes move only up to this many planes away from a place where planes do not meet
_NUM_RINGS = 2
# a plane with this many places or more moves only for places where it does not meet other planes
_MANY_PLACES = 16
_GROUND, _WALL, _FLAT = int(FaceKind.GROUND), int(FaceKind.WALL), int(FaceKind.FLAT)
# a plane that meets other planes more often than this is among the last in the equations
_MANY_MEETINGS = 200
# about this many planes and places are solved for together
_TOGETHER = 60
# a triangle is turned over if twice its area along its former normal is less than minus this
NO_AREA_M2 = 1e-6


def with_meeting_planes(
    mesh: Mesh, place: np.ndarray, more: Collection[tuple[int, int]] = ()
) -> tuple[Mesh, np.ndarray]:
    """(mesh, apart_m (v,)): the mesh after the smallest change of its planes that makes the planes at each place meet
    in one point, and how far the planes of each vertex still are from its point, where they cannot meet.

    place: int (v,): vertices with the same number become one point. more: (vertex, plane of ``mesh.planes``), further
    planes through the places of vertices. Roofs may tilt, and walls between roofs may shift and turn; floors and the
    walls on them stay. While vertices stay, the conditions are linear in the changes of the planes. As vertices follow
    their planes, the least squares are solved a few times.
    """
    planes, (vertex, plane), num = mesh.planes, mesh.at, len(mesh.planes.kind)
    # any vertex of a place may stand for it, as the conditions are linear
    _, first, place = np.unique(place, return_index=True, return_inverse=True)
    further = np.array(list(more), int).reshape(-1, 2)
    pairs = np.concatenate([place[vertex] * num + plane, place[further[:, 0]] * num + further[:, 1]])
    at, plane_at = np.divmod(distinct(pairs), num)
    vertex_m = writable(mesh.vertex_m, np.float64)
    point_m, apart_m = _meeting_points(
        vertex_m, first, vertex, plane, at, plane_at, (planes.kind, planes.normal, planes.area_m2)
    )
    moved_m = point_m[place, :3]
    stays = np.abs(moved_m - vertex_m) < EXACT_M
    moved = mesh if stays.all() else mesh.moved(np.where(stays, vertex_m, moved_m))
    return moved, apart_m[place]


@entry
def _meeting_points(
    vertex_m: np.ndarray,
    first: np.ndarray,
    vertex: np.ndarray,
    plane: np.ndarray,
    at: np.ndarray,
    plane_at: np.ndarray,
    planes: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """The result of :func:`points` for planes of a mesh. first: int64 (n,), a vertex of each place. vertex, plane: all
    pairs of a vertex and a plane there. at, plane_at: all pairs of a place and a plane there. planes: see
    :func:`equations`."""
    row, scale = equations(vertex_m, vertex, plane, planes, np.zeros(len(planes[0]), np.bool_), True)
    return points(vertex_m[first], row, scale, at, plane_at, np.ones(len(first), np.bool_), False)


@allocating
def points(
    first_m: np.ndarray,
    row: np.ndarray,
    scale: np.ndarray,
    at: np.ndarray,
    plane: np.ndarray,
    counts: np.ndarray,
    corners_stay: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """(points (n, 4), a 1 last, where planes meet; how far the furthest plane is from each point, (n,), 0
    for places that do not count).

    Changes ``row`` in place. row, scale: see :func:`equations`. first_m: (n, 3), where the points are now. at, plane:
    pairs of places and planes, ascending. counts: bool (n,), the places where planes shall meet; places around these
    are added to it. corners_stay: whether points stay if none of their planes can move: a corner of the footprint
    within a wall may be a millimetre off its line.
    """
    num, num_planes = len(first_m), len(row)
    point_m, moves, can_move = np.ones((num, 4)), np.zeros(num_planes, np.bool_), np.zeros(num, np.bool_)
    point_m[:, :3] = first_m
    for p in range(num_planes):
        moves[p] = (scale[p] != 0).any()
    for k, place in enumerate(at):
        can_move[place] |= moves[plane[k]] or not corners_stay
    apart_m = _apart_m(row, point_m, at, plane)
    is_off = can_move & counts & (apart_m >= EXACT_M)
    if is_off.any():
        together = _together(row, at, plane, moves, is_off)
        is_own, is_here, here = (
            np.empty(num_planes, np.bool_),
            np.empty(num, np.bool_),
            np.empty(num, np.int64),
        )
        for number in range(together.max() + 1):
            is_own[:] = moves & (together[:num_planes] == number)
            is_here[:] = together[num_planes:] == number
            is_here[at[is_own[plane]]] = True
            own = is_here[at]
            own_at, own_plane, count = at[own], plane[own], 0
            for k, place in enumerate(own_at):
                if not count or here[count - 1] != place:
                    here[count], counts[place], count = place, True, count + 1
                own_at[k] = count - 1
            point_m[here[:count]] = _met(row, scale, is_own, point_m[here[:count]], own_at, own_plane)
        apart_m = _apart_m(row, point_m, at, plane)
    apart_m[~(can_move & counts)] = 0.0
    return point_m, apart_m


@allocating
def _together(
    row: np.ndarray, at: np.ndarray, plane: np.ndarray, moves: np.ndarray, is_off: np.ndarray
) -> np.ndarray:
    """int (p + n,): numbers of the groups of planes, then places, that are solved for together. Planes and places that
    depend on each other are in one group, and small groups are joined. -1 for all that do not depend on a place
    ``is_off``, bool (n,), where planes do not meet."""
    num, num_planes = len(is_off), len(moves)
    is_linked = is_near(is_off, moves, at, plane, np.ones(len(at), np.bool_))
    # planes depend on each other at a place where more of them meet than determine a point
    is_place = np.zeros(num, np.bool_)
    is_place[at[is_linked]] = True
    here = is_place[at]
    num_spare, places = np.zeros(num, np.int64), np.flatnonzero(is_place)
    num_spare[places] = -_inverses(row, at[here], plane[here])[1]
    for place in at[here]:
        num_spare[place] += 1
    is_linked = is_near(is_off, moves, at, plane, (is_off | (num_spare > 0))[at])
    part = grouped(num_planes + num, np.column_stack((plane[is_linked], num_planes + at[is_linked])))
    size, is_wrong = np.zeros(part.max() + 1, np.int64), np.zeros(part.max() + 1, np.bool_)
    for k, number in enumerate(part):
        size[number] += 1
        if k >= num_planes:
            is_wrong[number] |= is_off[k - num_planes]
    together = np.cumsum(size * is_wrong) // _TOGETHER
    together[~is_wrong] = -1
    return together[part]


@allocating
def is_near(
    is_off: np.ndarray, moves: np.ndarray, at: np.ndarray, plane: np.ndarray, is_link: np.ndarray
) -> np.ndarray:
    """bool (k,): which pairs of a place and a plane that moves are only a few links away from a place where planes do
    not meet. A change fades from plane to plane, so that planes further away stay. is_off: bool (n,), whether planes do
    not meet at a place. at, plane: the pairs (k,). is_link: bool (k,), which pairs are links."""
    # a plane with many places moves only for its own places where planes do not meet
    num_places = np.zeros(len(moves), np.int64)
    for k, place in enumerate(at):
        num_places[plane[k]] += not is_off[place]
    is_near, is_moved, result = is_off.copy(), np.zeros(len(moves), np.bool_), is_link & moves[plane]
    result &= is_off[at] | (num_places[plane] < _MANY_PLACES)
    for _ in range(_NUM_RINGS):
        is_moved[:] = False
        is_moved[plane[result & is_near[at]]] = True
        is_near[at[result & is_moved[plane]]] = True
    return result & is_moved[plane] & is_near[at]


def turned_over(mesh: Mesh, before: Mesh) -> np.ndarray:
    """bool (t,): which triangles of a mesh face away from the normals of their planes in ``before``."""
    normal = before.planes.normal[before.number]
    return np.asarray((mesh.doubled_m2 * normal).sum(axis=1) < -NO_AREA_M2)


@allocating
def equations(
    vertex_m: np.ndarray,
    vertex: np.ndarray,
    plane: np.ndarray,
    planes: tuple[np.ndarray, np.ndarray, np.ndarray],
    is_free: np.ndarray,
    turns: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """(rows (p, 4), scales (p, 4, 3)) of the planes of a mesh.

    The distance of a point (x, y, z) from a plane is the product of (x, y, z, 1) with its row. For a roof, the row has
    the slopes from least squares and -1 and gives the distance upright; for other planes it has the unit normal. A
    change of a plane is a vector (3,); ``scale`` times it is the change of the row. It is scaled so that it is as long
    as the vector of the changes in height of the vertices, for a roof times the fourth root of its area for each
    vertex: a large roof changes less than a small one, which a change in full would spoil. vertex, plane: all pairs of
    a vertex and a plane there. planes: (kinds (p,), unit normals (p, 3), areas (p,)), areas of 0 if they do not count.
    is_free: bool (p,), walls that may shift though they are on floors. turns: whether walls between roofs may turn.
    """
    kind, normal, area_m2 = planes
    num, on_floor = len(kind), np.zeros(len(vertex_m), np.bool_)
    size, base, stands = np.zeros(num), np.zeros((num, 3)), np.zeros(num, np.bool_)
    for k, p in enumerate(plane):
        size[p] += 1
        for i in range(3):
            base[p, i] += vertex_m[vertex[k], i]
        on_floor[vertex[k]] |= kind[p] == _GROUND
    base /= size.reshape(-1, 1)
    # for vertices relative to their mean: the sums of squares of x and y and of their products with heights
    row, scale, sums = np.zeros((num, 4)), np.zeros((num, 4, 3)), np.zeros((num, 2, 3))
    stiff = np.ones(num)
    stiff[kind == _FLAT] = _STIFF
    # the ends of walls on the floor
    ends_m = np.zeros((num, 2, 2))
    for k, p in enumerate(plane):
        x, y, z = vertex_m[vertex[k], 0], vertex_m[vertex[k], 1], vertex_m[vertex[k], 2]
        if kind[p] == _WALL and on_floor[vertex[k]]:
            for a, ahead in enumerate((-1.0, 1.0)):
                away_x, away_y = ahead * (x - ends_m[p, a, 0]), ahead * (y - ends_m[p, a, 1])
                if not stands[p] or away_y * normal[p, 0] > away_x * normal[p, 1]:
                    ends_m[p, a, 0], ends_m[p, a, 1] = x, y
            stands[p] = True
        x, y, z = (x - base[p, 0]) * stiff[p], (y - base[p, 1]) * stiff[p], z - base[p, 2]
        for a, away_m in enumerate((x, y)):
            sums[p, a, 0] += away_m * x
            sums[p, a, 1] += away_m * y
            sums[p, a, 2] += away_m * z
    for p in range(num):
        row[p, :3] = normal[p]
        x, y = ends_m[p, 1, 0] - ends_m[p, 0, 0], ends_m[p, 1, 1] - ends_m[p, 0, 1]
        if stands[p] and not is_free[p] and np.hypot(x, y) > EXACT_M:
            # whatever the vertices above say
            row[p, 0], row[p, 1] = y / np.hypot(x, y), -x / np.hypot(x, y)
            base[p, 0], base[p, 1] = ends_m[p, 0, 0], ends_m[p, 0, 1]
        # walls shift only, unless they stand on a floor or may turn
        if kind[p] == _WALL and (is_free[p] or not stands[p]):
            scale[p, 3, 2] = 1 / np.sqrt(size[p])
            x, y = -normal[p, 1], normal[p, 0]
            long = x * x * sums[p, 0, 0] + 2 * x * y * sums[p, 0, 1] + y * y * sums[p, 1, 1]
            if turns and not stands[p] and long > EXACT_M:
                x, y = x / np.sqrt(long), y / np.sqrt(long)
                scale[p, 0, 0], scale[p, 1, 0], scale[p, 3, 0] = x, y, -x * base[p, 0] - y * base[p, 1]
        elif kind[p] != _WALL and kind[p] != _GROUND:
            (xx, xy, xz), (_, yy, yz) = sums[p]
            turn = np.arctan2(2 * xy, xx - yy) / 2
            x, y = np.cos(turn), np.sin(turn)
            long = x * x * xx + 2 * x * y * xy + y * y * yy
            row[p, 0], row[p, 1], row[p, 2], scale[p, 3, 2] = 0.0, 0.0, -1.0, 1 / np.sqrt(size[p])
            for k, length in enumerate((long, xx + yy - long)):
                rise = x * xz + y * yz if length > _THIN * max(long, size[p]) else 0.0
                for a, along in enumerate((x, y)):
                    row[p, a] += stiff[p] * along * rise / max(length, 1e-300)
                    scale[p, a, k] = along / np.sqrt(max(length, EXACT_M))
                    scale[p, 3, k] -= base[p, a] * scale[p, a, k]
                x, y = -y, x
        for i in range(3):
            row[p, 3] -= row[p, i] * base[p, i]
        if kind[p] != _WALL and area_m2[p] > 0.0:
            scale[p] *= (size[p] / min(max(area_m2[p], _LEAST_M2), _MOST_M2)) ** 0.25
    return row, scale


@allocating
def _apart_m(row: np.ndarray, point_m: np.ndarray, at: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """(n,): the distance of each point from the furthest of its planes. point_m: (n, 4), a 1 last. at, plane: pairs of
    points and planes."""
    result = np.zeros(len(point_m))
    for k, place in enumerate(at):
        result[place] = max(result[place], abs(_off_m(row, plane[k], point_m, place)))
    return result


@inner
def _off_m(row: np.ndarray, plane: int, point_m: np.ndarray, place: int) -> float:
    """The signed distance of a point from a plane (:func:`equations`)."""
    result = 0.0
    for b in range(4):
        result += row[plane, b] * point_m[place, b]
    return result


@allocating
def _met(
    row: np.ndarray,
    scale: np.ndarray,
    moves: np.ndarray,
    point_m: np.ndarray,
    at: np.ndarray,
    plane: np.ndarray,
) -> np.ndarray:
    """The points (n, 4) where planes meet after the least changes of the planes that move. Changes ``row`` and
    ``point_m`` in place. moves: bool (p,). at, plane: pairs of points and planes, ascending."""
    number = np.cumsum(moves) - 1
    number[~moves] = -1
    begin = np.searchsorted(at, np.arange(len(point_m) + 1))
    inverse, _ = _inverses(row, at, plane)
    for _ in range(_NUM_ROUNDS):
        is_off, pair, share, right = _sums(row, scale, number, point_m, inverse, begin, plane)
        if not is_off:
            break
        change = _solved(pair, share, right)
        # a larger change, or NaN: the points diverge, or the equations have no solution, so these planes do not meet
        if len(change) and not np.abs(change).max() < _NO_SOLUTION_M:
            break
        inverse = _followed(row, scale, number, change, point_m, begin, at, plane)
    return point_m


@allocating
def _inverses(row: np.ndarray, at: np.ndarray, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(inverse (n, 3, 3), rank (n,)) of the normal equations of the point where the planes at each place meet.

    The step to that point is minus the inverse times the sum of the rows of its planes, each times the distance of the
    plane. rank: the number of directions that the planes determine. at, plane: the pairs (k,) of places, ascending, and
    planes. By rotations (Jacobi 1846) that make the matrix of each place diagonal.
    """
    num = 0
    for k in range(len(at)):
        num += k == 0 or at[k] != at[k - 1]
    inverse, rank = np.zeros((num, 3, 3)), np.zeros(num, np.int64)
    square, axes, unit, begin = np.empty((3, 3)), np.empty((3, 3)), np.eye(3), 0
    for place in range(num):
        square[:], axes[:], k = 0.0, unit, begin
        while k < len(at) and at[k] == at[begin]:
            for a in range(3):
                for b in range(3):
                    square[a, b] += row[plane[k], a] * row[plane[k], b]
            k += 1
        begin = k
        least = _NO_TURN * (square[0, 0] + square[1, 1] + square[2, 2])
        for turn in range(_NUM_TURNS):
            p, q = turn % 3, (turn + 1) % 3
            if max(abs(square[0, 1]), max(abs(square[1, 2]), abs(square[2, 0]))) <= least:
                break
            if abs(square[p, q]) <= 1e-300:
                continue
            ratio = (square[q, q] - square[p, p]) / (2 * square[p, q])
            tangent = (1.0 if ratio >= 0 else -1.0) / (abs(ratio) + np.sqrt(ratio * ratio + 1.0))
            cosine = 1 / np.sqrt(tangent * tangent + 1.0)
            sine = tangent * cosine
            for a in range(3):
                one, other = square[a, p], square[a, q]
                square[a, p], square[a, q] = cosine * one - sine * other, sine * one + cosine * other
            for a in range(3):
                one, other = square[p, a], square[q, a]
                square[p, a], square[q, a] = cosine * one - sine * other, sine * one + cosine * other
                one, other = axes[a, p], axes[a, q]
                axes[a, p], axes[a, q] = cosine * one - sine * other, sine * one + cosine * other
        longest = max(square[0, 0], square[1, 1], square[2, 2])
        for k in range(3):
            if square[k, k] > _RANK * _RANK * longest:
                rank[place] += 1
                for a in range(3):
                    for b in range(3):
                        inverse[place, a, b] += axes[a, k] * axes[b, k] / square[k, k]
    return inverse, rank


@allocating
def _sums(
    row: np.ndarray,
    scale: np.ndarray,
    number: np.ndarray,
    point_m: np.ndarray,
    inverse: np.ndarray,
    begin: np.ndarray,
    plane: np.ndarray,
) -> tuple[bool, np.ndarray, np.ndarray, np.ndarray]:
    """The normal equations of the changes of planes: (whether some planes do not meet yet, pairs of planes (k, 2), what
    each pair adds to the matrix (k, 3, 3), right sides (num, 3)). number: (p,), the number of each plane that moves, -1
    if it stays. begin: (n + 1,), the first element of each point in ``plane``."""
    num_pairs, off_m, is_off = 0, np.empty(len(plane)), False
    lever = np.zeros((len(plane), 3))
    for at in range(len(inverse)):
        num_moved = 0
        for i in range(begin[at], begin[at + 1]):
            num_moved += number[plane[i]] >= 0
            off_m[i] = _off_m(row, plane[i], point_m, at)
            for b in range(4):
                for a in range(3):
                    lever[i, a] += point_m[at, b] * scale[plane[i], b, a]
            is_off |= abs(off_m[i]) >= EXACT_M
        num_pairs += num_moved * num_moved
    pair, share = np.empty((num_pairs, 2), np.int64), np.empty((num_pairs, 3, 3))
    right, count = np.zeros((number.max() + 1, 3)), 0
    for at in range(len(inverse)):
        for i in range(begin[at], begin[at + 1]):
            one = number[plane[i]]
            for j in range(begin[at], begin[at + 1] if one >= 0 else 0):
                # the part of the distances that no move of the point can remove
                apart, other = 1.0 if i == j else 0.0, number[plane[j]]
                for a in range(3):
                    for b in range(3):
                        apart -= row[plane[i], a] * inverse[at, a, b] * row[plane[j], b]
                for a in range(3):
                    right[one, a] += apart * off_m[j] * lever[i, a]
                    for b in range(3 if other >= 0 else 0):
                        share[count, a, b] = apart * lever[i, a] * lever[j, b]
                if other >= 0:
                    pair[count, 0], pair[count, 1] = one, other
                    count += 1
    return is_off, pair, share, right


@allocating
def _followed(
    row: np.ndarray,
    scale: np.ndarray,
    number: np.ndarray,
    change: np.ndarray,
    point_m: np.ndarray,
    begin: np.ndarray,
    at: np.ndarray,
    plane: np.ndarray,
) -> np.ndarray:
    """Changes the rows of planes, then moves the points to where they meet, both in place. Returns the inverses of
    :func:`_inverses` for the new rows."""
    for p in range(len(number)):
        if number[p] >= 0:
            for b in range(4):
                for a in range(3):
                    row[p, b] -= scale[p, b, a] * change[number[p], a]
    inverse, _ = _inverses(row, at, plane)
    way_m = np.empty(3)
    for place in range(len(inverse)):
        way_m[:] = 0.0
        for i in range(begin[place], begin[place + 1]):
            off_m = _off_m(row, plane[i], point_m, place)
            for b in range(3):
                way_m[b] += row[plane[i], b] * off_m
        for b in range(3):
            for a in range(3):
                point_m[place, b] -= inverse[place, b, a] * way_m[a]
    return inverse


@both
def _solved(pair: np.ndarray, share: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The least changes (n, 3) that solve normal equations of :func:`_sums`.

    By a Cholesky factorization within the envelope, with planes in the order of Cuthill and McKee (1969). This is fast,
    as few planes meet, and the result does not depend on the threads of a library. A plane that meets many others is
    among the last, as otherwise all of these would come close together in that order.
    """
    num = len(right)
    begin, at = sorted_by(pair[:, 0].copy(), num)
    beside = pair[:, 1][at]
    # breadth first, from each plane that meets no plane before it
    order, place, count = np.empty(num, np.int64), np.full(num, -1), 0
    for is_last in range(2):
        for start in range(num):
            head = count
            if place[start] < 0 and (is_last or begin[start + 1] - begin[start] <= _MANY_MEETINGS):
                order[count], place[start], count = start, count, count + 1
            while head < count:
                for other in beside[begin[order[head]] : begin[order[head] + 1]]:
                    if place[other] < 0 and begin[other + 1] - begin[other] <= _MANY_MEETINGS:
                        order[count], place[other], count = other, count, count + 1
                head += 1
    size = 3 * num
    first = np.empty(size, np.int64)
    for i in range(num):
        lowest = i
        for other in beside[begin[order[i]] : begin[order[i] + 1]]:
            lowest = min(lowest, place[other])
        first[3 * i : 3 * i + 3] = 3 * lowest
    # row i has the columns from first[i] to i; its column j is at at[i] + j
    length = np.arange(1, size + 1) - first
    at = np.cumsum(length) - length - first
    factor = np.zeros(length.sum())
    for k in range(len(pair)):
        i, j = place[pair[k, 0]], place[pair[k, 1]]
        for a in range(3):
            for b in range(3):
                if 3 * j + b <= 3 * i + a:
                    factor[at[3 * i + a] + 3 * j + b] += share[k, a, b]
    result = np.empty(size)
    for i in range(size):
        value = right[order[i // 3], i % 3]
        for j in range(first[i], i + 1):
            total = factor[at[i] + j]
            for k in range(max(first[i], first[j]), j):
                total -= factor[at[i] + k] * factor[at[j] + k]
            if j < i:
                factor[at[i] + j] = total / factor[at[j] + j]
                value -= factor[at[i] + j] * result[j]
            else:
                factor[at[i] + i] = np.sqrt(max(total + _NO_CHANGE, _NO_CHANGE))
        result[i] = value / factor[at[i] + i]
    for i in range(size - 1, -1, -1):
        result[i] /= factor[at[i] + i]
        for j in range(first[i], i):
            result[j] -= factor[at[i] + j] * result[i]
    change = np.empty((num, 3))
    change[order] = result.reshape(num, 3)
    return change
