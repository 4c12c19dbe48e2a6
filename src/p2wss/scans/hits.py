"""Where rays meet the surface first, exactly.

Embree answers in float32 and, rarely, wrongly (near-parallel rays on thin triangles). So only the triangle that a ray
meets first is taken from it. The point is computed here in float64 and must lie on that triangle, which also makes the
points equal on machines whose Embree rounds differently.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from p2wss.scans.surface import Surface
from p2wss.scans.terrain import Ray, crossing
from p2wss.skeleton.compiled import entry, inlined

_ON_TRIANGLE_M = 0.005


class Hits(NamedTuple):
    """The first hit of each of n rays.

    triangle: int32 (n,), -1 for the terrain. distance_m: float64 (n,), from the ray's origin, -1 if the ray
    meets nothing. normal: float64 (n, 3), unit normal of the surface. height_m: float64 (n,), distance of the
    surface's plane from the origin of the frame, along the normal.
    """

    triangle: np.ndarray
    distance_m: np.ndarray
    normal: np.ndarray
    height_m: np.ndarray


def empty_hits(num_rays: int) -> Hits:
    """Arrays for the hits of ``num_rays`` rays, not initialised."""
    return Hits(np.empty(num_rays, np.int32), np.empty(num_rays), np.empty((num_rays, 3)), np.empty(num_rays))


@entry
def locate(
    origin: np.ndarray, direction: np.ndarray, embree_triangle: np.ndarray, surface: Surface, hits: Hits
) -> None:
    """Fill in ``hits``: where each ray meets the triangle that Embree names, or the terrain before it.

    embree_triangle: int32 (n,), -1 where the ray meets no triangle.
    """
    grid, vertex, triangles = surface.terrain, surface.vertex_m, surface.triangle
    height, highest = grid.height_m, grid.highest_m
    hit_triangle, hit_m, hit_normal, hit_height = hits
    for k in range(len(embree_triangle)):
        ray = ray_of(origin, direction, k)
        triangle = embree_triangle[k]
        t, nx, ny, nz, offset = _on_triangle(vertex, triangles, triangle, ray)
        ground_t, east, north = crossing(grid, height, highest, ray, t if t >= 0 else np.inf)
        if t < 0:
            triangle = -1
        if ground_t >= 0:
            triangle, t = -1, ground_t
            nz = 1 / sqrt(1 + east * east + north * north)
            nx, ny = -east * nz, -north * nz
            offset = nx * (ray.x + t * ray.dx) + ny * (ray.y + t * ray.dy) + nz * (ray.z + t * ray.dz)
        hit_triangle[k], hit_m[k], hit_height[k] = triangle, t, offset
        hit_normal[k, 0], hit_normal[k, 1], hit_normal[k, 2] = nx, ny, nz


@inlined
def ray_of(origin: np.ndarray, direction: np.ndarray, k: int) -> Ray:
    """Ray number ``k`` of float32 arrays (n, 3)."""
    return Ray(
        np.float64(origin[k, 0]), np.float64(origin[k, 1]), np.float64(origin[k, 2]),
        np.float64(direction[k, 0]), np.float64(direction[k, 1]), np.float64(direction[k, 2]),
    )  # fmt: skip


@inlined
def _on_triangle(
    vertex: np.ndarray, triangles: np.ndarray, triangle: int, ray: Ray
) -> tuple[float, float, float, float, float]:
    """Distance along the ray to a triangle, its unit normal, and the distance of its plane from the origin.

    The distance is -1 if there is no triangle, or if the ray misses it: then Embree was wrong.
    """
    if triangle < 0:
        return -1.0, 0.0, 0.0, 0.0, 0.0
    i0, i1, i2 = triangles[triangle, 0], triangles[triangle, 1], triangles[triangle, 2]
    ax, ay, az = vertex[i0, 0], vertex[i0, 1], vertex[i0, 2]
    bx, by, bz = vertex[i1, 0], vertex[i1, 1], vertex[i1, 2]
    cx, cy, cz = vertex[i2, 0], vertex[i2, 1], vertex[i2, 2]
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    per_length = 1 / sqrt(max(nx * nx + ny * ny + nz * nz, 1e-300))
    slope = nx * ray.dx + ny * ray.dy + nz * ray.dz
    if slope == 0.0:
        return -1.0, 0.0, 0.0, 0.0, 0.0
    t = (nx * (ax - ray.x) + ny * (ay - ray.y) + nz * (az - ray.z)) / slope
    point = ray.x + t * ray.dx, ray.y + t * ray.dy, ray.z + t * ray.dz
    normal = nx * per_length, ny * per_length, nz * per_length
    if not (
        _inside_edge((ax, ay, az), (ux, uy, uz), normal, point)
        and _inside_edge((bx, by, bz), (cx - bx, cy - by, cz - bz), normal, point)
        and _inside_edge((cx, cy, cz), (-vx, -vy, -vz), normal, point)
    ):
        return -1.0, 0.0, 0.0, 0.0, 0.0
    nx, ny, nz = normal
    return t, nx, ny, nz, nx * ax + ny * ay + nz * az


_Vector = tuple[float, float, float]


@inlined
def _inside_edge(start: _Vector, along: _Vector, normal: _Vector, point: _Vector) -> bool:
    """Whether a point is on the inner side of an edge, or within :data:`_ON_TRIANGLE_M` of it."""
    ex, ey, ez = along
    qx, qy, qz = point[0] - start[0], point[1] - start[1], point[2] - start[2]
    side = normal[0] * (ey * qz - ez * qy) + normal[1] * (ez * qx - ex * qz) + normal[2] * (ex * qy - ey * qx)
    return side >= 0 or side * side <= _ON_TRIANGLE_M**2 * (ex * ex + ey * ey + ez * ez)
