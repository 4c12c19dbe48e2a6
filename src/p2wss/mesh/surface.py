"""Points on a triangle mesh: uniform samples, and exact distances to it."""

from __future__ import annotations

import numpy as np
import trimesh
import trimesh.sample
import trimesh.triangles


def triangle_areas(vertex_m: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Area of each triangle, square metres. vertex_m (v, 3), triangle (t, 3) -> (t,)."""
    return np.asarray(trimesh.triangles.area(np.asarray(vertex_m, float)[np.asarray(triangle, int)]))


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
