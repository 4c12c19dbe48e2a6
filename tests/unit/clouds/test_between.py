"""Heights between points of a cloud."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from p2wss.clouds.crops import between
from p2wss.clouds.reading import Cloud

PLACES_M = np.array([[2.0, 3.0], [4.0, 3.0]])


def height_m(xy_m: list[list[float]]) -> float:
    """Between points of the plane z = 5 + x / 10, at two places around x = 3."""
    x, y = np.array(xy_m, float).T
    cloud = Cloud(x, y, 5 + x / 10, np.full(len(x), 2, np.uint8), pyproj.CRS("EPSG:2154"))
    return between(cloud, np.arange(len(x)), PLACES_M)


def test_on_the_triangles_between_points() -> None:
    around = [[0, 0], [9, 0], [9, 9], [0, 9], [4, 4]]
    assert height_m(around) == pytest.approx(5.3)
    # the second place is outside
    assert height_m([[0, 0], [3, 0], [3, 9], [0, 9]]) == pytest.approx(5.2)


def test_outside_or_without_triangles_the_nearest_point() -> None:
    assert height_m([[20, 0], [29, 0], [29, 9], [20, 9]]) == pytest.approx(7)
    assert height_m([[1, 9], [1, 8], [1, 7]]) == pytest.approx(5.1)
