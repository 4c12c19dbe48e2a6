"""Rays against terrain: the oracle tests every triangle with Möller and Trumbore's formula."""

import numpy as np
import pytest

from p2wss.scans.terrain import Ray, crossing, local_grid


def first_crossing(grid, ray, limit):
    return crossing(grid, grid.height_m, grid.highest_m, ray, limit)


def triangles_of(grid):
    """Corners of all triangles, float64 (t, 3, 3): two per square, cut from north-west to south-east."""
    h = grid.height_m.astype(float)
    rows, columns = h.shape
    x = np.broadcast_to(grid.x_min_m + np.arange(columns) * grid.cell_m, h.shape)
    y = np.broadcast_to((grid.y_max_m - np.arange(rows) * grid.cell_m)[:, None], h.shape)
    p = np.stack([x, y, h], axis=-1)
    nw, ne, sw, se = p[:-1, :-1], p[:-1, 1:], p[1:, :-1], p[1:, 1:]
    both = np.concatenate([np.stack([nw, sw, se], -2), np.stack([nw, se, ne], -2)]).reshape(-1, 3, 3)
    return both[~np.isnan(both).any(axis=(1, 2))]


def nearest_hit(triangles, origin, direction):
    """Distance along the ray to the first triangle, -1 for none."""
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(direction, e2)
    det = (e1 * p).sum(1)
    s = origin - a
    u = (s * p).sum(1) / det
    q = np.cross(s, e1)
    v = q @ direction / det
    t = (e2 * q).sum(1) / det
    good = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 0)
    return t[good].min() if good.any() else -1.0


@pytest.mark.parametrize("rough_m", [0.3, 4.0])
def test_first_crossing_is_that_of_all_triangles(rough_m):
    rng = np.random.default_rng(1)
    height = rng.normal(100, rough_m, (37, 29)).astype(np.float32)
    height[12:15, 7:9] = np.nan
    grid = local_grid(height, 500.0, 900.0, 2.0, np.array([520.0, 870.0, 100.0]))
    triangles = triangles_of(grid)
    hits = 0
    for _ in range(800):
        origin = np.array([*rng.uniform(-40, 60, 2), 30.0])
        angle, turn = np.radians(rng.choice([0, 15, 30, 60])), rng.choice([0, np.pi / 2, rng.uniform(0, 7)])
        direction = np.array(
            [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), -np.cos(angle)], np.float64
        )
        expected = nearest_hit(triangles, origin, direction)
        distance, east, north = first_crossing(grid, Ray(*origin, *direction), np.inf)
        if expected < 0:
            assert distance < 0
            continue
        hits += 1
        assert distance == pytest.approx(expected, abs=1e-6)
        # the slope is that of the plane: a step along it stays on the surface's triangle
        normal = np.array([-east, -north, 1.0])
        point = origin + distance * direction
        on_plane = np.abs((triangles[:, 0] - point) @ normal).min()
        assert on_plane < 1e-6
        assert first_crossing(grid, Ray(*origin, *direction), distance - 0.01)[0] < 0
    assert hits > 200


def test_rays_over_many_blocks_have_the_same_crossing():
    # a hill in rolling ground: slanted rays pass several regions of 64 squares, steep ones stay in a square
    rng = np.random.default_rng(2)
    v, u = np.mgrid[:150, :200]
    height = 3 * np.sin(u / 20) * np.cos(v / 15) + 40 * np.exp(-((u - 110) ** 2 + (v - 70) ** 2) / 800)
    height = (height + rng.normal(0, 0.03, height.shape)).astype(np.float32)
    height[100:104, 30:34] = np.nan
    grid = local_grid(height, 0.0, 150.0, 1.0, np.zeros(3))
    triangles = triangles_of(grid)
    hits = 0
    for angle_deg in (2, 20, 45, 75):
        for _ in range(12):
            origin = np.array([*rng.uniform(0, 200, 1), *rng.uniform(0, 150, 1), 60.0])
            turn, angle = rng.uniform(0, 7), np.radians(angle_deg)
            direction = np.array([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), -np.cos(angle)])
            expected = nearest_hit(triangles, origin, direction)
            assert first_crossing(grid, Ray(*origin, *direction), np.inf)[0] == pytest.approx(
                expected, abs=1e-6
            )
            hits += expected > 0
    assert hits > 25


def test_no_terrain_where_there_is_no_data():
    height = np.full((10, 10), 5.0, np.float32)
    height[5, 5] = np.nan
    grid = local_grid(height, 0.0, 10.0, 1.0, np.zeros(3))

    def has_terrain(x, y):
        return first_crossing(grid, Ray(x, y, 20.0, 0.0, 0.0, -1.0), np.inf)[0] > 0

    assert has_terrain(3.2, 4.1)
    assert not has_terrain(
        5.4, 4.6
    )  # the missing centre is at (5.5, 4.5): all six triangles around it are gone
    assert has_terrain(4.8, 3.7) and not has_terrain(6.2, 4.2)
    assert not has_terrain(0.2, 5.0)  # beyond the outermost centres there is no triangle
