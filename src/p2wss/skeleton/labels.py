"""Labels of the faces of a solid: one number for every plane of roof, cap, wall, flat piece and ground.

The labels 0..num_edges-1 are roof faces, by edge; then come the caps, the walls, by edge, all flat pieces at
the eave under one label, and the ground.
"""

from __future__ import annotations

from p2wss.skeleton.compiled import inner
from p2wss.skeleton.records import NUM_CAPS


@inner
def num_labels(num_edges, counts):
    return 2 * num_edges + counts[NUM_CAPS] + 2


@inner
def wall_label(num_edges, counts, e):
    return num_edges + counts[NUM_CAPS] + e


@inner
def flat_label(num_edges, counts):
    return 2 * num_edges + counts[NUM_CAPS]


@inner
def ground_label(num_edges, counts):
    return 2 * num_edges + counts[NUM_CAPS] + 1


@inner
def plane_point(edge, num_edges, counts, point, label, k):
    """Coordinates (u, v) of a point in the plane of a face, in which the face is counter-clockwise seen from
    outside."""
    first_wall = num_edges + counts[NUM_CAPS]
    if first_wall <= label < first_wall + num_edges:
        e = label - first_wall
        u = (point[k, 0] - edge[e].x) * edge[e].dir_x + (point[k, 1] - edge[e].y) * edge[e].dir_y
        return u, point[k, 2]
    if label == ground_label(num_edges, counts):
        return point[k, 0], -point[k, 1]
    return point[k, 0], point[k, 1]
