"""Ear clipping of faces with holes. It keeps every vertex, also collinear ones, so that neighbouring faces
still match."""

import numpy as np

from p2wss.skeleton.compiled import ZERO, embedded, inner
from p2wss.skeleton.records import Corners, Ears, MeshWork
from p2wss.skeleton.rings import sides

MIN_AREA_M2 = 1e-12  # twice the area of the smallest triangle of a solid
_SMALLEST_QUALITY = 1e-9
# distances from a side over its length: a corner nearer than the first is on the side; a corner nearer than the second
# makes an ear worse
_ON_SIDE, _BESIDE = 1e-10, 1e-6


@inner
def _turn(a_u: float, a_v: float, b_u: float, b_v: float, c_u: float, c_v: float) -> float:
    """Twice the area of triangle a, b, c: positive when c is on the left of a -> b."""
    return (b_u - a_u) * (c_v - a_v) - (b_v - a_v) * (c_u - a_u)


@inner
def _cross(uv: np.ndarray, a: int, b: int, c: int) -> float:
    return (uv[b, 0] - uv[a, 0]) * (uv[c, 1] - uv[a, 1]) - (uv[b, 1] - uv[a, 1]) * (uv[c, 0] - uv[a, 0])


@inner
def _ring_blocks(
    uv: np.ndarray, first: int, last: int, p: tuple[float, float], q: tuple[float, float]
) -> bool:
    """Whether an edge of the ring ``first:last`` crosses or touches the segment from p to q, other than at its ends."""
    for k in range(first, last):
        after = k + 1 if k + 1 < last else first
        a, b = (uv[k, 0], uv[k, 1]), (uv[after, 0], uv[after, 1])
        if a in (p, q) or b in (p, q):
            continue
        if sides(a, b, p, q) <= 0.0 and sides(p, q, a, b) <= 0.0:
            return True
    return False


@inner
def _in_cone(uv: np.ndarray, before: int, here: int, after: int, to: tuple[float, float]) -> bool:
    """Whether the segment from corner ``here`` to a place starts inside the ring."""
    u, v = uv[here, 0], uv[here, 1]
    left_of_first = _turn(u, v, to[0], to[1], uv[before, 0], uv[before, 1])
    left_of_second = _turn(to[0], to[1], u, v, uv[after, 0], uv[after, 1])
    if _cross(uv, before, here, after) > 0.0:
        return left_of_first > 0.0 and left_of_second > 0.0
    return not (left_of_second <= 0.0 and left_of_first <= 0.0)


@inner
def copy_corners(corners: Corners, first: int, to: Corners, at: int, count: int) -> None:
    """Copy ``count`` corners, from index ``first`` on, to ``to``, from index ``at`` on."""
    for k in range(count):
        to.uv[at + k, 0], to.uv[at + k, 1] = corners.uv[first + k, 0], corners.uv[first + k, 1]
        to.point[at + k] = corners.point[first + k]


@embedded
def join_holes(rings: np.ndarray, mesh_work: MeshWork) -> int:
    """Join an outer ring and its holes into one ring, by bridges between the nearest visible corners.

    rings: numbers of rings in ``mesh_work.ring``, the outer ring first. Writes the joined ring to ``mesh_work.loop``.
    Returns its length, or -1 if a hole cannot be joined or there is no room.
    """
    corners, loop, spare, joined = mesh_work.ring, mesh_work.loop, mesh_work.spare, mesh_work.joined
    uv, loop_uv, ring_start, zero = corners.uv, loop.uv, mesh_work.ring_start, ZERO
    start = ring_start[rings[0]]
    size = ring_start[rings[0] + 1] - start
    copy_corners(corners, start, loop, zero, size)
    joined[: len(rings)] = 0
    for _ in range(len(rings) - 1):
        best, best_p, best_q, best_ring = np.inf, ZERO, ZERO, ZERO - 1
        for ring in range(1, len(rings)):
            if joined[ring] == 1:
                continue
            first, last = ring_start[rings[ring]], ring_start[rings[ring] + 1]
            for q in range(first, last):
                q_before = q - 1 if q > first else last - 1
                q_after = q + 1 if q + 1 < last else first
                for p in range(size):
                    distance = (loop_uv[p, 0] - uv[q, 0]) ** 2 + (loop_uv[p, 1] - uv[q, 1]) ** 2
                    if distance >= best:
                        continue
                    at_p, at_q = (loop_uv[p, 0], loop_uv[p, 1]), (uv[q, 0], uv[q, 1])
                    p_before, p_after = p - 1 if p > 0 else size - 1, p + 1 if p + 1 < size else 0
                    if not _in_cone(loop_uv, p_before, p, p_after, at_q):
                        continue
                    if not _in_cone(uv, q_before, q, q_after, at_p):
                        continue
                    blocked = _ring_blocks(loop_uv, zero, size, at_p, at_q)
                    for other in range(1, len(rings)):
                        if not blocked and joined[other] == 0:
                            start, end = ring_start[rings[other]], ring_start[rings[other] + 1]
                            blocked = _ring_blocks(uv, start, end, at_p, at_q)
                    if not blocked:
                        best, best_p, best_q, best_ring = distance, p, q, ring
        if best_ring < 0:
            return -1
        first, last = ring_start[rings[best_ring]], ring_start[rings[best_ring] + 1]
        if size + last - first + 2 > len(loop_uv):
            return -1
        # ... p, then the hole from q all the way round to q, then p again ...
        tail, at = size - best_p, best_p + 1
        copy_corners(loop, best_p, spare, zero, tail)
        copy_corners(corners, best_q, loop, at, last - best_q)
        at += last - best_q
        copy_corners(corners, first, loop, at, best_q + 1 - first)
        at += best_q + 1 - first
        copy_corners(spare, zero, loop, at, tail)
        size = at + tail
        joined[best_ring] = 1
    return size


