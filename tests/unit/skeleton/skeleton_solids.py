"""Volumes of meshes, and two independent judges of them."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton import Meshes


def volumes(meshes: Meshes) -> np.ndarray:
    """m3 per mesh, NaN for a rejected one."""
    out = np.full(len(meshes), np.nan)
    for k in range(len(meshes)):
        vertex, triangle, _, _ = meshes.mesh(k)
        if len(triangle):
            local = vertex - vertex[0]
            a, b, c = (local[triangle[:, m]] for m in range(3))
            out[k] = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    return out


def judged_sound(vertex: np.ndarray, triangle: np.ndarray, num_courtyards: int) -> str:
    """Empty if trimesh and manifold3d both accept the solid, else what is wrong."""
    import manifold3d
    import trimesh

    local = vertex - vertex[0]
    mesh = trimesh.Trimesh(local, triangle, process=False)
    if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0):
        return "trimesh: not a closed, oriented solid"
    if mesh.euler_number != 2 - 2 * num_courtyards:
        return f"trimesh: Euler number {mesh.euler_number}"
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(np.ascontiguousarray(local), np.ascontiguousarray(triangle, np.uint64))
    )
    if solid.status() != manifold3d.Error.NoError:
        return f"manifold3d: {solid.status()}"
    if solid.genus() != num_courtyards:
        return f"manifold3d: genus {solid.genus()}"
    # a solid that crosses itself changes its volume when its parts are united with nothing
    united = solid + manifold3d.Manifold.cube((1e-3, 1e-3, 1e-3)).translate((1e4, 1e4, 0))
    if abs(united.volume() - mesh.volume) > 1e-6 * mesh.volume + 1e-6:
        return f"manifold3d: volume {united.volume()} against {mesh.volume}"
    return ""
