"""The planes of a closed mesh, and how far the points on a roof are from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from p2wss.fit.mesh.union import Mesh
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.types import FaceKind

# a wall whose plane contains an edge of the footprint is an outer wall
_ON_WALL_M = 1e-3
_UPRIGHT_NZ = 0.05
# larger residuals count as this, as in the fit
CAP_M = 1.0
# a triangle that is turned over by no more than this, twice its area in square metres, has no area
_NO_AREA_M2 = 1e-6


@dataclass(frozen=True)
class MeshPlanes:
    """The planes of a mesh, numbered from 0.

    number: (t,), of each triangle. normal: (p, 3), outwards. offset_m: (p,), distances from the origin along the
    normals. area_m2: (p,). is_free: (p,), whether a plane is neither an outer wall nor the floor. at: the planes of
    each vertex.
    """

    number: np.ndarray
    normal: np.ndarray
    offset_m: np.ndarray
    area_m2: np.ndarray
    is_free: np.ndarray
    at: list[set[int]]

    @classmethod
    def of(cls, mesh: Mesh, rings: Sequence[np.ndarray]) -> MeshPlanes:
        """The planes of a mesh over the footprint ``rings``."""
        number = np.unique(mesh.plane, return_inverse=True)[1].reshape(-1)
        corner_m = mesh.vertex_m[mesh.triangle]
        cross = _cross(corner_m)
        normal = np.column_stack([np.bincount(number, cross[:, axis]) for axis in range(3)])
        twice_m2 = np.linalg.norm(normal, axis=1)
        normal = normal / twice_m2[:, None]
        offset_m = np.zeros(len(normal))
        offset_m[number] = (normal[number] * corner_m[:, 0]).sum(axis=1)
        start = np.concatenate(list(rings))
        end = np.concatenate([points for ring in rings for points in (ring[1:], ring[:1])])
        gap_m = np.maximum(*(np.abs(ends @ normal[:, :2].T - offset_m) for ends in (start, end)))
        is_outer = (np.abs(normal[:, 2]) < _UPRIGHT_NZ) & (gap_m.min(axis=0) < _ON_WALL_M)
        is_free = ~is_outer
        is_free[number[mesh.kind == FaceKind.GROUND]] = False
        at: list[set[int]] = [set() for _ in mesh.vertex_m]
        for plane, corners in zip(number.tolist(), mesh.triangle.tolist(), strict=True):
            for vertex in corners:
                at[vertex].add(plane)
        return cls(number, normal, offset_m, twice_m2 / 2, is_free, at)

    def table(self, vertices: Sequence[int]) -> np.ndarray:
        """int64 (n, k): the planes of each of some vertices in ascending order, -1 beyond the last."""
        rows = [sorted(self.at[vertex]) for vertex in vertices]
        num = max(map(len, rows), default=0)
        return np.array([row + [-1] * (num - len(row)) for row in rows], np.int64).reshape(len(rows), num)

    @property
    def is_roof(self) -> np.ndarray:
        """bool (p,): planes that face upwards."""
        return self.normal[:, 2] > _UPRIGHT_NZ

    @property
    def is_wall(self) -> np.ndarray:
        """bool (p,)."""
        return np.abs(self.normal[:, 2]) < _UPRIGHT_NZ


def turned_over(vertex_m: np.ndarray, triangle: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """bool (t,): which triangles (t, 3) face away from the normals (t, 3) of their planes."""
    return (_cross(vertex_m[triangle]) * normal).sum(axis=1) < -_NO_AREA_M2


def _cross(corner_m: np.ndarray) -> np.ndarray:
    """(t, 3), normals as long as twice the area of the triangles (t, 3, 3)."""
    u, v = corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0]
    # numpy's own function takes three times as long for a few triangles
    return u[:, [1, 2, 0]] * v[:, [2, 0, 1]] - u[:, [2, 0, 1]] * v[:, [1, 2, 0]]


@entry
def topmost(corner_m, point_m):
    """(number of the topmost triangle over or below each point, its height there); -1 and minus infinity for none.
    corner_m: float64 (t, 3, 3), counter-clockwise seen from above. point_m: float64 (m, 3)."""
    num = len(point_m)
    triangle, height = np.full(num, -1), np.full(num, -np.inf)
    x, y = point_m[:, 0].copy(), point_m[:, 1].copy()
    for t in range(len(corner_m)):
        a, b, c = corner_m[t, 0], corner_m[t, 1], corner_m[t, 2]
        bx, by, cx, cy = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
        twice_m2 = bx * cy - by * cx
        if twice_m2 <= 0.0:
            continue
        rise_b, rise_c = (b[2] - a[2]) / twice_m2, (c[2] - a[2]) / twice_m2
        # without branches, so that several points are tested at once
        for k in range(num):
            dx, dy = x[k] - a[0], y[k] - a[1]
            share_b, share_c = dx * cy - dy * cx, bx * dy - by * dx
            z = a[2] + share_b * rise_b + share_c * rise_c
            is_over = (share_b >= 0.0) & (share_c >= 0.0) & (share_b + share_c <= twice_m2) & (z > height[k])
            triangle[k] = t if is_over else triangle[k]
            height[k] = z if is_over else height[k]
    return triangle, height
