"""Closed meshes without slivers, short edges, and vertices within faces and straight edges."""

from __future__ import annotations

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.booleans import manifold3d
from p2wss.mesh.planar import without_straight_vertices

# how far a surface may move when slivers are removed
_SIMPLIFY_M = 2e-3


def simplified(vertex_m: np.ndarray, triangle: np.ndarray) -> Mesh | None:
    """A closed mesh (v, 3), (t, 3), some vertices of which may be unused, without the slivers and the vertices within
    faces and straight edges; None if it is not one solid."""
    used, index = np.unique(triangle, return_inverse=True)
    corners = index.reshape(-1, 3).astype(np.uint64)
    whole = manifold3d.Manifold(manifold3d.Mesh64(np.ascontiguousarray(vertex_m[used]), corners))
    whole = whole.as_original().simplify(_SIMPLIFY_M)
    if whole.status() != manifold3d.Error.NoError or whole.is_empty() or len(whole.decompose()) != 1:
        return None
    out = whole.to_mesh64()
    vertex_m = np.ascontiguousarray(np.array(out.vert_properties, float)[:, :3])
    return without_straight_vertices(Mesh.of_triangles(vertex_m, np.array(out.tri_verts, np.int32)))
