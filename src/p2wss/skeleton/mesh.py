"""From one polygon with angles and heights to one closed and checked triangle mesh."""

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
    flat_label,
    ground_label,
)
from p2wss.skeleton.status import BAD_HEIGHT, NOT_CLOSED, NOT_TRIANGULATED, OK, OVERFLOW
from p2wss.skeleton.triangulate import clip_ears, join_holes
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
    eave, base, max_roof_height = (
        batch.eave_height_m[p],
        batch.base_height_m[p],
        batch.max_roof_height_m[p],
    )
    are_finite = np.isfinite(eave) and np.isfinite(base)
    if not (are_finite and eave - base >= _LOWEST_WALL_M and max_roof_height >= 0.0):
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
    num_triangles = ZERO
    for f in range(num_faces):
        rings = mesh_work.ring_order[mesh_work.face[f].first_ring : mesh_work.face[f].last_ring]
        size = join_holes(rings, mesh_work)
        last = num_triangles
        num_triangles = clip_ears(mesh_work.loop, size, mesh_work.ears, mesh_work.triangle, num_triangles)
        if num_triangles < 0:
            return -1
        mesh_work.triangle_label[last:num_triangles] = mesh_work.face[f].label
    return num_triangles


@inner
def solid_mesh(
    batch: Batch, p: int, skeleton_work: SkeletonWork, mesh_work: MeshWork
) -> tuple[int, int, int, int]:
    """Build the mesh of polygon ``p`` of a batch in ``mesh_work`` and check it. Returns (status, number of edges,
    vertices, triangles)."""
    status, num_edges = solid_skeleton(batch, p, skeleton_work)
    if status != OK:
        return status, 0, 0, 0
    edge, node, counts = skeleton_work.edge, skeleton_work.node, skeleton_work.counts
    status, num_half = collect_half_edges(num_edges, skeleton_work, mesh_work)
    if status != OK:
        return status, 0, 0, 0
    point = mesh_work.point
    num_nodes = counts[NUM_NODES]
    for k in range(num_nodes):
        point[k, 0], point[k, 1], point[k, 2] = node[k].x, node[k].y, node[k].z + batch.eave_height_m[p]
    for i in range(num_edges):
        k = num_nodes + i
        point[k, 0], point[k, 1], point[k, 2] = edge[i].x, edge[i].y, batch.base_height_m[p]
    drop_straight_points(mesh_work.half, num_half, mesh_work.out_head, point, num_nodes)
    status, num_faces = trace_faces(edge, num_edges, counts, mesh_work)
    if status != OK:
        return status, 0, 0, 0
    num_triangles = _triangulate_faces(num_faces, mesh_work)
    if num_triangles < 0:
        return NOT_TRIANGULATED, 0, 0, 0
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
        return NOT_CLOSED, 0, 0, 0
    num_vertices = separate_pinches(
        triangle, num_triangles, vertex, num_vertices, mesh_work.twin, mesh_work.corner, mesh_work.out_head
    )
    if num_vertices < 0:
        return OVERFLOW, 0, 0, 0
    status = check_solid(batch, p, skeleton_work, mesh_work, num_vertices, num_triangles)
    return status, num_edges, num_vertices, num_triangles


def mesh_work(max_edges: int) -> MeshWork:
    """Work arrays for solids over polygons of up to ``max_edges`` edges."""
    num_points = 9 * max_edges + 64  # nodes of the skeleton, and the corners on the ground
    num_halves = 32 * max_edges + 512
    num_triangles = 16 * max_edges + 256
    corners = [Corners(np.zeros((num_halves, 2)), np.zeros(num_halves, np.int64)) for _ in range(3)]
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
        loop=corners[1],
        spare=corners[2],
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
