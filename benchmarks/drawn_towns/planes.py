"""Meshes of drawn solids, of which only the triangles are known; their planes are found here."""

from __future__ import annotations

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.topology import NEXT, doubled_areas, twins
from p2wss.skeleton.types import FaceKind

# distance of vertices from the plane of a roof, and of a wall, in which they lie. Heights that differ by less than the
# first are one; walls that turn by little are two, and rounding of coordinates moves vertices by less than the second
_COPLANAR_M, _IN_WALL_M = 4e-3, 1.5e-3
_SAME_WAY = 0.99
_UPRIGHT_NZ, _LEVEL_NZ = 0.05, 0.9999


def mesh_of(vertex_m: np.ndarray, triangle: np.ndarray) -> Mesh:
    """A closed mesh of vertices (v, 3) and triangles (t, 3). Planes grow from the largest triangles, whose normals are
    the most accurate."""
    corner_m = vertex_m[triangle]
    normal, side_m = doubled_areas(corner_m), np.linalg.norm(corner_m - corner_m[:, NEXT], axis=2)
    area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(area, 1e-12)[:, None]
    is_sliver = area < 2 * _COPLANAR_M * side_m.max(axis=1)
    beside = twins(triangle) // 3
    kind, plane = np.zeros(len(triangle), np.uint8), np.full(len(triangle), -1, np.int32)
    for number, seed in enumerate(np.argsort(-area, kind="stable").tolist()):
        if plane[seed] >= 0:
            continue
        offset_m = corner_m[seed].mean(axis=0) @ normal[seed]
        of_plane = _kind(normal[seed, 2])
        most_m = _IN_WALL_M if of_plane == FaceKind.WALL else _COPLANAR_M
        plane[seed], kind[seed] = number, of_plane
        pending = [seed]
        while pending:
            for other in beside[pending.pop()].tolist():
                if other < 0 or plane[other] >= 0:
                    continue
                is_along = is_sliver[other] or normal[other] @ normal[seed] > _SAME_WAY
                if is_along and (np.abs(corner_m[other] @ normal[seed] - offset_m) < most_m).all():
                    plane[other], kind[other] = number, of_plane
                    pending.append(other)
    return Mesh(vertex_m, triangle, kind, plane)


def _kind(upwards: float) -> FaceKind:
    if abs(upwards) < _UPRIGHT_NZ:
        return FaceKind.WALL
    if upwards < 0:
        return FaceKind.GROUND
    return FaceKind.FLAT if upwards > _LEVEL_NZ else FaceKind.ROOF