@inner
def _ear_quality(corners: Corners, ears: Ears, i: int) -> float:
    """Twice the area of the ear at i over its longest side squared; less if clipping it would leave a sliver beside the
    cut; 0 if there is no ear."""
    uv, point, after = corners.uv, corners.point, ears.after
    a, c = ears.before[i], after[i]
    area = _cross(uv, a, i, c)
    ab_u, ab_v = uv[i, 0] - uv[a, 0], uv[i, 1] - uv[a, 1]
    bc_u, bc_v = uv[c, 0] - uv[i, 0], uv[c, 1] - uv[i, 1]
    ca_u, ca_v = uv[a, 0] - uv[c, 0], uv[a, 1] - uv[c, 1]
    ab2, bc2, ca2 = ab_u * ab_u + ab_v * ab_v, bc_u * bc_u + bc_v * bc_v, ca_u * ca_u + ca_v * ca_v
    longest2 = max(ab2, bc2, ca2)
    if longest2 == 0.0 or area <= _SMALLEST_QUALITY * longest2:
        return 0.0
    quality = area / longest2
    if area < MIN_AREA_M2:
        quality *= _SMALLEST_QUALITY  # the last choice: it may be too small in space, too
    q = after[c]
    while q != a:
        if (
            point[q] != point[a]
            and point[q] != point[i]
            and point[q] != point[c]
            and (
                ab_u * (uv[q, 1] - uv[a, 1]) - ab_v * (uv[q, 0] - uv[a, 0]) >= -_ON_SIDE * ab2
                and bc_u * (uv[q, 1] - uv[i, 1]) - bc_v * (uv[q, 0] - uv[i, 0]) >= -_ON_SIDE * bc2
            )
        ):
            from_cut = ca_u * (uv[q, 1] - uv[c, 1]) - ca_v * (uv[q, 0] - uv[c, 0])
            if from_cut >= -_ON_SIDE * ca2:
                return 0.0
            if from_cut > -_BESIDE * ca2:
                quality = min(quality, -from_cut / ca2)
        q = after[q]
    return quality


@inner
def clip_ears(corners: Corners, size: int, ears: Ears, triangle: np.ndarray, num_triangles: int) -> int:
    """Triangulate a counter-clockwise ring, the first ``size`` of ``corners``; the best-shaped ear is clipped first.

    Appends rows of numbers of points to ``triangle`` from row ``num_triangles`` on. Returns the new number of
    rows, or -1 if the ring cannot be cut into triangles of positive area.
    """
    if size < 3 or num_triangles + size - 2 > len(triangle):
        return -1
    point = corners.point
    before, after, quality = ears
    for i in range(size):
        before[i] = i - 1 if i > 0 else size - 1
        after[i] = i + 1 if i + 1 < size else 0
    if size > 4:
        for i in range(size):
            quality[i] = _ear_quality(corners, ears, i)
    here = ZERO
    while size > 3:
        best = 0.0
        ear = -1
        if size == 4:
            for _ in range(4):  # both halves of the last quadrilateral must be good
                i = here
                quality_1 = _ear_quality(corners, ears, i)
                quality_2 = _ear_quality(corners, ears, after[after[i]])
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
                    quality[i] = _ear_quality(corners, ears, i)
                    if quality[i] > best:
                        best, ear = quality[i], i
                    i = after[i]
        if ear < 0:
            return -1
        a, c = before[ear], after[ear]
        triangle[num_triangles, 0], triangle[num_triangles, 1] = point[a], point[ear]
        triangle[num_triangles, 2] = point[c]
        num_triangles += 1
        after[a] = c
        before[c] = a
        here = a
        size -= 1
        if size > 4:
            quality[a] = _ear_quality(corners, ears, a)
            quality[c] = _ear_quality(corners, ears, c)
    a, b, c = before[here], here, after[here]
    if _cross(corners.uv, a, b, c) <= 0.0:
        return -1
    triangle[num_triangles, 0], triangle[num_triangles, 1] = point[a], point[b]
    triangle[num_triangles, 2] = point[c]
    return num_triangles + 1
