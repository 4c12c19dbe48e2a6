from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from p2wss.skeleton.nearest import _grid, nearest


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize(("num_points", "count"), [(1, 1), (7, 7), (400, 1), (400, 12)])
def test_the_points_that_a_tree_finds(dimensions: int, num_points: int, count: int) -> None:
    draw = np.random.default_rng(0)
    point_m = draw.uniform(0, 20, (num_points, dimensions))
    # far outside the points, too, and on a line of them
    for places in (point_m, draw.uniform(-40, 60, (100, dimensions))):
        for points in (point_m, point_m * np.eye(dimensions)[0]):
            distance_m, number = nearest(points, places, count)
            expected_m, _ = cKDTree(points).query(places, [*range(1, count + 1)])
            np.testing.assert_allclose(distance_m, expected_m, atol=1e-12)
            at_m = np.linalg.norm(points[number] - places[:, None], axis=2)
            np.testing.assert_allclose(at_m, distance_m, atol=1e-12)
            assert all(len(set(each)) == count for each in number.tolist())


def test_of_equally_near_points_the_first() -> None:
    corner_m = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])
    assert nearest(np.vstack([corner_m, corner_m]), np.ones((1, 2)), 8)[1].tolist() == [[*range(8)]]


def test_no_more_points_than_there_are() -> None:
    assert nearest(np.zeros((2, 3)), np.zeros((1, 3)), 3)[0].tolist() == [[0, 0, np.inf]]


@pytest.mark.parametrize("dimensions", [2, 3])
def test_patches_far_apart_are_cells_of_their_own(dimensions: int) -> None:
    """A grid of equal cells would have all points of a patch in one."""
    draw = np.random.default_rng(0)
    point_m = draw.uniform(0, 20, (2000, dimensions)).round(1)
    point_m[::2, 0] += 1e6
    point_m[0] = 3e6
    places = np.vstack(
        [point_m, draw.uniform(-40, 60, (100, dimensions)), draw.uniform(-5e6, 5e6, (100, dimensions))]
    )
    square_m2 = ((places[:, None] - point_m) ** 2).sum(axis=2)
    for count in (1, 12):
        distance_m, _ = nearest(point_m, places, count)
        np.testing.assert_allclose(
            distance_m, np.sqrt(np.sort(square_m2, axis=1)[:, :count]), rtol=1e-9, atol=1e-9
        )
    local_m = np.zeros((len(point_m), 3))
    local_m[:, :2] = (point_m - point_m.min(axis=0))[:, :2]
    assert np.diff(_grid(local_m)[3]).max() <= 2 * len(point_m) ** 0.5
