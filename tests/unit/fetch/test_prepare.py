"""Real clouds are cropped to a tile and its margin, without the points of neighbours."""

from __future__ import annotations

import laspy
import numpy as np

from p2wss.fetch.cloud import write_cloud
from p2wss.storage import integrity

TILE = (652000.0, 6861000.0, 653000.0, 6862000.0)
AROUND = (651900.0, 6860900.0, 653100.0, 6862100.0)
EAST = (653000.0, 6861000.0, 654000.0, 6862000.0)


def scatter(number: int, bounds: tuple[float, ...], seed: int = 0) -> np.ndarray:
    x_min, y_min, x_max, y_max = bounds
    return np.round(
        np.random.default_rng(seed).uniform((x_min, y_min, 40), (x_max, y_max, 60), (number, 3)), 3
    )


def rows(points: np.ndarray) -> list[tuple[int, ...]]:
    return sorted(map(tuple, np.round(np.asarray(points) * 1000).astype(np.int64).tolist()))


def test_a_classified_tile_is_linked_unchanged(write_points, tmp_path):
    cloud = write_points("0652_6862.laz", scatter(1000, TILE), 2)
    integrity.seal(cloud)  # as the stage fetch does
    out = tmp_path / "out" / "0652_6862.laz"
    assert write_cloud(out, [cloud], AROUND, "EPSG:2154", link=True) == 1000
    assert out.samefile(cloud), "no second copy of some hundred megabytes"


def test_points_of_a_neighbouring_tile_are_not_written(write_points, tmp_path):
    """A file that extends beyond its tile: points in the margin are written, except those of the neighbour."""
    points = scatter(5000, (651500, 6861000, 653500, 6862000))
    cloud = write_points("0652_6862.laz", points, 2)
    out = tmp_path / "out.laz"
    write_cloud(out, [cloud], AROUND, "EPSG:2154", [EAST], link=True)
    x = points[:, 0]
    assert rows(laspy.read(out).xyz) == rows(points[(x >= 651900) & (x < 653000)])
