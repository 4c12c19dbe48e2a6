"""Points on a triangle mesh: uniform samples, exact distances to it, and the triangle over or below each."""

import numpy as np

from p2wss.skeleton.compiled import entry

_TINY = float(np.finfo(float).tiny)


def sample_surface(
    vertex_m: np.ndarray, triangle: np.ndarray, num_samples: int, generator: np.random.Generator
) -> np.ndarray:
    """Points drawn uniformly by area over the triangles: float64 (num_samples, 3), or (0, 3) without area.

    vertex_m (v, 3), triangle (t, 3). The same generator state gives the same points.
    """
    import trimesh.sample  # takes longer to import than the rest of the room

    mesh = trimesh.Trimesh(np.asarray(vertex_m, float), np.asarray(triangle, int), process=False)
    if not mesh.area > 0:
        return np.zeros((0, 3))
    return np.asarray(trimesh.sample.sample_surface(mesh, num_samples, seed=generator)[0], float)


def distance_to_mesh(point_m: np.ndarray, vertex_m: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Exact distance of each point to the nearest triangle, metres. point_m (n, 3) -> (n,); inf without triangles.

    The nearest place of a triangle is the projection of the point if the projection is inside; otherwise it is on an
    edge.
    """
    corner_m = np.asarray(vertex_m, float)[np.asarray(triangle, int)]
    return np.sqrt(_squared_distances(np.ascontiguousarray(point_m, float), corner_m))


@entry
def _squared_distances(point_m: np.ndarray, corner_m: np.ndarray) -> np.ndarray:
    nearest, edge, inward = np.full(len(point_m), np.inf), np.empty((3, 3)), np.empty((3, 3))
    for corner in corner_m:
        for k in range(3):
            edge[k] = corner[(k + 1) % 3] - corner[k]
        normal = np.cross(edge[0], edge[1])
        # the normal of a triangle without area is NaN, so that no point is inside
        normal /= np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        for k in range(3):
            inward[k] = np.cross(normal, edge[k])
        (a, b, c), (d, e, f) = corner[:, 0], corner[:, 1]
        low_x, high_x, low_y, high_y = min(a, b, c), max(a, b, c), min(d, e, f), max(d, e, f)
        for i in range(len(point_m)):
            x, y, z = point_m[i, 0] - corner[0, 0], point_m[i, 1] - corner[0, 1], point_m[i, 2] - corner[0, 2]
            height = x * normal[0] + y * normal[1] + z * normal[2]
            x, y = point_m[i, 0], point_m[i, 1]
            x, y = max(low_x - x, x - high_x, 0.0), max(low_y - y, y - high_y, 0.0)
            # no part of the triangle is nearer than its plane, or than the rectangle around it
            if max(height**2, x * x + y * y) >= nearest[i]:
                continue
            is_inside = True
            for k in range(3):
                x, y, z = (
                    point_m[i, 0] - corner[k, 0],
                    point_m[i, 1] - corner[k, 1],
                    point_m[i, 2] - corner[k, 2],
                )
                u, v, w = edge[k]
                # an edge without length is its start
                share = (x * u + y * v + z * w) / max(u * u + v * v + w * w, _TINY)
                share = min(max(share, 0.0), 1.0)
                squared = (x - share * u) ** 2 + (y - share * v) ** 2 + (z - share * w) ** 2
                nearest[i] = min(nearest[i], squared)
                is_inside &= x * inward[k, 0] + y * inward[k, 1] + z * inward[k, 2] >= 0.0
            if is_inside:
                nearest[i] = min(nearest[i], height**2)
    return nearest


@entry
def topmost(corner_m: np.ndarray, point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
