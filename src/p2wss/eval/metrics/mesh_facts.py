"""Facts of a mesh by itself: closed, manifold, planar faces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh

from p2wss.skeleton.groups import groups


class MeshFacts(NamedTuple):
    """watertight: every edge has two triangles. manifold: these run through it in opposite directions, too, and the
    triangles at each vertex form one fan."""

    watertight: bool
    manifold: bool


def mesh_facts(vertex_m: np.ndarray, triangle: np.ndarray, weld_m: float = 1e-4) -> MeshFacts:
    """Facts of a mesh, vertices welded on a grid of ``weld_m`` metres. vertex_m (v, 3), triangle (t, 3)."""
    triangle = np.asarray(triangle, int).reshape(-1, 3)
    if not len(triangle):
        return MeshFacts(False, False)
    grid = np.round(np.asarray(vertex_m, float) / weld_m).astype(np.int64)
    _, first, welded = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    triangle = welded.reshape(-1)[triangle]
    a, b, c = triangle.T
    triangle = triangle[(a != b) & (b != c) & (c != a)]
    mesh = trimesh.Trimesh(np.asarray(vertex_m, float)[first], triangle, process=False)
    watertight, num_vertices = bool(mesh.is_watertight), len(np.unique(triangle))
    has_one_fan_each = mesh.is_winding_consistent and _num_fans(triangle) == num_vertices
    return MeshFacts(watertight, watertight and bool(has_one_fan_each))


def _num_fans(triangle: np.ndarray) -> int:
    """Number of fans of triangles around all vertices: equal to the number of vertices if each has one fan.

    Corners of two triangles belong to one fan where they share the vertex and an edge at it.
    """
    corner = np.arange(triangle.size).reshape(-1, 3)
    ends = np.stack([triangle, np.roll(triangle, -1, axis=1)], axis=-1).reshape(-1, 2)
    corners = np.stack([corner, np.roll(corner, -1, axis=1)], axis=-1).reshape(-1, 2)
    turned = ends[:, 0] > ends[:, 1]
    ends[turned], corners[turned] = ends[turned, ::-1], corners[turned, ::-1]
    order = np.lexsort(ends.T)
    ends, corners = ends[order], corners[order]
    same = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
    first, second = corners[same].ravel(), corners[same + 1].ravel()
    return int(groups(triangle.size, np.column_stack([first, second])).max()) + 1


def out_of_plane_m(vertex_m: np.ndarray, triangle: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Largest distance of a face's vertices from their least-squares plane, per face: (num_faces,), metres.

    vertex_m (v, 3), triangle (t, 3), face (t,) from 0 to num_faces - 1.
    """
    vertex_m, triangle = np.asarray(vertex_m, float), np.asarray(triangle, int)
    num_faces = int(face.max()) + 1 if len(face) else 0
    deviation_m = np.zeros(num_faces)
    for f in range(num_faces):
        corner = vertex_m[np.unique(triangle[face == f])]
        corner = corner - corner.mean(axis=0)
        normal = np.linalg.svd(corner, full_matrices=True)[2][-1]
        deviation_m[f] = np.abs(corner @ normal).max()
    return deviation_m
