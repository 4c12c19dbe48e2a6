"""Points on a triangle mesh: uniform samples, exact distances to it, and the triangle over or below each."""

from __future__ import annotations

import numpy as np
import trimesh
import trimesh.sample

from p2wss.skeleton.compiled import entry


def sample_surface(
    vertex_m: np.ndarray, triangle: np.ndarray, num_samples: int, generator: np.random.Generator
) -> np.ndarray:
    """Points drawn uniformly by area over the triangles: float64 (num_samples, 3), or (0, 3) without area.

    vertex_m (v, 3), triangle (t, 3). The same generator state gives the same points.
    """
    mesh = trimesh.Trimesh(np.asarray(vertex_m, float), np.asarray(triangle, int), process=False)
    if not mesh.area > 0:
        return np.zeros((0, 3))
    return np.asarray(trimesh.sample.sample_surface(mesh, num_samples, seed=generator)[0], float)


def distance_to_mesh(point_m: np.ndarray, vertex_m: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Exact distance of each point to the nearest triangle, metres. point_m (n, 3) -> (n,); inf without triangles.

    The nearest place of a triangle is the projection of the point if that is inside, else on one of the edges.
    """
    point_m = np.asarray(point_m, float)
    nearest = np.full(len(point_m), np.inf)
    for a, b, c in np.asarray(vertex_m, float)[np.asarray(triangle, int)]:
        squared = np.minimum.reduce(
            [_squared_to_segment(point_m, *ends) for ends in ((a, b), (b, c), (c, a))]
        )
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length > 0:
            normal /= length
            inside = np.ones(len(point_m), bool)
            for start, end in ((a, b), (b, c), (c, a)):
                inside &= (point_m - start) @ np.cross(normal, end - start) >= 0
            squared[inside] = ((point_m[inside] - a) @ normal) ** 2
        nearest = np.minimum(nearest, squared)
    return np.sqrt(nearest)


def _squared_to_segment(point_m: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    along = end - start
    length = along @ along
    share = np.clip((point_m - start) @ along / length, 0, 1) if length > 0 else np.zeros(len(point_m))
    return ((point_m - start - share[:, None] * along) ** 2).sum(axis=1)


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
