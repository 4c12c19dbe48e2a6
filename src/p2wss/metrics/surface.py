"""Points on a triangle mesh: uniform samples, and exact distances to it."""

from __future__ import annotations

import numpy as np


def triangle_areas(vertex_m: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Area of each triangle, square metres. vertex_m (v, 3), triangle (t, 3) -> (t,)."""
    corner = np.asarray(vertex_m, float)[np.asarray(triangle, int)]
    return np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2


def sample_surface(
    vertex_m: np.ndarray, triangle: np.ndarray, num_samples: int, generator: np.random.Generator
) -> np.ndarray:
    """Points drawn uniformly by area over the triangles: float64 (num_samples, 3), or (0, 3) without area."""
    area = triangle_areas(vertex_m, triangle)
    total = area.sum()
    if not total > 0:
        return np.zeros((0, 3))
    chosen = np.asarray(triangle, int)[generator.choice(len(area), num_samples, p=area / total)]
    a, b, c = np.moveaxis(np.asarray(vertex_m, float)[chosen], 1, 0)
    # the square root makes the density uniform over the triangle (Osada et al. 2002, section 4.2)
    u = np.sqrt(generator.random(num_samples))[:, None]
    v = generator.random(num_samples)[:, None]
    return (1 - u) * a + u * (1 - v) * b + u * v * c


def distance_to_mesh(point_m: np.ndarray, vertex_m: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Exact distance of each point to the nearest triangle, metres. point_m (n, 3) -> (n,); inf without one.

    A point is nearest to the inside of a triangle where its projection falls, else to one of the three edges.
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
