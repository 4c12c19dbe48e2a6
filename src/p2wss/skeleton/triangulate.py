"""Ear clipping of faces with holes. It keeps every vertex, also collinear ones, so that neighbouring faces
still match."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import ZERO, inner

_SMALLEST_QUALITY = 1e-9


@inner
def _turn(a_u, a_v, b_u, b_v, c_u, c_v):
    """Twice the area of triangle a, b, c: positive when c is on the left of a -> b."""
    return (b_u - a_u) * (c_v - a_v) - (b_v - a_v) * (c_u - a_u)


@inner
def _cross(u, v, a, b, c):
    return (u[b] - u[a]) * (v[c] - v[a]) - (v[b] - v[a]) * (u[c] - u[a])


@inner
def _ring_blocks(u, v, first, last, p_u, p_v, q_u, q_v):
    """Whether an edge of the ring ``first:last`` crosses or touches segment p-q, other than at its ends."""
    for a in range(first, last):
        b = a + 1 if a + 1 < last else first
        if (u[a] == p_u and v[a] == p_v) or (u[a] == q_u and v[a] == q_v):
            continue
        if (u[b] == p_u and v[b] == p_v) or (u[b] == q_u and v[b] == q_v):
            continue
        p_side = _turn(u[a], v[a], u[b], v[b], p_u, p_v)
        q_side = _turn(u[a], v[a], u[b], v[b], q_u, q_v)
        a_side = _turn(p_u, p_v, q_u, q_v, u[a], v[a])
        b_side = _turn(p_u, p_v, q_u, q_v, u[b], v[b])
        if p_side * q_side <= 0.0 and a_side * b_side <= 0.0:
            return True
    return False


@inner
def _in_cone(u, v, before, here, after, to_u, to_v):
    """Whether the segment from corner ``here`` to a point starts inside the ring."""
    left_of_first = _turn(u[here], v[here], to_u, to_v, u[before], v[before])
    left_of_second = _turn(to_u, to_v, u[here], v[here], u[after], v[after])
    if _cross(u, v, before, here, after) > 0.0:
        return left_of_first > 0.0 and left_of_second > 0.0
    return not (left_of_second <= 0.0 and left_of_first <= 0.0)


@inner
def join_holes(
    u, v, point, ring_first, num_rings, loop_u, loop_v, loop_point, spare_u, spare_v, spare_point, joined
):  # fmt: skip
    """Join an outer ring and its holes into one ring, by bridges between the nearest visible corners.

    u, v, point: corners ring after ring, ring r at ``ring_first[r]:ring_first[r + 1]``, the outer ring first.
    Writes the joined ring into ``loop_*``. Returns its length, or -1.
    """
    size = ring_first[1]
    for k in range(size):
        loop_u[k], loop_v[k], loop_point[k] = u[k], v[k], point[k]
    total = ring_first[num_rings]
    if total + 2 * (num_rings - 1) > len(loop_u):
        return -1
    zero = ZERO
    for ring in range(num_rings):
        joined[ring] = 0
    joined[0] = 1
    for _ in range(num_rings - 1):
        best, best_p, best_q, best_ring = np.inf, -1, -1, -1
        for ring in range(1, num_rings):
            if joined[ring] == 1:
                continue
            first, last = ring_first[ring], ring_first[ring + 1]
            for q in range(first, last):
                q_before = q - 1 if q > first else last - 1
                q_after = q + 1 if q + 1 < last else first
                for p in range(size):
                    distance = (loop_u[p] - u[q]) ** 2 + (loop_v[p] - v[q]) ** 2
                    if distance >= best:
                        continue
                    p_u, p_v = loop_u[p], loop_v[p]
                    p_before, p_after = p - 1 if p > 0 else size - 1, p + 1 if p + 1 < size else 0
                    if not _in_cone(loop_u, loop_v, p_before, p, p_after, u[q], v[q]):
                        continue
                    if not _in_cone(u, v, q_before, q, q_after, p_u, p_v):
                        continue
                    blocked = _ring_blocks(loop_u, loop_v, zero, size, p_u, p_v, u[q], v[q])
                    for other in range(1, num_rings):
                        if not blocked and joined[other] == 0:
                            start, end = ring_first[other], ring_first[other + 1]
                            blocked = _ring_blocks(u, v, start, end, p_u, p_v, u[q], v[q])
                    if not blocked:
                        best, best_p, best_q, best_ring = distance, p, q, ring
        if best_ring < 0:
            return -1
        # ... p, then the hole from q all the way round to q, then p again ...
        first, last = ring_first[best_ring], ring_first[best_ring + 1]
        tail = size - best_p
        for k in range(tail):
            at = best_p + k
            spare_u[k], spare_v[k], spare_point[k] = loop_u[at], loop_v[at], loop_point[at]
        at = best_p + 1
        for k in range(last - first + 1):
            m = best_q + k
            if m >= last:
                m -= last - first
            loop_u[at], loop_v[at], loop_point[at] = u[m], v[m], point[m]
            at += 1
        for k in range(tail):
            loop_u[at], loop_v[at], loop_point[at] = spare_u[k], spare_v[k], spare_point[k]
            at += 1
        size = at
        joined[best_ring] = 1
    return size


@inner
def _ear_quality(u, v, point, before, after, i):
    """Area of the ear at i over its longest side squared, or 0 if there is no ear."""
    a, c = before[i], after[i]
    area = _cross(u, v, a, i, c)
    ab_u, ab_v = u[i] - u[a], v[i] - v[a]
    bc_u, bc_v = u[c] - u[i], v[c] - v[i]
    ca_u, ca_v = u[a] - u[c], v[a] - v[c]
    longest2 = max(ab_u * ab_u + ab_v * ab_v, bc_u * bc_u + bc_v * bc_v, ca_u * ca_u + ca_v * ca_v)
    if longest2 == 0.0 or area <= _SMALLEST_QUALITY * longest2:
        return 0.0
    near = -1e-10 * longest2
    q = after[c]
    while q != a:
        if (
            point[q] != point[a]
            and point[q] != point[i]
            and point[q] != point[c]
            and (
                ab_u * (v[q] - v[a]) - ab_v * (u[q] - u[a]) >= near
                and bc_u * (v[q] - v[i]) - bc_v * (u[q] - u[i]) >= near
                and ca_u * (v[q] - v[c]) - ca_v * (u[q] - u[c]) >= near
            )
        ):
            return 0.0
        q = after[q]
    return area / longest2


@inner
def clip_ears(u, v, point, size, before, after, quality, triangle, num_triangles):
    """Triangulate a counter-clockwise ring of ``size`` corners; the best-shaped ear is clipped first.

    Appends rows of ``point`` numbers to ``triangle`` from row ``num_triangles`` on. Returns the new number of
    rows, or -1 if the ring cannot be cut into triangles of positive area.
    """
    if size < 3 or num_triangles + size - 2 > len(triangle):
        return -1
    for i in range(size):
        before[i] = i - 1 if i > 0 else size - 1
        after[i] = i + 1 if i + 1 < size else 0
    if size > 4:
        for i in range(size):
            quality[i] = _ear_quality(u, v, point, before, after, i)
    here = ZERO
    while size > 3:
        best = 0.0
        ear = -1
        if size == 4:
            for _ in range(4):  # both halves of the last quadrilateral must be good
                i = here
                quality_1 = _ear_quality(u, v, point, before, after, i)
                quality_2 = _ear_quality(u, v, point, before, after, after[after[i]])
                if min(quality_1, quality_2) > best:
                    best, ear = min(quality_1, quality_2), i
                here = after[here]
        else:
            i = here
            for _ in range(size):
                if quality[i] > best:
                    best, ear = quality[i], i
                i = after[i]
            if ear < 0:  # clipping may have opened other ears
                for _ in range(size):
                    quality[i] = _ear_quality(u, v, point, before, after, i)
                    if quality[i] > best:
                        best, ear = quality[i], i
                    i = after[i]
        if ear < 0:
            return -1
        a, c = before[ear], after[ear]
        triangle[num_triangles, 0] = point[a]
        triangle[num_triangles, 1] = point[ear]
        triangle[num_triangles, 2] = point[c]
        num_triangles += 1
        after[a] = c
        before[c] = a
        here = a
        size -= 1
        if size > 4:
            quality[a] = _ear_quality(u, v, point, before, after, a)
            quality[c] = _ear_quality(u, v, point, before, after, c)
    a, b, c = before[here], here, after[here]
    if _cross(u, v, a, b, c) <= 0.0:
        return -1
    triangle[num_triangles, 0] = point[a]
    triangle[num_triangles, 1] = point[b]
    triangle[num_triangles, 2] = point[c]
    return num_triangles + 1
