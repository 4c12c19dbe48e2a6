"""Borders between the faces of a roof in plan, straightened, and the faces of the solid below them, compiled."""

from __future__ import annotations

import numpy as np

from p2wss.fit.planes.ring_kernels import rings_around
from p2wss.skeleton.compiled import ZERO, allocating, entry, inner
from p2wss.skeleton.ordering import sorted_by

# the number of the face outside the footprint, and of cells without a building
OUTSIDE = -1
# metres: sides this short have no length, and a vertex this near to the straight line between its neighbours is dropped
STRAIGHT_M = 4e-3
# metres: heights nearer to each other are one
SAME_HEIGHT_M = 4e-3


@entry
def straightened(
    side: np.ndarray,
    face: np.ndarray,
    line: np.ndarray,
    xy_m: np.ndarray,
    is_fixed: np.ndarray,
    short_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(side, face, line) without sides shorter than ``short_m`` and without vertices within straight edges.

    side: int64 (s, 2), the vertices of each side. face: int64 (s, 2), the faces to its left and to its right, or
    OUTSIDE. line: int64 (s,), the line of each side; where two sides become one, the line of the longer one. xy_m:
    (v, 2). is_fixed: bool (v,), vertices that stay. A side of the result has a face to its left; if it has two faces,
    its first vertex has the smaller number.
    """
    side, face, line = side.copy(), face.copy(), line.copy()
    # the order in which sides are made
    rank, num_made, is_gone = np.arange(len(side)), len(side), np.zeros(len(side), np.bool_)
    for k in range(len(side)):
        a, b = side[k]
        if is_gone[k] or np.hypot(xy_m[a, 0] - xy_m[b, 0], xy_m[a, 1] - xy_m[b, 1]) >= short_m:
            continue
        if not is_fixed[b] and _contracted(side, face, line, is_gone, k, a, b):
            continue
        if not is_fixed[a]:
            _contracted(side, face, line, is_gone, k, b, a)
    for k in range(len(side)):
        if is_gone[k]:
            side[k] = -1
    begin, at = sorted_by(side.ravel(), len(xy_m))
    at //= 2
    # each vertex that is dropped adds its two neighbours again
    pending, num = np.empty(3 * len(xy_m) + 1, np.int64), ZERO + len(xy_m)
    pending[:num] = np.arange(num)[::-1]
    while num:
        num -= 1
        v = pending[num]
        if is_fixed[v] or begin[v + 1] - begin[v] != 2 or at[begin[v]] < 0:
            continue
        k, m = at[begin[v]], at[begin[v] + 1]
        one, other = side[k, 0] + side[k, 1] - v, side[m, 0] + side[m, 1] - v
        if one > other:
            k, m, one, other = m, k, other, one
        x, y = xy_m[other, 0] - xy_m[one, 0], xy_m[other, 1] - xy_m[one, 1]
        to_x, to_y = xy_m[v, 0] - xy_m[one, 0], xy_m[v, 1] - xy_m[one, 1]
        if abs(x * to_y - y * to_x) > STRAIGHT_M * np.hypot(x, y):
            continue
        is_beside = False
        for t in at[begin[one] : begin[one + 1]]:
            is_beside |= side[t, 0] + side[t, 1] - one == other
        if is_beside:
            continue
        if np.hypot(to_x, to_y) < np.hypot(x - to_x, y - to_y):
            line[k] = line[m]
        if side[k, 0] == v:
            face[k, 0], face[k, 1] = face[k, 1], face[k, 0]
        side[k], rank[k], is_gone[m], at[begin[v]] = (one, other), num_made, True, -1
        num_made += 1
        for i in range(begin[other], begin[other + 1]):
            if at[i] == m:
                at[i] = k
        pending[num], pending[num + 1] = one, other
        num += 2
    order = sorted_by(rank, num_made)[1]
    order = order[~is_gone[order]]
    side, face = side[order], face[order]
    for k in range(len(side)):
        if face[k, 0] == OUTSIDE or (face[k, 1] != OUTSIDE and side[k, 0] > side[k, 1]):
            side[k], face[k] = (side[k, 1], side[k, 0]), (face[k, 1], face[k, 0])
    return side, face, line[order]


@inner
def _contracted(
    side: np.ndarray,
    face: np.ndarray,
    line: np.ndarray,
    is_gone: np.ndarray,
    short: int,
    end: int,
    gone: int,
) -> bool:
    """Moves the ends ``gone`` of all sides to ``end``, so that the side ``short`` between them vanishes. Returns False,
    and changes nothing, if a side would then have two faces on one hand. A face of no width vanishes."""
    for is_tried in (True, False):
        for t in range(len(side)):
            if is_gone[t] or t == short or (side[t, 0] != gone and side[t, 1] != gone):
                continue
            at_gone = 0 if side[t, 0] == gone else 1
            beyond, u = side[t, 1 - at_gone], -1
            for k in range(len(side)):
                if (side[k, 0] == end and side[k, 1] == beyond) or (
                    side[k, 1] == end and side[k, 0] == beyond
                ):
                    u = u if is_gone[k] else k
            if u < 0:
                if not is_tried:
                    side[t, at_gone] = end
                continue
            at_end, num_kept = 0 if side[u, 0] == end else 1, 0
            # the faces left and right of both sides, seen from their common end; the face between them vanishes
            one, other = (face[u, at_end], face[t, at_gone]), (face[u, 1 - at_end], face[t, 1 - at_gone])
            for left, right, h in ((one, other, at_end), (other, one, 1 - at_end)):
                keeps = left[0] != OUTSIDE and left[0] != right[0] and left[0] != right[1]
                takes = left[1] != OUTSIDE and left[1] != right[0] and left[1] != right[1]
                if keeps and takes:
                    return False
                num_kept += keeps
                if not is_tried:
                    face[u, h] = left[0] if keeps else left[1] if takes else OUTSIDE
            if not is_tried:
                is_gone[t], is_gone[u] = True, face[u, 0] == OUTSIDE and face[u, 1] == OUTSIDE
                line[u] = line[u] if num_kept else line[t]
    is_gone[short] = True
    return True


@entry
def rings_below(
    side: np.ndarray,
    face: np.ndarray,
    wall: np.ndarray,
    xy_m: np.ndarray,
    plane: np.ndarray,
    axes: np.ndarray,
    is_whole: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(vertices (v, 3); the rings of all faces of the solid from height 0 to planes, int64 (k,), ring after ring; the
    length of each ring, (r,); its face, (r,); twice its area, negative for a hole, (r,)). No ring has a vertex twice.

    side, face: see :func:`straightened`. wall: int64 (s, 2), the numbers of the walls below the left and the right face
    of each side. plane: (p, 3). Faces are numbered: first the planes, then the floor and the walls. axes: (f, 2, 3),
    two unit vectors in the plane of each face. is_whole: see :func:`_half_edges`.
    """
    side, face, wall, xy_m = _divided(side, face, wall, xy_m, plane)
    vertex_m, vertex = _columns(side, face, xy_m, plane)
    half, number = _half_edges(side, face, wall, vertex, len(vertex_m), len(plane), is_whole)
    return vertex_m, *rings_around(vertex_m, half, number, axes)


@inner
def _height(plane: np.ndarray, number: int, x: float, y: float) -> float:
    return plane[number, 0] * x + plane[number, 1] * y + plane[number, 2]


@allocating
def _divided(
    side: np.ndarray, face: np.ndarray, wall: np.ndarray, xy_m: np.ndarray, plane: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(side, face, wall, vertices), where a side is divided if one roof is higher at its start and the other at its
    end."""
    num, num_places, num_sides = len(side), len(xy_m), len(side)
    side, face = np.concatenate((side, side)), np.concatenate((face, face))
    wall, xy_m = np.concatenate((wall, wall)), np.concatenate((xy_m, np.empty((num, 2))))
    for k in range(num):
        if face[k, 0] == OUTSIDE or face[k, 1] == OUTSIDE:
            continue
        (x, y), (end_x, end_y) = xy_m[side[k, 0]], xy_m[side[k, 1]]
        rise_m = _height(plane, face[k, 0], x, y) - _height(plane, face[k, 1], x, y)
        end_rise_m = _height(plane, face[k, 0], end_x, end_y) - _height(plane, face[k, 1], end_x, end_y)
        if rise_m * end_rise_m < 0.0 and min(abs(rise_m), abs(end_rise_m)) > SAME_HEIGHT_M:
            share = rise_m / (rise_m - end_rise_m)
            xy_m[num_places] = (x + share * (end_x - x), y + share * (end_y - y))
            side[num_sides] = (num_places, side[k, 1])
            face[num_sides], wall[num_sides], side[k, 1] = face[k], wall[k], num_places
            num_places, num_sides = num_places + 1, num_sides + 1
    return side[:num_sides], face[:num_sides], wall[:num_sides], xy_m[:num_places]


@allocating
def _columns(
    side: np.ndarray, face: np.ndarray, xy_m: np.ndarray, plane: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(vertices (v, 3), column by column and from below in each; vertex, int64 (s, 2, 2)). vertex: for each side, the
    vertex at each of its ends of each face beside it. A column is all vertices over one place."""
    vertex_m, vertex, num = np.empty((4 * len(side), 3)), np.empty(4 * len(side), np.int64), 0
    begin, at = sorted_by(side.ravel(), len(xy_m))
    height_m, number = np.empty(4 * len(side)), np.empty(4 * len(side), np.int64)
    order = np.empty(4 * len(side), np.int64)
    for place in range(len(xy_m)):
        size = 0
        for each in at[begin[place] : begin[place + 1]]:
            for h in range(2):
                k, plane_of = 2 * each + h, face[each // 2, h]
                number[k] = plane_of
                height_m[k] = (
                    -np.inf
                    if plane_of == OUTSIDE
                    else _height(plane, plane_of, xy_m[place, 0], xy_m[place, 1])
                )
                i, size = size, size + 1
                while i and _is_below(height_m, number, k, order[i - 1]):
                    order[i] = order[i - 1]
                    i -= 1
                order[i] = k
        lowest_m, sum_m, count = -np.inf, 0.0, 0
        for i in range(size):
            k = order[i]
            if i == 0 or (number[k] != number[order[i - 1]]):
                if number[k] == OUTSIDE:
                    vertex_m[num] = (xy_m[place, 0], xy_m[place, 1], 0.0)
                    num += 1
                else:
                    if height_m[k] - lowest_m >= SAME_HEIGHT_M:
                        lowest_m, sum_m, count, num = height_m[k], 0.0, 0, num + 1
                    sum_m, count = sum_m + height_m[k], count + 1
                    vertex_m[num - 1] = (xy_m[place, 0], xy_m[place, 1], sum_m / count)
            vertex[k] = num - 1
    return vertex_m[:num], vertex.reshape(len(side), 2, 2)


@inner
def _is_below(height_m: np.ndarray, number: np.ndarray, k: int, m: int) -> bool:
    return height_m[k] < height_m[m] or (height_m[k] == height_m[m] and number[k] < number[m])


@allocating
def _half_edges(
    side: np.ndarray,
    face: np.ndarray,
    wall: np.ndarray,
    vertex: np.ndarray,
    num_vertices: int,
    floor: int,
    is_whole: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """(the vertices (h, 2) of the half-edges around faces; the number of the face to the left of each, (h,)). vertex:
    see :func:`_columns`. floor: the number of the floor. is_whole: whether upright edges within a wall, between sides
    with the same number ``wall``, are left out."""
    num_steps = 0
    for k in range(len(side)):
        for e in range(2):
            num_steps += abs(vertex[k, e, 0] - vertex[k, e, 1])
    size = 6 * len(side) + num_steps
    half, number, num = np.empty((size, 2), np.int64), np.empty(size, np.int64), 0
    # upright half-edges between two vertices of a column: the lower vertex, the wall, and the direction
    step, step_wall, is_up, num_steps = (
        np.empty(num_steps, np.int64),
        np.empty(num_steps, np.int64),
        np.empty(num_steps, np.bool_),
        0,
    )
    for k in range(len(side)):
        for h in range(2):
            start, end = h, 1 - h
            if face[k, h] == OUTSIDE:
                half[num], number[num] = (vertex[k, start, h], vertex[k, end, h]), floor
                num += 1
                continue
            half[num], number[num] = (vertex[k, start, h], vertex[k, end, h]), face[k, h]
            num += 1
            # the wall is below this face, over the other one
            low, end_low = vertex[k, start, 1 - h], vertex[k, end, 1 - h]
            high, end_high = max(low, vertex[k, start, h]), max(end_low, vertex[k, end, h])
            if high == low and end_high == end_low:
                continue
            half[num], number[num] = (low, end_low), wall[k, h]
            half[num + 1], number[num + 1] = (end_high, high), wall[k, h]
            num += 2
            for one, other, goes_up in ((end_low, end_high, True), (low, high, False)):
                for v in range(one, other):
                    step[num_steps], step_wall[num_steps], is_up[num_steps] = v, wall[k, h], goes_up
                    num_steps += 1
    # within a whole wall, a half-edge up and one down cancel out
    begin, at = sorted_by(step[:num_steps], num_vertices)
    for v in range(num_vertices):
        for i in range(begin[v], begin[v + 1]):
            k = at[i]
            for j in range(i + 1, begin[v + 1] if is_whole else i):
                m = at[j]
                if step_wall[k] >= 0 and step_wall[k] == step_wall[m] and is_up[k] != is_up[m]:
                    step_wall[k], step_wall[m] = OUTSIDE, OUTSIDE
            if step_wall[k] >= 0:
                half[num] = (v, v + 1) if is_up[k] else (v + 1, v)
                number[num], num = step_wall[k], num + 1
    return half[:num], number[:num]
