"""Whole batches: ragged polygons in, ragged meshes out."""

from __future__ import annotations

import numpy as np
from p2wss.skeleton.compiled import entry

from p2wss.skeleton.mesh import label_kind_and_edge, solid_mesh
from p2wss.skeleton.records import MAX_EDGES, mesh_work, skeleton_work
from p2wss.skeleton.status import Status
from p2wss.skeleton.types import FloatArray, Meshes, Polygons

_OK = int(Status.OK)


@entry
def _build_some(
    xy_m, ring_offset, polygon_offset, angle_deg, eave_height_m, base_height_m, max_roof_height_m,
    skeleton, mesh, start, vertex, triangle, kind, edge, vertex_offset, triangle_offset, status,
):  # fmt: skip
    """Meshes of the polygons from ``start`` on. Returns the first one for which there was no room."""
    for p in range(start, len(status)):
        code, num_edges, _, more_vertices, more_triangles = solid_mesh(
            xy_m, ring_offset, polygon_offset[p], polygon_offset[p + 1], angle_deg, eave_height_m[p],
            base_height_m[p], max_roof_height_m[p], skeleton, mesh,
        )  # fmt: skip
        num_vertices, num_triangles = vertex_offset[p], triangle_offset[p]
        if code != _OK:
            more_vertices, more_triangles = 0, 0
        if num_vertices + more_vertices > len(vertex) or num_triangles + more_triangles > len(triangle):
            return p
        status[p] = code
        vertex_offset[p + 1] = num_vertices + more_vertices
        triangle_offset[p + 1] = num_triangles + more_triangles
        origin = ring_offset[polygon_offset[p]]
        for k in range(more_vertices):
            vertex[num_vertices + k, 0] = mesh.vertex[k, 0] + xy_m[origin, 0]
            vertex[num_vertices + k, 1] = mesh.vertex[k, 1] + xy_m[origin, 1]
            vertex[num_vertices + k, 2] = mesh.vertex[k, 2]
        for t in range(more_triangles):
            for m in range(3):
                triangle[num_triangles + t, m] = mesh.triangle[t, m]
            of_kind, of_edge = label_kind_and_edge(num_edges, skeleton.counts, mesh.triangle_label[t])
            kind[num_triangles + t] = of_kind
            edge[num_triangles + t] = of_edge
    return len(status)


def _grown(array: FloatArray, num_rows: int) -> FloatArray:
    larger = np.empty((num_rows, *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


def _per_polygon(value: float | FloatArray, num_polygons: int) -> FloatArray:
    return np.ascontiguousarray(np.broadcast_to(np.asarray(value, np.float64), num_polygons))


def kernel_arguments(
    polygons: Polygons,
    angle_deg: FloatArray,
    eave_height_m: float | FloatArray,
    base_height_m: float | FloatArray,
    max_roof_height_m: float | FloatArray,
) -> tuple[FloatArray, ...]:
    """All arguments as contiguous arrays of the one dtype that the compiled code is made for."""
    num_polygons = len(polygons)
    xy_m = np.ascontiguousarray(polygons.xy_m, np.float64).reshape(-1, 2)
    angle = np.ascontiguousarray(angle_deg, np.float64)
    if angle.shape != (len(xy_m),):
        raise ValueError(f"angle_deg has shape {angle.shape}, but there are {len(xy_m)} edges")
    return (
        xy_m,
        np.ascontiguousarray(polygons.ring_offset, np.int64),
        np.ascontiguousarray(polygons.polygon_offset, np.int64),
        angle,
        _per_polygon(eave_height_m, num_polygons),
        _per_polygon(base_height_m, num_polygons),
        _per_polygon(max_roof_height_m, num_polygons),
    )


def work_size(polygons: Polygons) -> int:
    """Number of edges that the work arrays have to hold for the largest polygon that is not refused anyway."""
    num_edges = np.diff(polygons.vertex_offset)
    return int(min(max(num_edges.max(initial=3), 16), MAX_EDGES))


def build(
    polygons: Polygons,
    angle_deg: FloatArray,
    eave_height_m: FloatArray,
    *,
    base_height_m: float | FloatArray = 0.0,
    max_roof_height_m: float | FloatArray = np.inf,
) -> Meshes:
    """Closed LoD2 meshes from clean polygons.

    polygons: as returned by :func:`p2wss.skeleton.clean`, any planar frame in metres (coordinates of 7e6 m too:
    the work is done relative to the first vertex). angle_deg: (num_vertices,), per edge 0, 90 or 5..85.
    eave_height_m: (num_polygons,), measured from z = 0. base_height_m: height of the ground face, below the
    eave; negative to reach down a slope. max_roof_height_m: a roof that would rise higher above its eave is cut
    flat there. Both per polygon or one for all.

    Every mesh has T = 2 V - 4 + 4 c triangles for V vertices and c courtyards: coplanar neighbours share a face.
    Nothing is raised for any geometry: what cannot be built has a ``Status`` other than OK and no triangles.

    Raises ValueError when the lengths of the arrays do not fit each other.

    Model: the parametric building of the Point2WSS paper, section 3; weighted straight skeletons: Held and
    Palfrader 2017.
    """
    arguments = kernel_arguments(polygons, angle_deg, eave_height_m, base_height_m, max_roof_height_m)
    size = work_size(polygons)
    num_polygons, num_edges = len(polygons), len(polygons.xy_m)
    vertex = np.empty((4 * num_edges + 64, 3))
    triangle = np.empty((8 * num_edges + 64, 3), np.int32)
    kind, edge = np.empty(len(triangle), np.uint8), np.empty(len(triangle), np.int32)
    vertex_offset, triangle_offset = np.zeros((2, num_polygons + 1), np.int64)
    status = np.zeros(num_polygons, np.int32)
    work = skeleton_work(size), mesh_work(size)
    done = 0
    while True:
        done = _build_some(
            *arguments, *work, done, vertex, triangle, kind, edge, vertex_offset, triangle_offset, status
        )
        if done == num_polygons:
            break
        room = 2 * len(vertex) + 64 * size
        vertex, triangle = _grown(vertex, room), _grown(triangle, 2 * room)
        kind, edge = _grown(kind, 2 * room), _grown(edge, 2 * room)
    num_vertices, num_triangles = vertex_offset[-1], triangle_offset[-1]
    return Meshes(
        vertex[:num_vertices].copy(),
        triangle[:num_triangles].copy(),
        kind[:num_triangles].copy(),
        edge[:num_triangles].copy(),
        vertex_offset,
        triangle_offset,
        status,
    )
