"""Facts of a mesh by itself: closed, manifold, planar faces."""

from typing import NamedTuple

import numpy as np
import trimesh

from p2wss.mesh.rules import shell_code

# the rule of ISO 19107 that a manifold of several bodies breaks
_SEVERAL_PARTS = 305


class MeshFacts(NamedTuple):
    """watertight: every edge has two triangles. manifold: moreover, the two triangles run along the edge in opposite
    directions, and the triangles at each vertex form one fan."""

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
    watertight = bool(mesh.is_watertight)
    return MeshFacts(watertight, watertight and shell_code(triangle) in (0, _SEVERAL_PARTS))


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
