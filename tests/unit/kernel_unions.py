"""One closed mesh from several buildings of the kernel side by side, for tests of what happens to meshes."""

from __future__ import annotations

from collections.abc import Sequence

import manifold3d
import numpy as np
from drawn_towns.planes import mesh_of

from p2wss.fit.parametric import FittedRoof, kernel_mesh
from p2wss.mesh import Mesh
from p2wss.mesh.planar import with_exact_faces, without_straight_vertices

_SHORT_EDGE_M = 1e-2
# how far a surface may move when slivers are removed
_SIMPLIFY_M = 2e-3


def union(
    parts: Sequence[FittedRoof], min_eave_height_m: float = 1.0, max_roof_height_m: float = 50.0
) -> Mesh:
    """The union of roofs on one ground, without edges of millimetres."""
    mesh = union_or_none(parts, min_eave_height_m, max_roof_height_m)
    assert mesh is not None
    return mesh


def union_or_none(
    parts: Sequence[FittedRoof], min_eave_height_m: float, max_roof_height_m: float
) -> Mesh | None:
    """None if a part has no solid, or if the result is not one closed solid."""
    solids = []
    for part in parts:
        mesh = kernel_mesh(
            part.rings, part.angle_deg, max(part.eave_z_m, min_eave_height_m), max_roof_height_m
        )
        if mesh is None:
            return None
        vertex_m = _on_rings(mesh.vertex_m, np.concatenate(list(part.rings)))
        solids.append(manifold3d.Manifold(manifold3d.Mesh64(vertex_m, mesh.triangle.astype(np.uint64))))
    whole = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    simple = whole.as_original().simplify(_SIMPLIFY_M)
    if simple.is_empty() or len(simple.decompose()) != 1:
        return None
    out = simple.to_mesh64()
    vertex_m = np.ascontiguousarray(np.array(out.vert_properties, float)[:, :3])
    mesh = without_straight_vertices(mesh_of(vertex_m, np.array(out.tri_verts, np.int32)))
    if not mesh.is_closed:
        return None
    if mesh.edge_m.min() >= _SHORT_EDGE_M:
        return mesh
    merged = with_exact_faces(mesh, _SHORT_EDGE_M)
    return merged if merged.is_closed else mesh


def _on_rings(vertex_m: np.ndarray, corner_m: np.ndarray) -> np.ndarray:
    """Vertices of which those over corners and axis-parallel lines of the rings have exactly their coordinates."""
    result = vertex_m.copy()
    for axis in range(2):
        off_m = np.abs(vertex_m[:, axis, None] - corner_m[:, axis])
        near = off_m.min(axis=1) < 1e-6
        result[near, axis] = corner_m[off_m.argmin(axis=1)[near], axis]
    return result
