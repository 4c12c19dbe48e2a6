"""The self-check of every solid: closed, manifold, of the right genus, with planar faces oriented outwards.

A mesh that passes does not intersect itself: the triangles of its top all face upwards or are vertical, their
areas in plan add up to the area of the footprint, and they have the same boundary, so they cover it once.
"""

import numpy as np

from p2wss.skeleton.compiled import inner
from p2wss.skeleton.groups import find_reverses
from p2wss.skeleton.records import NUM_CAPS, Batch, MeshWork, SkeletonWork, flat_label, ground_label
from p2wss.skeleton.rings import signed_area
from p2wss.skeleton.status import (
    INSIDE_OUT,
    NOT_CLOSED,
    NOT_PLANAR,
    OK,
    WRONG_AREA,
    WRONG_GENUS,
    ZERO_AREA_TRIANGLE,
)
from p2wss.skeleton.triangulate import MIN_AREA_M2

_PLANE_M = 1e-3
_AREA_SHARE = 1e-4


@inner
def pair_half_edges(triangle: np.ndarray, num_triangles: int, mesh_work: MeshWork) -> bool:
    """Find the opposite of every half-edge, numbered ``3 * triangle + corner``. False if a half-edge has no opposite or
    several."""
    start, end, twin, num_half = mesh_work.start, mesh_work.end, mesh_work.twin, 3 * num_triangles
    for h in range(num_half):
        start[h], end[h] = triangle[h // 3, h % 3], triangle[h // 3, (h + 1) % 3]
    find_reverses(start[:num_half], end[:num_half], mesh_work.slot, twin)
    for h in range(num_half):  # noqa: SIM110 - compiled
        if twin[h] < 0 or twin[twin[h]] != h:
            return False
    return True


@inner
def separate_pinches(
    triangle: np.ndarray,
    num_triangles: int,
    point: np.ndarray,
    num_points: int,
    twin: np.ndarray,
    corner: np.ndarray,
    num_fans: np.ndarray,
) -> int:
    """Give every fan of triangles a vertex of its own where several fans meet in one point. Returns the new
    number of vertices, or -1 if there is no room."""
    num_half = 3 * num_triangles
    num_fans[:num_points] = 0
    corner[:num_half] = -1
    for h in range(num_half):
        if corner[h] >= 0:
            continue
        old = triangle[h // 3, h % 3]
        vertex = old
        if num_fans[old] > 0:
            if num_points >= len(point):
                return -1
            vertex = num_points
            for axis in range(3):
                point[vertex, axis] = point[old, axis]
            num_points += 1
        num_fans[old] += 1
        k = h
        for _ in range(num_half):
            corner[k] = vertex
            before = k - 1 if k % 3 > 0 else k + 2
            k = twin[before]
            if k == h:
                break
    for h in range(num_half):
        triangle[h // 3, h % 3] = corner[h]
    return num_points


@inner
def check_solid(
    batch: Batch,
    p: int,
    skeleton_work: SkeletonWork,
    mesh_work: MeshWork,
    num_points: int,
    num_triangles: int,
) -> int:
    """The ``Status`` of a finished solid over polygon ``p`` of a batch, all of whose vertices 0..num_points-1 are in
    use."""
    first_ring, last_ring = batch.polygon_offset[p], batch.polygon_offset[p + 1]
    eave, base = batch.eave_height_m[p], batch.base_height_m[p]
    num_edges, plan_area = batch.ring_offset[last_ring] - batch.ring_offset[first_ring], 0.0
    for ring in range(first_ring, last_ring):
        plan_area += signed_area(batch.xy_m, batch.ring_offset[ring], batch.ring_offset[ring + 1])
    edge, cap_height, counts = skeleton_work.edge, skeleton_work.cap_height, skeleton_work.counts
    point, triangle, triangle_label = mesh_work.vertex, mesh_work.triangle, mesh_work.triangle_label
    if not pair_half_edges(triangle, num_triangles, mesh_work):
        return NOT_CLOSED
    # V - E + F = 2 - 2 g with E = 3 F / 2, and one handle per courtyard
    if 2 * num_points - num_triangles != 4 - 4 * (last_ring - first_ring - 1):
        return WRONG_GENUS
    first_wall = num_edges + counts[NUM_CAPS]
    flat = flat_label(num_edges, counts)
    ground = ground_label(num_edges, counts)
    volume, top_area, ground_area = 0.0, 0.0, 0.0
    for t in range(num_triangles):
        a, b, c = triangle[t, 0], triangle[t, 1], triangle[t, 2]
        abx, aby, abz = point[b, 0] - point[a, 0], point[b, 1] - point[a, 1], point[b, 2] - point[a, 2]
        acx, acy, acz = point[c, 0] - point[a, 0], point[c, 1] - point[a, 1], point[c, 2] - point[a, 2]
        nx, ny, nz = aby * acz - abz * acy, abz * acx - abx * acz, abx * acy - aby * acx
        if nx * nx + ny * ny + nz * nz < MIN_AREA_M2 * MIN_AREA_M2:
            return ZERO_AREA_TRIANGLE
        volume += nx * point[a, 0] + ny * point[a, 1] + nz * (point[a, 2] - base)
        label = triangle_label[t]
        if label == ground:
            if nz >= 0.0:
                return INSIDE_OUT
            ground_area -= 0.5 * nz
        elif label < first_wall or label == flat:
            if nz <= 0.0:
                return INSIDE_OUT
            top_area += 0.5 * nz
        for m in range(3):
            k = triangle[t, m]
            if label < num_edges:
                distance = (point[k, 1] - edge[label].y) * edge[label].dir_x
                distance -= (point[k, 0] - edge[label].x) * edge[label].dir_y
                angle = edge[label].angle_deg * np.pi / 180.0
                off = (point[k, 2] - eave) * np.cos(angle) - distance * np.sin(angle)
            elif label < first_wall:
                off = point[k, 2] - eave - cap_height[label - num_edges]
            elif label == flat:
                off = point[k, 2] - eave
            elif label == ground:
                off = point[k, 2] - base
            else:
                e = label - first_wall
                off = (point[k, 1] - edge[e].y) * edge[e].dir_x - (point[k, 0] - edge[e].x) * edge[e].dir_y
            if not abs(off) < _PLANE_M:
                return NOT_PLANAR
    if abs(top_area - plan_area) > _AREA_SHARE * plan_area or abs(ground_area - plan_area) > 1e-9 * plan_area:
        return WRONG_AREA
    if not 0.0 < volume < np.inf:
        return INSIDE_OUT
    return OK
