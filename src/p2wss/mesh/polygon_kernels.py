"""Tests of the rings and polygons of a solid, compiled. Distances are in metres."""

import numpy as np

from p2wss.skeleton.compiled import allocating, entry, inner
from p2wss.skeleton.rings import are_apart, is_inside, segment_distance_m2, signed_area, to_segment_m2

# metres: edges and faces that are nearer than this touch; files store hundredths of a millimetre
TOUCH_M = 1e-5


@inner
def _edges_touch(plane_m: np.ndarray, corner: np.ndarray, a: int, b: int, c: int, d: int) -> bool:
    """Whether the edges a b and c d of rings touch, apart from a vertex that they may have in common."""
    touch2 = TOUCH_M * TOUCH_M
    at_a, at_b = (plane_m[a, 0], plane_m[a, 1]), (plane_m[b, 0], plane_m[b, 1])
    at_c, at_d = (plane_m[c, 0], plane_m[c, 1]), (plane_m[d, 0], plane_m[d, 1])
    if corner[a] == corner[c] or corner[a] == corner[d] or corner[b] == corner[c] or corner[b] == corner[d]:
        far = at_c if corner[d] == corner[a] or corner[d] == corner[b] else at_d
        other = at_a if corner[b] == corner[c] or corner[b] == corner[d] else at_b
        return to_segment_m2(far, at_a, at_b) < touch2 or to_segment_m2(other, at_c, at_d) < touch2
    if are_apart(at_a, at_b, at_c, at_d, TOUCH_M):
        return False
    return segment_distance_m2(at_a, at_b, at_c, at_d) < touch2


@entry
def broken_ring_rules(
    plane_m: np.ndarray, corner: np.ndarray, ring_offset: np.ndarray, face_ring: np.ndarray
) -> np.ndarray:
    """int64 (f,): for each face the first broken rule of rings and polygons, or 0. Codes as in
    :mod:`p2wss.mesh.rules`. plane_m: (k, 2), the corners of all rings in the plane of their face. corner: their
    vertices. ring_offset (r + 1,): ring r has ``corner[ring_offset[r]:ring_offset[r + 1]]``, three at least.
    face_ring (f + 1,): face f has the rings ``face_ring[f]:face_ring[f + 1]``, its exterior first.
    """
    result = np.zeros(len(face_ring) - 1, np.int64)
    for f in range(len(face_ring) - 1):
        result[f] = _broken_ring_rule(plane_m, corner, ring_offset, face_ring[f], face_ring[f + 1])
    return result


@allocating
def _broken_ring_rule(
    plane_m: np.ndarray, corner: np.ndarray, ring_offset: np.ndarray, first_ring: int, last_ring: int
) -> int:
    """The first broken rule of a face whose rings are ``first_ring:last_ring``, or 0."""
    for r in range(first_ring, last_ring):
        rule = _rule_of_ring(plane_m, corner, ring_offset[r], ring_offset[r + 1])
        if rule:
            return rule
    turn = signed_area(plane_m, ring_offset[first_ring], ring_offset[first_ring + 1])
    for r in range(first_ring + 1, last_ring):
        if signed_area(plane_m, ring_offset[r], ring_offset[r + 1]) * turn > 0.0:
            return 208
    for r in range(first_ring, last_ring):
        for s in range(r + 1, last_ring):
            rule = _rule_of_two_rings(plane_m, corner, ring_offset, r, s)
            if rule:
                return rule
    if _touch_in_a_circle(corner, ring_offset, first_ring, last_ring):
        return 205
    return _rule_of_holes(plane_m, corner, ring_offset, first_ring, last_ring)


