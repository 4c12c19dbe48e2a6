"""Which triangles of a closed mesh lie in one plane."""

from __future__ import annotations

import numpy as np

from p2wss.mesh.topology import NEXT, doubled_areas, twins
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.types import FaceKind

# vertices within this distance of a roof, and of a wall, lie in it: heights nearer than the first are one, but walls
# that turn by little are two, and rounded coordinates are off by less than the second
_COPLANAR_M, _IN_WALL_M = 4e-3, 1.5e-3
_SAME_WAY = 0.99
_UPRIGHT_NZ, LEVEL_NZ = 0.05, 0.9999
_WALL, _GROUND = int(FaceKind.WALL), int(FaceKind.GROUND)
_ROOF, _FLAT = int(FaceKind.ROOF), int(FaceKind.FLAT)


def face_planes(vertex_m: np.ndarray, triangle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(kind uint8, plane int32) of every triangle (t, 3) of a closed mesh. Planes grow from the largest triangles,
    whose normals are the most accurate."""
    corner_m = vertex_m[triangle]
    normal, side_m = doubled_areas(corner_m), np.linalg.norm(corner_m - corner_m[:, NEXT], axis=2)
    area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(area, 1e-12)[:, None]
    is_sliver = area < 2 * _COPLANAR_M * side_m.max(axis=1)
    order = np.argsort(-area, kind="stable")
    return _grown(vertex_m, triangle, twins(triangle) // 3, normal, is_sliver, order)


@entry
def _grown(
    vertex_m: np.ndarray,
    triangle: np.ndarray,
    beside: np.ndarray,
    normal: np.ndarray,
    is_sliver: np.ndarray,
    order: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The same. beside: int (t, 3), the triangle across each side, -1 for none. order: of the triangles."""
    num = len(triangle)
    kind, plane = np.zeros(num, np.uint8), np.full(num, -1, np.int32)
    pending = np.empty(num, np.int64)
    number = -1
    for seed in order:
        number += 1
        if plane[seed] >= 0:
            continue
        x, y, z = normal[seed, 0], normal[seed, 1], normal[seed, 2]
        offset = 0.0
        for k in range(3):
            corner = vertex_m[triangle[seed, k]]
            offset += (x * corner[0] + y * corner[1] + z * corner[2]) / 3.0
        if abs(z) < _UPRIGHT_NZ:
            of_plane = _WALL
        elif z < 0:
            of_plane = _GROUND
        else:
            of_plane = _FLAT if z > LEVEL_NZ else _ROOF
        most_m = _IN_WALL_M if of_plane == _WALL else _COPLANAR_M
        plane[seed], kind[seed] = number, of_plane
        pending[0], num_pending = seed, 1
        while num_pending > 0:
            num_pending -= 1
            t = pending[num_pending]
            for k in range(3):
                other = beside[t, k]
                if other < 0 or plane[other] >= 0:
                    continue
                along = normal[other, 0] * x + normal[other, 1] * y + normal[other, 2] * z
                if not (is_sliver[other] or along > _SAME_WAY):
                    continue
                in_plane = True
                for m in range(3):
                    corner = vertex_m[triangle[other, m]]
                    if abs(corner[0] * x + corner[1] * y + corner[2] * z - offset) >= most_m:
                        in_plane = False
                if in_plane:
                    plane[other], kind[other] = number, of_plane
                    pending[num_pending] = other
                    num_pending += 1
    return kind, plane
