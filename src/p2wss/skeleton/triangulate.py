"""Ear clipping of a face with holes that keeps every vertex, collinear ones too, so that neighbours still fit."""

from __future__ import annotations

import numpy as np
from numba import njit

_SMALLEST_QUALITY = 1e-9


@njit(cache=True, nogil=True)
def _cross(u, v, a, b, c):
    return (u[b] - u[a]) * (v[c] - v[a]) - (v[b] - v[a]) * (u[c] - u[a])


@njit(cache=True, nogil=True)
def _blocks(u, v, a, b, p, q):
    """Whether segment p-q crosses or touches segment a-b, other than at a common place."""
    same_a = (u[a] == u[p] and v[a] == v[p]) or (u[a] == u[q] and v[a] == v[q])
    same_b = (u[b] == u[p] and v[b] == v[p]) or (u[b] == u[q] and v[b] == v[q])
    if same_a or same_b:
        return False
    return (
        _cross(u, v, a, b, p) * _cross(u, v, a, b, q) <= 0.0
        and _cross(u, v, p, q, a) * _cross(u, v, p, q, b) <= 0.0
    )


@njit(cache=True, nogil=True)
def _in_cone(u, v, before, here, after, target):
    """Whether the way from ``here`` to ``target`` starts on the left of both edges at ``here``."""
    if _cross(u, v, before, here, after) > 0.0:
        return _cross(u, v, here, target, before) > 0.0 and _cross(u, v, target, here, after) > 0.0
    return not (_cross(u, v, here, target, after) >= 0.0 and _cross(u, v, target, here, before) >= 0.0)


@njit(cache=True, nogil=True)
def join_holes(u, v, point, ring_first, num_rings, loop_u, loop_v, loop_point, spare_u, spare_v, spare_point):
    """One ring from an outer ring and its holes by bridges between nearest visible corners.

    u, v, point: corners ring after ring, ring r at ``ring_first[r]:ring_first[r + 1]``, the outer ring first.
    Writes the joined ring into ``loop_*``. Returns its length, or -1.
    """
    size = ring_first[1]
    for k in range(size):
        loop_u[k], loop_v[k], loop_point[k] = u[k], v[k], point[k]
    total = ring_first[num_rings]
    if total + 2 * (num_rings - 1) > len(loop_u):
        return -1
    joined = np.zeros(num_rings, np.bool_)
    joined[0] = True
    for _ in range(num_rings - 1):
        best, best_p, best_q, best_ring = np.inf, -1, -1, -1
        for ring in range(1, num_rings):
            if joined[ring]:
                continue
            first, last = ring_first[ring], ring_first[ring + 1]
            for q in range(first, last):
                q_before = q - 1 if q > first else last - 1
                q_after = q + 1 if q + 1 < last else first
                for p in range(size):
                    distance = (loop_u[p] - u[q]) ** 2 + (loop_v[p] - v[q]) ** 2
                    if distance >= best:
                        continue
                    # a small array with the two ends, so that one set of predicates serves both rings
                    p_before, p_after = (p - 1) % size, (p + 1) % size
                    spare_u[0], spare_v[0] = loop_u[p], loop_v[p]
                    spare_u[1], spare_v[1] = u[q], v[q]
                    spare_u[2], spare_v[2] = loop_u[p_before], loop_v[p_before]
                    spare_u[3], spare_v[3] = loop_u[p_after], loop_v[p_after]
                    spare_u[4], spare_v[4] = u[q_before], v[q_before]
                    spare_u[5], spare_v[5] = u[q_after], v[q_after]
                    if not _in_cone(spare_u, spare_v, 2, 0, 3, 1) or not _in_cone(
                        spare_u, spare_v, 4, 1, 5, 0
                    ):
                        continue
                    free = True
                    for k in range(size):
                        spare_u[6], spare_v[6] = loop_u[k], loop_v[k]
                        spare_u[7], spare_v[7] = loop_u[(k + 1) % size], loop_v[(k + 1) % size]
                        if _blocks(spare_u, spare_v, 6, 7, 0, 1):
                            free = False
                            break
                    if free:
                        for other in range(1, num_rings):
                            if joined[other]:
                                continue
                            start, end = ring_first[other], ring_first[other + 1]
                            for k in range(start, end):
                                m = k + 1 if k + 1 < end else start
                                spare_u[6], spare_v[6] = u[k], v[k]
                                spare_u[7], spare_v[7] = u[m], v[m]
                                if _blocks(spare_u, spare_v, 6, 7, 0, 1):
                                    free = False
                                    break
                            if not free:
                                break
                    if free:
                        best, best_p, best_q, best_ring = distance, p, q, ring
        if best_ring < 0:
            return -1
        # ... p, then the hole from q all the way round to q again, then p again ...
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
        joined[best_ring] = True
    return size


@njit(cache=True, nogil=True)
def _ear_quality(u, v, point, before, after, i):
    """Area over squared longest side of the ear at i, or 0 when it is none."""
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
        if point[q] != point[a] and point[q] != point[i] and point[q] != point[c]:
            if (
                ab_u * (v[q] - v[a]) - ab_v * (u[q] - u[a]) >= near
                and bc_u * (v[q] - v[i]) - bc_v * (u[q] - u[i]) >= near
                and ca_u * (v[q] - v[c]) - ca_v * (u[q] - u[c]) >= near
            ):
                return 0.0
        q = after[q]
    return area / longest2


@njit(cache=True, nogil=True)
def clip_ears(u, v, point, size, before, after, quality, triangle, num_triangles):
    """Triangulate a counter-clockwise ring of ``size`` corners; the best shaped ear goes first.

    Appends rows of ``point`` numbers to ``triangle`` from row ``num_triangles`` on. Returns the new number of
    rows, or -1 when the ring cannot be cut into triangles of positive area.
    """
    if size < 3 or num_triangles + size - 2 > len(triangle):
        return -1
    for i in range(size):
        before[i] = i - 1 if i > 0 else size - 1
        after[i] = i + 1 if i + 1 < size else 0
    if size > 4:
        for i in range(size):
            quality[i] = _ear_quality(u, v, point, before, after, i)
    here = 0
    while size > 3:
        best = 0.0
        ear = -1
        if size == 4:
            for _ in range(4):  # both halves of the last quadrilateral have to be good
                i = here
                one = _ear_quality(u, v, point, before, after, i)
                two = _ear_quality(u, v, point, before, after, after[after[i]])
                if min(one, two) > best:
                    best, ear = min(one, two), i
                here = after[here]
        else:
            i = here
            for _ in range(size):
                if quality[i] > best:
                    best, ear = quality[i], i
                i = after[i]
            if ear < 0:  # a clipped ear may have freed others
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
