"""Points of several files are used once, whatever the files' offsets; equal points of one file stay."""

from __future__ import annotations

import logging
from pathlib import Path

import laspy
import numpy as np
import pytest

from p2wss.clouds.reading import list_clouds, read_clouds, read_headers, read_in_chunks
from p2wss.reconstruction.points.cloud_index import CELL_M, CloudIndex

# on the border of cells of the index; a little less with the offset of the second file, by the last bits
BORDER_M = 985 * CELL_M


def written(path: Path, xyz_m: np.ndarray, offset_m: float) -> Path:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.full(3, offset_m)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = xyz_m.T
    cloud.write(path)
    return path


@pytest.fixture
def files(tmp_path: Path) -> tuple[list[Path], int]:
    """Three tiles of which the second repeats a half of the first, and the number of different points."""
    draw = np.random.default_rng(0)
    low = np.array([BORDER_M - 40, 447_000, 0])
    first = (low + draw.uniform(0, [80, 80, 9], (4000, 3))).round(3)
    first[:40, 0] = BORDER_M
    first[50:60] = first[60:70]
    second = np.concatenate([first[:2000], (low + draw.uniform(0, [80, 80, 9], (500, 3))).round(3)])
    third = (low + np.array([80.5, 0, 0]) + draw.uniform(0, [80, 80, 9], (300, 3))).round(3)
    paths = [
        written(tmp_path / f"{name}.laz", xyz_m, offset_m)
        for name, xyz_m, offset_m in (("a", first, 0), ("b", second, 74_074.29), ("c", third, 17.5))
    ]
    return paths, 4000 + 500 + 300


def test_points_of_two_files_are_used_once(
    files: tuple[list[Path], int], caplog: pytest.LogCaptureFixture
) -> None:
    paths, num_different = files
    with caplog.at_level(logging.INFO):
        cloud = read_clouds(paths)
    assert len(cloud) == num_different
    assert f"2,000 points of {paths[1]} are in {paths[0]}, too: used once" in caplog.text
    alone = read_clouds(paths[:1])
    assert np.array_equal(cloud.x_m[:4000], alone.x_m) and np.array_equal(cloud.z_m[:4000], alone.z_m)


def test_and_in_the_index_in_any_order(
    files: tuple[list[Path], int], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    paths, num_different = files
    box = np.array([[BORDER_M - 50, 446_990, BORDER_M + 140, 447_090]])
    for order in (paths, paths[::-1]):
        with CloudIndex(box, tmp_path) as points, caplog.at_level(logging.INFO):
            for chunk in read_in_chunks(order):
                points.append(chunk)
            points.drop_repeated()
            near = points.near(box, adds_classes=False)
            assert points.num_points == points.count(box) == len(near) == num_different
        assert caplog.text.count("2,000 points") == 1
        caplog.clear()


def test_neighbours_that_touch_and_a_file_named_twice(
    files: tuple[list[Path], int], caplog: pytest.LogCaptureFixture
) -> None:
    (first, _, third), _ = files
    with caplog.at_level(logging.INFO):
        assert len(read_clouds(list_clouds([first, third, first]))) == 4300
    assert not caplog.text


def test_a_copy_with_coarser_coordinates_is_told(files: tuple[list[Path], int], tmp_path: Path) -> None:
    paths, _ = files
    las = laspy.read(paths[0])
    copies = []
    for scale in (0.001, 0.01):
        las.change_scaling(scales=np.full(3, scale), offsets=np.full(3, 30.0))
        copies.append(tmp_path / f"{scale}.laz")
        las.write(copies[-1])
    *others, coarse = read_headers([*paths, *copies])
    (doubt,) = coarse.doubts
    assert f"as many points as {paths[0]}" in doubt and not any(each.doubts for each in others)
