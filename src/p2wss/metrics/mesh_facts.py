"""What a mesh is by itself: number of triangles, closed, consistently oriented, its volume."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh


@dataclass(frozen=True)
class MeshFacts:
    """num_triangles: without degenerate ones. watertight: every edge has two triangles. oriented: neighbours
    run through their common edge in opposite directions. volume_m3: positive if the normals point outwards,
    NaN if not watertight. num_bodies: connected parts."""

    num_triangles: int
    watertight: bool
    oriented: bool
    volume_m3: float
    num_bodies: int


def mesh_facts(vertex_m: np.ndarray, triangle: np.ndarray, weld_m: float = 1e-4) -> MeshFacts:
    """Facts of a mesh, vertices welded on a grid of ``weld_m`` metres. vertex_m (v, 3), triangle (t, 3)."""
    triangle = np.asarray(triangle, int).reshape(-1, 3)
    if not len(triangle):
        return MeshFacts(0, False, False, 0.0, 0)
    grid = np.round(np.asarray(vertex_m, float) / weld_m).astype(np.int64)
    _, first, welded = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    triangle = welded.reshape(-1)[triangle]
    a, b, c = triangle.T
    triangle = triangle[(a != b) & (b != c) & (c != a)]
    mesh = trimesh.Trimesh(np.asarray(vertex_m, float)[first], triangle, process=False)
    closed = bool(mesh.is_watertight)
    return MeshFacts(
        num_triangles=len(triangle),
        watertight=closed,
        oriented=bool(mesh.is_winding_consistent),
        volume_m3=float(mesh.volume) if closed else float("nan"),
        num_bodies=int(mesh.body_count),
    )