@inner
def _rule_of_ring(plane_m: np.ndarray, corner: np.ndarray, first: int, last: int) -> int:
    """The first rule that the ring of corners ``first:last`` breaks by itself, or 0."""
    for k in range(first, last):
        if corner[k] == corner[k + 1 if k + 1 < last else first]:
            return 102
    for k in range(first, last):
        after_k = k + 1 if k + 1 < last else first
        for m in range(k + 1, last):
            after_m = m + 1 if m + 1 < last else first
            if corner[k] == corner[m] or _edges_touch(plane_m, corner, k, after_k, m, after_m):
                return 104
    return 104 if abs(signed_area(plane_m, first, last)) < TOUCH_M * TOUCH_M else 0


@inner
def _rule_of_two_rings(
    plane_m: np.ndarray, corner: np.ndarray, ring_offset: np.ndarray, r: int, s: int
) -> int:
    """The first rule that two rings of a face break together, or 0. They may touch in a single vertex."""
    first_r, last_r, first_s, last_s = ring_offset[r], ring_offset[r + 1], ring_offset[s], ring_offset[s + 1]
    num_common = 0
    for k in range(first_r, last_r):
        num_common += _has_vertex(corner, first_s, last_s, corner[k])
    if num_common > 1:
        return 202 if num_common == last_s - first_s == last_r - first_r else 205
    for k in range(first_r, last_r):
        after_k = k + 1 if k + 1 < last_r else first_r
        for m in range(first_s, last_s):
            after_m = m + 1 if m + 1 < last_s else first_s
            if _edges_touch(plane_m, corner, k, after_k, m, after_m):
                return 201
    return 0


@inner
def _has_vertex(corner: np.ndarray, first: int, last: int, vertex: int) -> bool:
    """Whether the ring of corners ``first:last`` has a vertex."""
    for k in range(first, last):  # noqa: SIM110 - compiled
        if corner[k] == vertex:
            return True
    return False


@allocating
def _touch_in_a_circle(corner: np.ndarray, ring_offset: np.ndarray, first_ring: int, last_ring: int) -> bool:
    """Whether a chain of rings, each touching the next, closes to a circle and so divides the interior of a face. Two
    rings have at most one vertex in common."""
    group = np.arange(last_ring - first_ring)
    for s in range(first_ring + 1, last_ring):
        for k in range(ring_offset[s], ring_offset[s + 1]):
            for r in range(first_ring, s):
                if _has_vertex(corner, ring_offset[r], ring_offset[r + 1], corner[k]):
                    one, two = group[r - first_ring], group[s - first_ring]
                    if one == two:
                        return True
                    group[group == two] = one
                    # further rings at this vertex touch ring r there, too
                    break
    return False


@inner
def _rule_of_holes(
    plane_m: np.ndarray, corner: np.ndarray, ring_offset: np.ndarray, first_ring: int, last_ring: int
) -> int:
    """206 if a hole is outside the exterior, 207 if it is inside another hole, or 0."""
    for r in range(first_ring + 1, last_ring):
        for k in range(ring_offset[r], ring_offset[r + 1]):
            for s in range(first_ring, last_ring):
                first, last = ring_offset[s], ring_offset[s + 1]
                if s == r or _has_vertex(corner, first, last, corner[k]):
                    continue
                inside = is_inside(plane_m, first, last, plane_m[k, 0], plane_m[k, 1])
                if s == first_ring and not inside:
                    return 206
                if s > first_ring and inside:
                    return 207
    return 0


@entry
def merged_vertices(vertex_m: np.ndarray, within_m: float) -> np.ndarray:
    """int64 (v,): for each vertex the first vertex within ``within_m`` of it that is not merged with another itself."""
    result = np.arange(len(vertex_m))
    for i in range(len(vertex_m)):
        for j in range(i):
            dx = vertex_m[i, 0] - vertex_m[j, 0]
            if abs(dx) > within_m or result[j] != j:
                continue
            dy, dz = vertex_m[i, 1] - vertex_m[j, 1], vertex_m[i, 2] - vertex_m[j, 2]
            if dx * dx + dy * dy + dz * dz <= within_m * within_m:
                result[i] = j
                break
    return result
