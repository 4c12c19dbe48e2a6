"""A cloud in cells on disk gives the points around places, in their order, with classes that depend on nothing else."""

from __future__ import annotations

import errno
import os
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
import shapely

from p2wss.clouds.reading import Cloud
from p2wss.reconstruction.points import plausibility
from p2wss.reconstruction.points.cloud_index import CELL_M, CloudIndex
from p2wss.storage import temporary
from p2wss.storage.features import Features
from p2wss.storage.messages import InputError

NAMES = ("x_m", "y_m", "z_m", "classification", "day")


def cloud_of(num_points: int, size_m: float, seed: int = 0) -> Cloud:
    """Ground with a box of 20 m in the middle of each square of 128 m, around (0, 0)."""
    draw = np.random.default_rng(seed)
    x, y = draw.uniform(-size_m / 2, size_m / 2, (2, num_points))
    on_roof = (np.abs(x % 128 - 64) < 10) & (np.abs(y % 128 - 64) < 10)
    z = np.where(on_roof, 16.0, 10.0) + draw.normal(0, 0.02, num_points)
    numbers = np.arange(num_points)
    classes = np.where(on_roof, 6, 2).astype(np.uint8)
    return Cloud(x, y, z, classes, None, (numbers // 7).astype(np.uint16))


def chunks(cloud: Cloud, size: int) -> Iterator[Cloud]:
    for first in range(0, len(cloud), size):
        rows = slice(first, first + size)
        yield Cloud(**{name: getattr(cloud, name)[rows] for name in NAMES}, crs=None)


def index_of(cloud: Cloud, boxes: np.ndarray, folder: Path, size: int = 700) -> CloudIndex:
    result = CloudIndex(boxes, folder)
    for chunk in chunks(cloud, size):
        result.append(chunk)
    return result


def test_all_points_of_the_cells_in_the_order_of_these(tmp_path: Path) -> None:
    cloud = cloud_of(20_000, 600)
    boxes = np.array([[-70.0, -10, 20, 40], [150, 100, 160, 130]])
    with index_of(cloud, boxes, tmp_path) as points:
        near = points.near(boxes)
        assert points.count(boxes) == len(near) < points.num_points < len(cloud)
        x_min, y_min, x_max, y_max = points.bounds
    column, row = np.floor(cloud.x_m / CELL_M), np.floor(cloud.y_m / CELL_M)
    expected = ((column >= -2) & (column <= 0) & (row >= -1) & (row <= 0)) | (
        (column == 2) & (row >= 1) & (row <= 2)
    )
    order = np.lexsort([column[expected], row[expected]])
    for name in NAMES:
        values = getattr(cloud, name)
        assert np.array_equal(getattr(near, name), values[expected][order])
        assert getattr(near, name).dtype == values.dtype
    assert x_min <= -70 and y_min <= -10 and x_max >= 160 and y_max >= 130


def test_classes_do_not_depend_on_the_rest_of_the_cloud(tmp_path: Path) -> None:
    """Nor on other boxes, nor on chunks; the producer's classes stay where they are."""
    cloud = cloud_of(600_000, 640)
    truth = cloud.classification
    # the producer classified the west
    is_west = cloud.x_m < -64
    cloud = replace(cloud, classification=np.where(is_west, truth, 1).astype(np.uint8))
    wide = np.array([[-250.0, -150, 250, 250]])
    small = np.array([[140.0, 140, 230, 230]])
    with index_of(cloud, wide, tmp_path, 50_000) as points, index_of(cloud, small, tmp_path, 7_000) as few:
        assert few.num_points < points.num_points / 3
        place = np.array([-240.0, -200.0, 192.0]), np.array([60.0, 60.0, 192.0])
        assert points.has_points(*place).all()
        for number in (2, 6):
            assert points.has_points(*place, number).tolist() == [True, True, False]
        everything = points.near(wide)
        part, alone = points.near(small), few.near(small)
    assert np.array_equal(part.classification, alone.classification)
    assert np.array_equal(part.x_m, alone.x_m)
    in_small = np.isin(everything.z_m, part.z_m)
    assert np.array_equal(everything.classification[in_small], part.classification)
    roof = part.z_m > 13
    assert (part.classification[roof] == 6).mean() > 0.9 and (part.classification[~roof] == 2).mean() > 0.99
    west = everything.x_m < -64
    assert np.array_equal(everything.classification[west], np.where(everything.z_m[west] > 13, 6, 2))


def test_classes_that_are_complete_are_not_touched(tmp_path: Path) -> None:
    cloud = replace(cloud_of(5_000, 200), classification=np.full(5_000, 3, np.uint8))
    boxes = np.array([[-100.0, -100, 100, 100]])
    with CloudIndex(boxes, tmp_path, adds_classes=False) as points:
        points.append(cloud)
        assert (points.near(boxes).classification == 3).all()


def test_nothing_to_read(tmp_path: Path) -> None:
    nowhere = np.array([[np.nan] * 4, [np.inf] * 4])
    with index_of(cloud_of(100, 100), nowhere, tmp_path) as points:
        assert len(points.near(nowhere)) == 0 and points.num_points == 0 and points.count(nowhere) == 0
        assert points.bounds == (0, 0, 0, 0)
        assert points.has_points(np.array([0.0, np.nan]), np.zeros(2)).tolist() == [False, False]
    with CloudIndex(np.array([[0.0, 0, 1, 1]]), tmp_path) as points:
        assert len(points.near(np.array([[0.0, 0, 1, 1]]))) == 0


def test_memory_is_that_of_the_points_wherever_they_and_the_boxes_are(tmp_path: Path) -> None:
    """A box of a country, houses 1,000 km apart: not a cell for what has no point."""
    near = cloud_of(2_000, 300)
    far = replace(near, x_m=near.x_m + 1e6, y_m=near.y_m + 7e5)
    country = np.array([[-1e7, -1e7, 1e7, 1e7]])
    tracemalloc.start()
    with index_of(near, country, tmp_path) as points:
        for chunk in chunks(far, 700):
            points.append(chunk)
        assert points.num_points == points.count(country) == len(points.near(country)) == 4_000
        assert (
            points.count(country / 1e4) == 2_000 and not points.has_points(np.zeros(1), np.array([1e5])).any()
        )
        assert points.bounds[0] <= -1e7 and len(points.places_m) < 100
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


def test_the_file_has_no_name_and_a_full_disk_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    boxes = np.array([[-50.0, -50, 50, 50]])
    with index_of(cloud_of(100, 100), boxes, tmp_path) as points:
        assert points.num_points == 100 and os.listdir(tmp_path) == []
    with pytest.raises(InputError, match="no_folder: temporary file of points, 35 bytes each"):
        CloudIndex(boxes, tmp_path / "no_folder")

    class Full:
        def seek(self, place: int) -> None: ...

        def flush(self) -> None: ...

        def close(self) -> None: ...

        def write(self, content: memoryview) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(temporary.tempfile, "TemporaryFile", lambda **options: Full())
    with pytest.raises(InputError, match="35 bytes each: not written: No space left on device"):
        index_of(cloud_of(100, 100), boxes, tmp_path)


def test_a_look_at_heights_is_the_same_together_and_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shapes = [shapely.box(x - 10, y - 10, x + 10, y + 10) for x in (-64, 64) for y in (-64, 64)]
    middle_m = np.array([[shape.centroid.x, shape.centroid.y] for shape in shapes])
    columns = {"centre_x_m": middle_m[:, 0], "centre_y_m": middle_m[:, 1]}
    features = Features(np.array(shapes, object), columns, pyproj.CRS(2154))
    cloud = cloud_of(60_000, 250)
    samples = []
    for together in (len(cloud), 0):
        monkeypatch.setattr(plausibility, "RULES", replace(plausibility.RULES, together=together))
        with index_of(cloud, shapely.bounds(shapes) + np.array([-70, -70, 70, 70]), tmp_path) as points:
            samples.append(plausibility.sample_of(features, points, None))
    for name, values in vars(samples[0]).items():
        assert np.array_equal(values, vars(samples[1])[name], equal_nan=True)
    assert (
        samples[0].height_m == pytest.approx(np.full(4, 6.0), abs=0.05)
        and (samples[0].num_points > 100).all()
    )
