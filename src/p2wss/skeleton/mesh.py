"""From one polygon with angles and heights to one closed and checked triangle mesh."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.check import check_solid, pair_half_edges, separate_pinches
from p2wss.skeleton.compiled import ZERO, inner
from p2wss.skeleton.face_rings import trace_faces
from p2wss.skeleton.footprint import check_rings, load_footprint, set_angles
from p2wss.skeleton.groups import num_slots
from p2wss.skeleton.half_edges import collect_half_edges, drop_straight_points
from p2wss.skeleton.kinetic import simulate
from p2wss.skeleton.records import (
    FACE,
    HALF,
    NUM_CAPS,
    NUM_NODES,
    Batch,
    Corners,
    Ears,
    MeshWork,
    SkeletonWork,
    Walls,
    flat_label,
    ground_label,
)
from p2wss.skeleton.rings import signed_area
from p2wss.skeleton.status import BAD_HEIGHT, NOT_CLOSED, NOT_TRIANGULATED, OK, OVERFLOW
from p2wss.skeleton.triangulate import clip_ears, copy_corners, join_holes
from p2wss.skeleton.types import FaceKind

_GROUND, _WALL, _ROOF, _FLAT = (
    int(k) for k in (FaceKind.GROUND, FaceKind.WALL, FaceKind.ROOF, FaceKind.FLAT)
)

_LOWEST_WALL_M = 1e-3


@inner
def label_kind_and_edge(num_edges: int, counts: np.ndarray, label: int) -> tuple[int, int]:
    """(FaceKind, edge or -1) of a face label."""
    first_wall = num_edges + counts[NUM_CAPS]
    if label < num_edges:
        return _ROOF, label
    if label < first_wall or label == flat_label(num_edges, counts):
        return _FLAT, -1
    if label == ground_label(num_edges, counts):
        return _GROUND, -1
    return _WALL, label - first_wall


@inner
def solid_skeleton(batch: Batch, p: int, work: SkeletonWork) -> tuple[int, int]:
    """Check the arguments of polygon ``p`` of a batch and compute its skeleton. Returns (status, number of edges)."""
    edge, ring_offset = work.edge, batch.ring_offset
    first_ring, last_ring = batch.polygon_offset[p], batch.polygon_offset[p + 1]
    status, num_edges = load_footprint(batch.xy_m, ring_offset, first_ring, last_ring, edge)
    if status != OK:
        return status, 0
    eave, base = batch.eave_height_m[p], batch.base_height_m[p]
    if not (np.isfinite(eave) and np.isfinite(base) and eave - base >= _LOWEST_WALL_M):
        return BAD_HEIGHT, 0
    max_roof_height = batch.max_roof_height_m[p]
    if not max_roof_height >= 0.0:
        return BAD_HEIGHT, 0
    first = ring_offset[first_ring]
    status = set_angles(edge, num_edges, batch.angle_deg[first : first + num_edges])
    if status == OK:
        status = check_rings(edge, batch.xy_m, ring_offset, first_ring, last_ring)
    if status == OK:
        status = simulate(work, num_edges, last_ring - first_ring, max_roof_height)
    return status, num_edges


@inner
def _triangulate_faces(num_faces: int, mesh_work: MeshWork) -> int:
    """Cut all faces into triangles. Returns the number of triangles, or -1 if a face cannot be cut."""
    flat, first = mesh_work.flat, mesh_work.flat_first
    num_triangles = ZERO
    for f in range(num_faces):
        num_rings = mesh_work.face[f].last_ring - mesh_work.face[f].first_ring
        size = ZERO
        for r in range(num_rings):
            ring = mesh_work.ring_order[mesh_work.face[f].first_ring + r]
            start, end = mesh_work.ring_start[ring], mesh_work.ring_start[ring + 1]
            first[r] = size
            copy_corners(mesh_work.ring, start, flat, size, end - start)
            size += end - start
        first[num_rings] = size
        last = num_triangles
        if num_rings > 1:
            size = join_holes(flat, first, num_rings, mesh_work.loop, mesh_work.spare, mesh_work.joined)
            if size < 0:
                return -1
            num_triangles = clip_ears(mesh_work.loop, size, mesh_work.ears, mesh_work.triangle, num_triangles)
        else:
            num_triangles = clip_ears(flat, size, mesh_work.ears, mesh_work.triangle, num_triangles)
        if num_triangles < 0:
            return -1
        mesh_work.triangle_label[last:num_triangles] = mesh_work.face[f].label
    return num_triangles


@inner
def finish_solid(walls: Walls, skeleton_work: SkeletonWork, mesh_work: MeshWork) -> tuple[int, int, int]:
    """From the skeleton to faces, triangles and checks. Returns (status, number of vertices, triangles)."""
    num_edges = walls.num_edges
    edge, node, counts = skeleton_work.edge, skeleton_work.node, skeleton_work.counts
    status, num_half = collect_half_edges(num_edges, skeleton_work, mesh_work)
    if status != OK:
        return status, 0, 0
    point = mesh_work.point
    num_nodes = counts[NUM_NODES]
    for k in range(num_nodes):
        point[k, 0], point[k, 1], point[k, 2] = node[k].x, node[k].y, node[k].z + walls.eave_m
    for i in range(num_edges):
        k = num_nodes + i
        point[k, 0], point[k, 1], point[k, 2] = edge[i].x, edge[i].y, walls.base_m
    drop_straight_points(mesh_work.half, num_half, mesh_work.out_head, point, num_nodes)
    status, num_faces = trace_faces(edge, num_edges, counts, mesh_work)
    if status != OK:
        return status, 0, 0
    num_triangles = _triangulate_faces(num_faces, mesh_work)
    if num_triangles < 0:
        return NOT_TRIANGULATED, 0, 0
    vertex = mesh_work.vertex
    triangle, new_index = mesh_work.triangle, mesh_work.new_index
    # keep the points in use, in their order
    num_points = num_nodes + num_edges
    new_index[:num_points] = -1
    for t in range(num_triangles):
        for m in range(3):
            new_index[triangle[t, m]] = 0
    num_vertices = ZERO
    for k in range(num_points):
        if new_index[k] == 0:
            new_index[k] = num_vertices
            for axis in range(3):
                vertex[num_vertices, axis] = point[k, axis]
            num_vertices += 1
    for t in range(num_triangles):
        for m in range(3):
            triangle[t, m] = new_index[triangle[t, m]]
    if not pair_half_edges(triangle, num_triangles, mesh_work):
        return NOT_CLOSED, 0, 0
    num_vertices = separate_pinches(
        triangle, num_triangles, vertex, num_vertices, mesh_work.twin, mesh_work.corner, mesh_work.out_head
    )
    if num_vertices < 0:
        return OVERFLOW, 0, 0
    status = check_solid(walls, skeleton_work, mesh_work, num_vertices, num_triangles)
    return status, num_vertices, num_triangles


@inner
def solid_mesh(
    batch: Batch, p: int, skeleton_work: SkeletonWork, mesh_work: MeshWork
) -> tuple[int, int, int, int]:
    """Build the mesh of polygon ``p`` of a batch in ``mesh_work`` and check it. Returns (status, number of edges,
    vertices, triangles)."""
    status, num_edges = solid_skeleton(batch, p, skeleton_work)
    if status != OK:
        return status, 0, 0, 0
    first_ring, last_ring = batch.polygon_offset[p], batch.polygon_offset[p + 1]
    plan_area = 0.0
    for ring in range(first_ring, last_ring):
        plan_area += signed_area(batch.xy_m, batch.ring_offset[ring], batch.ring_offset[ring + 1])
    walls = Walls(
        num_edges, last_ring - first_ring, plan_area, batch.eave_height_m[p], batch.base_height_m[p]
    )
    status, num_vertices, num_triangles = finish_solid(walls, skeleton_work, mesh_work)
    return status, num_edges, num_vertices, num_triangles


def mesh_work(max_edges: int) -> MeshWork:
    """Work arrays for solids over polygons of up to ``max_edges`` edges."""
    num_points = 9 * max_edges + 64  # nodes of the skeleton, and the corners on the ground
    num_halves = 32 * max_edges + 512
    num_triangles = 16 * max_edges + 256
    corners = [Corners(np.zeros((num_halves, 2)), np.zeros(num_halves, np.int64)) for _ in range(4)]
    return MeshWork(
        point=np.zeros((num_points, 3)),
        parent=np.zeros(num_points, np.int64),
        label_parent=np.zeros(num_points, np.int64),
        label_head=np.zeros(num_points, np.int64),
        out_head=np.zeros(num_points, np.int64),
        place=np.zeros(num_points, np.int64),
        place_x=np.zeros(num_points),
        place_y=np.zeros(num_points),
        near=np.zeros(num_points, np.int64),
        ahead=np.zeros(num_points, np.int64),
        half=np.zeros(num_halves, HALF),
        ring=corners[0],
        ring_start=np.zeros(num_halves, np.int64),
        ring_order=np.zeros(num_halves, np.int64),
        ring_area=np.zeros(num_halves),
        face=np.zeros(num_halves, FACE),
        flat=corners[1],
        flat_first=np.zeros(num_halves, np.int64),
        loop=corners[2],
        spare=corners[3],
        joined=np.zeros(num_halves, np.int64),
        ears=Ears(np.zeros(num_halves, np.int64), np.zeros(num_halves, np.int64), np.zeros(num_halves)),
        triangle=np.zeros((num_triangles, 3), np.int64),
        triangle_label=np.zeros(num_triangles, np.int64),
        new_index=np.zeros(2 * num_points, np.int64),
        vertex=np.zeros((2 * num_points, 3)),
        twin=np.zeros(3 * num_triangles, np.int64),
        start=np.zeros(3 * num_triangles, np.int64),
        end=np.zeros(3 * num_triangles, np.int64),
        slot=np.zeros(num_slots(3 * num_triangles), np.int64),
        corner=np.zeros(3 * num_triangles, np.int64),
    )
