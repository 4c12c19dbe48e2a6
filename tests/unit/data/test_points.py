"""Which points are on a building, and the ground that its heights are above."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from p2wss.clouds.crops import crop_cloud
from p2wss.clouds.reading import Cloud
from p2wss.data import polygon_arrays
from p2wss.data.points import on_millimetres, points_on_building, points_on_buildings

BOX = shapely.box(0, 0, 10, 8)


def mask(classes: list[int], height_m: list[float], x_m: float = 5.0) -> list[bool]:
    point_m = np.column_stack([np.full((len(classes), 2), [x_m, 4.0]), np.array(height_m)])
    return points_on_building(BOX, point_m, np.array(classes, np.uint8)).tolist()


def test_class_6_decides_where_there_are_five_such_points() -> None:
    # whatever their height, and whatever else is there
    assert mask([6] * 5 + [1, 5, 2], [0.5] * 5 + [6, 6, 6]) == [True] * 5 + [False] * 3
    assert mask([6] * 10, [6] * 10, x_m=10.5) == [False] * 10, "in the ring around the footprint"


def test_a_missed_building_is_what_is_high_and_may_be_one() -> None:
    # ground, low noise, water, high noise and what is below 2 m are not on it; four of class 6 are, if high
    classes = [6] * 4 + [0, 3, 5, 2, 7, 9, 18, 1]
    height = [6.0] * 3 + [1.0] + [6.0] * 7 + [1.9]
    assert mask(classes, height) == [True] * 3 + [False] + [True] * 3 + [False] * 5
    # plants are not, where there are five others
    assert mask([6] * 4 + [1, 5], [6] * 6) == [True] * 5 + [False]
    # a neighbour's eave over the roof that the classifier has missed
    assert mask([6] * 12 + [1] * 60 + [5], [6] * 73) == [True] * 72 + [False]
    assert mask([6] * 12 + [1] * 40, [6] * 52) == [True] * 12 + [False] * 40
    # nothing high: the few of class 6 after all
    assert mask([6, 1, 2], [1, 1, 0]) == [True, False, False]
    assert mask([1, 2], [1, 0]) == [False, False] and mask([], []) == []


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_many_buildings_at_once_are_each_on_its_own(seed: int) -> None:
    draw = np.random.default_rng(seed)
    counts = draw.integers(0, 40, 12)
    offset = np.concatenate([[0], np.cumsum(counts)])
    xy = draw.uniform(-1, 11, (offset[-1], 2))
    height = draw.choice([0.0, 1.9, 2.0, 6.0], offset[-1])
    classes = draw.choice(np.array([1, 2, 5, 6, 7, 9], np.uint8), offset[-1])
    together = points_on_buildings(shapely.contains_xy(BOX, *xy.T), classes, height, offset)
    for b in range(len(counts)):
        rows = slice(offset[b], offset[b + 1])
        point_m = np.column_stack([xy[rows], height[rows]])
        assert np.array_equal(together[rows], points_on_building(BOX, point_m, classes[rows]))


def test_without_ground_within_reach_it_is_a_low_quantile_of_the_points() -> None:
    far = np.array([500.0])
    z = np.append(np.arange(101.0), far)
    classes = np.append(np.full(101, 6), 2).astype(np.uint8)
    cloud = Cloud(np.append(np.full(101, 5.0), far), np.append(np.full(101, 4.0), far), z, classes, None)
    shapes = [BOX, shapely.box(900, 900, 910, 910)]
    cropped = crop_cloud(cloud, polygon_arrays.to_polygons(shapes))
    assert cropped.ground_z_m[0] == pytest.approx(2)
    assert np.isnan(cropped.ground_z_m[1]), "a building without points"


def test_points_in_centimetres_are_the_same_to_the_bit_as_out_of_a_crop() -> None:
    draw = np.random.default_rng(2)
    origin = np.array([652100.0, 6861200.0])
    point_cm = draw.integers(-32767, 32768, (1000, 3))
    xyz_m = point_cm * 0.01 + [*origin, 140.0]
    expected_cm = np.column_stack([point_cm[:, :2], point_cm[:, 2] + 14000])
    assert np.array_equal(on_millimetres(xyz_m, origin), expected_cm / 100)
    fine = on_millimetres(xyz_m + 0.0042, origin)
    assert np.abs(fine - 0.0042 - (xyz_m - [*origin, 0])).max() < 0.00051
    assert on_millimetres(np.zeros((0, 3)), origin).shape == (0, 3)
