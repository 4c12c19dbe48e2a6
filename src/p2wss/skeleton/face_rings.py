"""From the directed edges of a solid to its faces: polygons with holes."""

from typing import NamedTuple

import numpy as np

from p2wss.skeleton.compiled import inner
from p2wss.skeleton.records import NUM_CAPS, NUM_NODES, MeshWork, ground_label, num_labels
from p2wss.skeleton.rings import is_inside, signed_area
from p2wss.skeleton.status import OK, OPEN_FACE, OVERFLOW


class _Faces(NamedTuple):
    """The points of a solid, and what the planes of its faces are computed from."""

    edge: np.ndarray
    num_edges: int
    counts: np.ndarray
    point: np.ndarray


@inner
def _place(faces: _Faces, label: int, k: int) -> tuple[float, float]:
    """Coordinates (u, v) of point k in the plane of a face. In these, the outer ring of the face is
    counter-clockwise."""
    edge, num_edges, counts, point = faces
    first_wall = num_edges + counts[NUM_CAPS]
    if first_wall <= label < first_wall + num_edges:
        e = label - first_wall
        u = (point[k, 0] - edge[e].x) * edge[e].dir_x + (point[k, 1] - edge[e].y) * edge[e].dir_y
        return u, point[k, 2]
    if label == ground_label(num_edges, counts):
        return point[k, 0], -point[k, 1]
    return point[k, 0], point[k, 1]


@inner
def _next_half(
    half: np.ndarray, out_head: np.ndarray, faces: _Faces, label: int, start: int, here: int
) -> int:
    """The unused half-edge that continues from ``here``; at a pinch, the one that keeps the face on the
    left. -1 if there is none."""
    best, best_turn, h = -1, 0.0, out_head[here]
    if h >= 0 and half[h].next_out < 0:
        # only one half-edge starts here, so that no angle is needed
        return h if half[h].alive == 1 else -1
    u0, v0 = _place(faces, label, here)
    u1, v1 = _place(faces, label, start)
    back = np.arctan2(v1 - v0, u1 - u0)
    while h >= 0:
        if half[h].alive == 1:
            u2, v2 = _place(faces, label, half[h].end)
            turn = back - np.arctan2(v2 - v0, u2 - u0)  # clockwise from the way back
            if turn <= 1e-12:
                turn += 2.0 * np.pi
            if best < 0 or turn < best_turn:
                best, best_turn = h, turn
        h = half[h].next_out
    return best


@inner
def trace_faces(edge: np.ndarray, num_edges: int, counts: np.ndarray, mesh_work: MeshWork) -> tuple[int, int]:
    """Trace the half-edges into faces, each an outer ring and its holes. Returns (status, number of faces).

    Fills ``ring`` (corners of all rings), ``ring_start`` (where ring r starts), ``ring_order`` and
    ``face``: face f has the label ``face[f].label`` and the rings ``ring_order[first_ring:last_ring]``.
    """
    half, out_head, label_head = mesh_work.half, mesh_work.out_head, mesh_work.label_head
    uv, ring_point = mesh_work.ring
    ring_start, faces = mesh_work.ring_start, _Faces(edge, num_edges, counts, mesh_work.point)
    ring_order, ring_area, face = mesh_work.ring_order, mesh_work.ring_area, mesh_work.face
    out_head[: counts[NUM_NODES] + num_edges] = -1
    num_ring_points, num_rings, num_faces, num_ordered = 0, 0, 0, 0
    ring_start[0] = 0
    for label in range(num_labels(num_edges, counts)):
        h = label_head[label]
        while h >= 0:
            if half[h].alive == 1:
                half[h].next_out = out_head[half[h].start]
                out_head[half[h].start] = h
            h = half[h].next_in_label
        first_ring = num_rings
        first = label_head[label]
        while first >= 0:
            if half[first].alive != 1:
                first = half[first].next_in_label
                continue
            h = first
            origin = half[first].start
            while True:
                half[h].alive = 2  # part of a ring
                if num_ring_points + 1 > len(ring_point):
                    return OVERFLOW, 0
                ring_point[num_ring_points] = half[h].start
                uv[num_ring_points, 0], uv[num_ring_points, 1] = _place(faces, label, half[h].start)
                num_ring_points += 1
                here = half[h].end
                following = _next_half(half, out_head, faces, label, half[h].start, here)
                if here == origin:
                    # at a pinch the ring may have to pass through its start once more
                    if following < 0:
                        break
                    half[first].alive = 1
                    again = _next_half(half, out_head, faces, label, half[h].start, here)
                    half[first].alive = 2
                    if again == first:
                        break
                if following < 0:
                    return OPEN_FACE, 0
                h = following
            num_rings += 1
            if num_rings + 1 > len(ring_start):
                return OVERFLOW, 0
            ring_start[num_rings] = num_ring_points
            if ring_start[num_rings] - ring_start[num_rings - 1] < 3:
                return OPEN_FACE, 0
            ring_area[num_rings - 1] = signed_area(uv, ring_start[num_rings - 1], num_ring_points)
        h = label_head[label]
        while h >= 0:
            out_head[half[h].start] = -1
            h = half[h].next_in_label
        for ring in range(first_ring, num_rings):
            if ring_area[ring] <= 0.0:
                continue
            face[num_faces].label = label
            face[num_faces].first_ring = num_ordered
            ring_order[num_ordered] = ring
            num_ordered += 1
            for hole in range(first_ring, num_rings):
                if ring_area[hole] > 0.0:
                    continue
                u, v = uv[ring_start[hole], 0], uv[ring_start[hole], 1]
                outer, outer_area = -1, np.inf
                for other in range(first_ring, num_rings):
                    if 0.0 < ring_area[other] < outer_area and is_inside(
                        uv, ring_start[other], ring_start[other + 1], u, v
                    ):
                        outer, outer_area = other, ring_area[other]
                if outer == ring:
                    ring_order[num_ordered] = hole
                    num_ordered += 1
            face[num_faces].last_ring = num_ordered
            num_faces += 1
    if num_ordered != num_rings:
        return OPEN_FACE, 0  # a hole lies in no face
    return OK, num_faces
