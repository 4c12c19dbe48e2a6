"""Volumes of meshes, and independent checks of them."""

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
    """Empty if trimesh and manifold3d both accept the solid, otherwise the reason why not."""
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


def crosses_itself(vertex: np.ndarray, triangle: np.ndarray, margin: float = 1e-6) -> bool:
    """Whether an edge passes through the inside of a triangle that it has no corner in common with."""
    corner = (vertex - vertex[0])[triangle]
    a, ab, ac = corner[:, 0], corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    normal = np.cross(ab, ac)
    area = np.linalg.norm(normal, axis=1)
    edges = np.unique(np.sort(triangle[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    start, end = (vertex - vertex[0])[edges[:, 0]], (vertex - vertex[0])[edges[:, 1]]
    # heights over the planes of all triangles: (edges, triangles)
    above = np.einsum("etk,tk->et", start[:, None] - a, normal) / area
    below = np.einsum("etk,tk->et", end[:, None] - a, normal) / area
    through = (np.minimum(above, below) < -margin) & (np.maximum(above, below) > margin)
    through &= ~(edges[:, :, None, None] == triangle[None, None]).any(axis=(1, 3))
    e, t = np.nonzero(through)
    share = above[e, t] / (above[e, t] - below[e, t])
    hit = start[e] + share[:, None] * (end[e] - start[e]) - a[t]
    u = np.einsum("ij,ij->i", np.cross(hit, ac[t]), normal[t]) / area[t] ** 2
    v = np.einsum("ij,ij->i", np.cross(ab[t], hit), normal[t]) / area[t] ** 2
    return bool(np.any(np.minimum(np.minimum(u, v), 1 - u - v) > margin))
