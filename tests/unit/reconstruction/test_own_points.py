"""Whose points are these, where is the ground, why is a building not represented: on points whose answer is known."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import geopandas as gpd
import numpy as np
import pytest
import shapely

from p2wss.clouds.crops import crop_cloud
from p2wss.clouds.reading import Cloud
from p2wss.config import Reconstruct
from p2wss.data import polygon_arrays
from p2wss.data.las_classes import (
    BUILDING_CLASS,
    GROUND_CLASS,
    NEIGHBOUR_CLASS,
    OVERLAP_CLASS,
    UNCLASSIFIED_CLASS,
    VEGETATION_CLASS,
)
from p2wss.data.terrain import Terrain
from p2wss.fit.points import shaft_points
from p2wss.mesh.surface import distance_to_mesh
from p2wss.reconstruction.pipeline import Rows
from p2wss.reconstruction.points.ground import ground_of
from p2wss.reconstruction.points.own_points import own_classes
from p2wss.reconstruction.result import Result
from p2wss.storage.features import Features

RING = np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 10.0], [0.0, 10.0]])


def grid(low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
    x, y = np.meshgrid(*(np.arange(a + 0.12, b, 0.25) for a, b in zip(low, high, strict=True)))
    return np.column_stack([x.ravel(), y.ravel()])


def surface(z_of_x: dict[tuple[float, float], float], slope: float = 0.0) -> np.ndarray:
    """Points from x = -1 to 9; heights at x = 0 by ranges of x."""
    xy = grid((-1, 0), (9, 10))
    z = np.full(len(xy), np.nan)
    for (low, high), height in z_of_x.items():
        here = (xy[:, 0] >= low) & (xy[:, 0] < high)
        z[here] = height + slope * xy[here, 1]
    return np.column_stack([xy, z])


@pytest.mark.parametrize("own_z, other_z", [(3.0, 15.0), (15.0, 3.0)])
def test_the_roof_over_the_border_is_the_neighbours_from_either_side(own_z: float, other_z: float) -> None:
    """The border is at x = 8; the other building's roof reaches half a metre over it."""
    point_m = surface({(-1, 7.5): own_z, (7.5, 9): other_z}, slope=0.3)
    classes = np.full(len(point_m), BUILDING_CLASS, np.uint8)
    found = own_classes([RING], point_m, classes)
    theirs = (point_m[:, 0] > 7.5) & (point_m[:, 0] < 8)
    assert (found[theirs] == NEIGHBOUR_CLASS).mean() > 0.95 and (found[~theirs] == BUILDING_CLASS).all()
    assert (classes == BUILDING_CLASS).all()


def test_points_of_overlapping_flights_are_of_the_roof_where_the_other_flight_has_it() -> None:
    """A crown stands over a corner of the roof; two of three points have the class of overlapping flights."""
    point_m, draw = surface({(-1, 9): 5.0}, slope=0.3), np.random.default_rng(0)
    is_crown = (point_m[:, 0] > 6) & (point_m[:, 1] > 8)
    point_m[is_crown, 2] += draw.uniform(3, 6, np.count_nonzero(is_crown))
    true = np.where(is_crown, VEGETATION_CLASS, BUILDING_CLASS).astype(np.uint8)
    is_overlap = draw.random(len(point_m)) < 2 / 3
    found = own_classes([RING], point_m, np.where(is_overlap, OVERLAP_CLASS, true).astype(np.uint8))
    inside = (point_m[:, 0] > 0) & (point_m[:, 0] < 8)
    roof, crown = inside & is_overlap & ~is_crown, inside & is_overlap & is_crown
    assert (found[roof] == BUILDING_CLASS).mean() > 0.98 and not (found[crown] == BUILDING_CLASS).any()
    assert (found[~is_overlap] == true[~is_overlap]).all()


def test_a_roof_that_the_producer_took_for_trees_is_one_and_a_crown_over_it_is_none() -> None:
    """Some points at the eaves have the class of buildings."""
    point_m, draw = surface({(-1, 9): 5.0}, slope=0.3), np.random.default_rng(0)
    inside = (point_m[:, 0] > 0) & (point_m[:, 0] < 8)
    classes = np.where(np.arange(len(point_m)) % 40, VEGETATION_CLASS, BUILDING_CLASS).astype(np.uint8)
    found = own_classes([RING], point_m, classes)
    assert (found[inside] == BUILDING_CLASS).mean() > 0.98 and (found[~inside] == classes[~inside]).all()
    crown_m = point_m + [[0, 0, 2]] * draw.uniform(0, 2, (len(point_m), 1))
    assert (own_classes([RING], crown_m, classes) == classes).all()
    # a few trees over a roof
    most = np.where(np.arange(len(point_m)) % 3, BUILDING_CLASS, VEGETATION_CLASS).astype(np.uint8)
    assert (own_classes([RING], point_m, most) == most).all()


@pytest.mark.parametrize("other", [UNCLASSIFIED_CLASS, VEGETATION_CLASS])
def test_a_part_of_the_roof_that_the_classifier_missed_is_roof_and_a_crown_is_not(other: int) -> None:
    point_m = surface({(-1, 9): 4.0}, slope=0.3)
    missed = point_m[:, 1] > 5
    classes = np.where(missed, other, BUILDING_CLASS).astype(np.uint8)
    deep = missed & (point_m[:, 1] > 6.6) & (point_m[:, 0] > 0) & (point_m[:, 0] < 8)
    found = own_classes([RING], point_m, classes)
    assert (found[deep] == BUILDING_CLASS).mean() > 0.95
    # what is beside class building may be an antenna, or a wire
    assert (found[missed & (point_m[:, 1] < 6)] == other).all()
    crown_m = point_m.copy()
    crown_m[missed, 2] += np.random.default_rng(4).uniform(0, 4, missed.sum())
    assert not (own_classes([RING], crown_m, classes)[missed] == BUILDING_CLASS).any()


def test_buildings_are_fitted_to_their_own_points() -> None:
    """Also by a second process. A roof of 15 m reaches half a metre over the border of a house of 3 m."""
    point_m = surface({(-1, 7.5): 3.0, (7.5, 9): 15.0})
    ground = np.array([[x, y, 0.0] for x in (-0.9, 8.9) for y in np.arange(-0.9, 11, 0.2)])
    x, y, z = np.vstack([point_m, ground]).T.copy()
    classes = np.repeat([BUILDING_CLASS, GROUND_CLASS], [len(point_m), len(ground)]).astype(np.uint8)
    house, far = shapely.Polygon(RING), shapely.box(30, 0, 38, 10)
    frame = gpd.GeoDataFrame(
        {"building_id": ["house", "far"], "status": "ok"}, geometry=[house, far], crs="EPSG:2154"
    )
    for num_processes in (1, 2):
        results: dict[int, Result] = {}
        rows = Rows(2, results, None, "t", Reconstruct(), num_processes=num_processes)
        rows.start(rows.prepared(np.arange(2), Features.of(frame), Cloud(x, y, z, classes, None)))
        rows.finish()
        assert results[0].reconstruction.mesh.vertex_m[:, 2].max() == pytest.approx(3.0, abs=0.05)
        sample_m, mesh = results[0].sample_m, results[0].reconstruction.mesh
        assert 100 < len(sample_m) <= 256
        assert sample_m[:, 3] == pytest.approx(
            distance_to_mesh(sample_m[:, :3].astype(float), mesh.vertex_m, mesh.triangle), abs=1e-5
        )


def test_a_roof_that_goes_on_beyond_the_border_stays_and_so_does_a_wide_body() -> None:
    for point_m in (surface({(-1, 9): 6.0}, slope=0.3), surface({(-1, 4): 3.0, (4, 9): 15.0})):
        classes = np.full(len(point_m), BUILDING_CLASS, np.uint8)
        assert (own_classes([RING], point_m, classes) == BUILDING_CLASS).all()


def test_returns_from_the_wall_of_the_neighbour() -> None:
    point_m = surface({(-1, 8): 3.0, (8, 9): 15.0})
    wall_m = np.random.default_rng(0).uniform((7.7, 1, 4.5), (7.9, 9, 14), (40, 3))
    classes = np.full(len(point_m) + 40, BUILDING_CLASS, np.uint8)
    found = own_classes([RING], np.vstack([point_m, wall_m]), classes)
    assert (found[-40:] == NEIGHBOUR_CLASS).all() and (found[:-40] == BUILDING_CLASS).all()


def test_returns_from_a_wall_along_a_line_of_the_scan_are_no_roof() -> None:
    """They form a steep plane, which is found in the strip alone."""
    point_m = surface({(-1, 8): 3.0, (8, 9): 15.0})
    y = np.linspace(1.5, 6.0, 40)
    line_m = np.column_stack([np.full(40, 7.8), y, 4.5 + 2 * (y - 1.5)])
    classes = np.full(len(point_m) + 40, BUILDING_CLASS, np.uint8)
    found = own_classes([RING], np.vstack([point_m, line_m]), classes)
    assert (found[-40:] == NEIGHBOUR_CLASS).mean() > 0.9 and (found[:-40] == BUILDING_CLASS).all()


def test_a_plane_that_goes_deep_at_one_end_is_the_buildings() -> None:
    """A gallery along the border, part of a wing: most of it is high above what is beside it."""
    point_m = surface({(-1, 7): 3.0, (7, 9): 6.0})
    point_m[(point_m[:, 0] > 4) & (point_m[:, 1] < 2.5), 2] = 6.0
    classes = np.full(len(point_m), BUILDING_CLASS, np.uint8)
    assert (own_classes([RING], point_m, classes) == BUILDING_CLASS).all()


def theirs(point_m: np.ndarray, classes: np.ndarray | None = None) -> np.ndarray:
    if classes is None:
        classes = np.full(len(point_m), BUILDING_CLASS, np.uint8)
    return own_classes([RING], point_m, classes) == NEIGHBOUR_CLASS


def test_a_roof_that_falls_towards_the_building_is_the_neighbours() -> None:
    """Half a metre within the border, it ends above the eave; further within, its plane would be below the roof."""
    point_m = surface({(-1, 9): 0.0})
    x = point_m[:, 0]
    point_m[:, 2] = np.where(x > 7.5, 6.3 + 0.9 * (x - 7.5), 5.0 + 0.9 * (7.5 - x))
    assert (theirs(point_m) == ((x > 7.5) & (x < 8))).all()


def test_what_is_far_above_a_narrow_shed_is_the_neighbours() -> None:
    """The shed is 2.2 m wide, and the roof beside it reaches 40 cm over the border."""
    point_m = surface({(-1, 7.6): 3.0, (7.6, 9): 15.0})
    shed = np.array([[5.8, 1.0], [8.0, 1.0], [8.0, 8.0], [5.8, 8.0]])
    classes = np.full(len(point_m), BUILDING_CLASS, np.uint8)
    inside = shapely.contains_xy(shapely.Polygon(shed), *point_m[:, :2].T)
    found = own_classes([shed], point_m, classes)[inside] == NEIGHBOUR_CLASS
    assert (found == (point_m[inside, 0] > 7.6)).all()


def test_a_roof_that_rises_from_the_level_of_the_building_is_the_neighbours_where_it_is_higher() -> None:
    point_m = surface({(-1, 9): 5.0})
    x, y = point_m[:, 0], point_m[:, 1]
    point_m[x > 7.5, 2] += 0.12 * y[x > 7.5]
    found, is_strip = theirs(point_m), (x > 7.5) & (x < 8)
    assert found[is_strip & (y > 6.5)].all() and not found[~is_strip | (y < 4)].any()


def test_a_low_level_at_the_border_is_the_buildings_where_the_neighbour_has_none_as_low() -> None:
    """No neighbour of 15 m shows what is below the roof of the building; one of 4 m does."""
    point_m = surface({(-1, 7.3): 9.0, (7.3, 8): 4.0, (8, 9): 15.0})
    assert not theirs(point_m).any()
    point_m[point_m[:, 2] > 10, 2] = 4.0
    assert (theirs(point_m) == ((point_m[:, 0] > 7.3) & (point_m[:, 0] < 8))).all()


def test_a_low_level_at_the_border_is_the_buildings_where_another_is_as_low_behind_a_high_wing() -> None:
    point_m = surface({(-1, 7.3): 9.0, (7.3, 8): 4.0, (8, 8.5): 15.0, (8.5, 9): 4.0})
    assert not theirs(point_m).any()


def test_a_falling_eave_above_a_level_roof_is_the_neighbours_though_points_are_few() -> None:
    """On the way to the next point of the roof, its plane would have fallen nearly to that."""
    x, y = np.random.default_rng(2).uniform((-1, 0), (9, 10), (200, 2)).T
    is_eave = x > 7.2
    point_m = np.column_stack([x, y, np.where(is_eave, 4.9 + 1.2 * (x - 7.2), 4.0)])
    found = theirs(point_m)
    assert found[is_eave & (x < 8)].mean() > 0.8 and not found[~is_eave].any()


def test_the_steep_eave_of_a_mansard_is_the_buildings() -> None:
    """It is no wider than the strip, but there is no step above it."""
    point_m = surface({(-1, 9): 0.0})
    x = point_m[:, 0]
    point_m[:, 2] = np.where(x > 7.1, 8.0 - 2.0 * (x - 7.1), 8.0 + 0.3 * (7.1 - x))
    point_m[x > 8, 2] = 6.2 + 2.0 * (x[x > 8] - 8)
    assert not theirs(point_m)[x < 7.8].any(), "but for points in the valley"


def test_a_roof_of_which_nothing_is_seen_beyond_the_border_is_the_neighbours() -> None:
    """Sheet metal sends little back."""
    point_m = surface({(-1, 7.5): 3.0, (7.5, 9): 15.0})
    point_m = point_m[point_m[:, 0] < 8]
    is_strip = point_m[:, 0] > 7.5
    assert (theirs(point_m) == is_strip).all()
    ground_m = np.column_stack([xy := grid((8, 0), (9, 10)), np.zeros(len(xy))])
    assert not theirs(np.vstack([point_m, ground_m])).any()


def test_a_roof_of_which_nothing_is_seen_beyond_the_border_ends_where_a_third_building_begins() -> None:
    point_m = surface({(-1, 7.5): 3.0, (7.5, 9): 15.0})
    third = (point_m[:, 0] > 8) & (point_m[:, 1] < 1.0)
    point_m[third, 2] = 9.0
    point_m = point_m[(point_m[:, 0] < 8) | third]
    assert (theirs(point_m) == ((point_m[:, 0] > 7.5) & (point_m[:, 0] < 8))).all()


def test_the_neighbours_roof_beside_one_that_the_classifier_has_missed() -> None:
    """Whether that has no class or class ground."""
    point_m = surface({(-1, 7.5): 3.0, (7.5, 9): 15.0})
    is_high = point_m[:, 2] > 4
    for missed in (UNCLASSIFIED_CLASS, GROUND_CLASS):
        classes = np.where(is_high, BUILDING_CLASS, missed).astype(np.uint8)
        assert (theirs(point_m, classes) == (is_high & (point_m[:, 0] < 8))).all()


def test_the_neighbours_roof_beside_one_that_is_hidden_by_plants() -> None:
    """Four points of the house are seen, none further within; the neighbour reaches half a metre over it."""
    point_m = surface({(7.5, 9): 15.0})
    point_m = point_m[np.isfinite(point_m[:, 2])]
    own_m = np.array([[0.3, 3, 3.0], [0.5, 7, 3.0], [7.2, 4, 3.0], [7.3, 6, 3.0]])
    found = theirs(np.vstack([own_m, point_m]))
    assert (found[4:] == (point_m[:, 0] < 8)).all() and not found[:4].any()


def test_a_point_of_the_neighbours_roof_is_the_neighbours_whatever_is_beside_it() -> None:
    """At a corner, returns from a wall to the street are nearer to it than that roof beyond the border."""
    point_m = surface({(-1, 7.7): 3.0, (7.7, 9): 15.0})
    beside = (point_m[:, 0] > 8) & (point_m[:, 1] < 1.5)
    street_m = point_m[beside] * [1, 1, 0] + [0, 0, 4.0]
    found = theirs(np.vstack([point_m[~beside], street_m]))
    kept_m = point_m[~beside]
    assert (found[: len(kept_m)] == ((kept_m[:, 0] > 7.7) & (kept_m[:, 0] < 8))).all()


def test_a_return_from_the_wall_at_a_corner_is_the_neighbours_though_the_street_is_nearer() -> None:
    point_m = surface({(-1, 7.9): 3.0, (7.9, 9): 15.0})[::3]
    is_street = (point_m[:, 0] > 8) & (point_m[:, 1] < 1.2)
    point_m[is_street, 2] = 0.1
    wall_m = np.array([[7.8, 0.1, 9.0]])
    assert theirs(np.vstack([point_m, wall_m]))[-1]


def test_a_gable_that_crosses_the_roof_of_the_building_is_the_neighbours() -> None:
    """It reaches a metre over the border; where the two cross, points further within are on both."""
    x, y = (xy := grid((-1, -1), (11, 14))).T
    above_m = np.where(x > 9, np.minimum(0.35 * (8 - y), 0.35 * (y - 3)), 0.0)
    noise_m = np.random.default_rng(0).normal(0, 0.03, len(xy))
    is_beside = (x < 0) | (y < 0) | (y > 13)
    z = np.where(is_beside, 0.0, 5 - 0.05 * y + np.maximum(above_m, 0) + noise_m)
    ring = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 13.0], [0.0, 13.0]])
    point_m, classes = np.column_stack([xy, z]), np.full(len(xy), BUILDING_CLASS, np.uint8)
    found = own_classes([ring], point_m, classes) == NEIGHBOUR_CLASS
    assert found[(x < 10) & (above_m > 0.75)].all() and not found[(x < 9) | (x > 10)].any()


def test_a_dormer_that_ends_a_little_beyond_the_border_is_the_buildings() -> None:
    """It crosses the roof, like a gable of the neighbour, but hardly anything of it is there."""
    x, y = (xy := grid((-1, -1), (11, 14))).T
    slope_z = 5 + 0.8 * (10 - x)
    is_dormer = (y > 4) & (y < 8) & (slope_z < 6) & (x < 10.4)
    is_beside = (x < 0) | (y < 0) | (y > 13) | (x > 10)
    noise_m = np.random.default_rng(0).normal(0, 0.03, len(xy))
    z = np.where(is_dormer, 6, np.where(is_beside, 0.0, slope_z)) + noise_m
    ring = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 13.0], [0.0, 13.0]])
    point_m, classes = np.column_stack([xy, z]), np.full(len(xy), BUILDING_CLASS, np.uint8)
    assert not (own_classes([ring], point_m, classes) == NEIGHBOUR_CLASS)[x < 10].any()


def test_the_roof_of_the_neighbour_is_told_by_a_step_of_half_a_metre() -> None:
    point_m = surface({(-1, 7.5): 3.0, (7.5, 9): 3.6})
    assert (theirs(point_m) == ((point_m[:, 0] > 7.5) & (point_m[:, 0] < 8))).all()


def test_the_end_of_a_low_level_beyond_the_border_is_no_neighbour() -> None:
    """A level of 4 m, 80 cm wide, reaches 30 cm over the border, beyond which is the ground."""
    point_m = surface({(-1, 7.2): 9.0, (7.2, 8.3): 4.0, (8.3, 9): 0.1})
    assert not theirs(point_m).any()


def test_class_ground_at_roof_height_is_roof_and_a_hillside_is_not() -> None:
    point_m = surface({(-1, 0): 0.0, (0, 8): 4.0, (8, 9): 0.0})
    classes = np.full(len(point_m), GROUND_CLASS, np.uint8)
    inside = (point_m[:, 0] > 0) & (point_m[:, 0] < 8)
    assert ((own_classes([RING], point_m, classes) == BUILDING_CLASS) == inside).all()
    hill_m = surface({(-1, 9): 0.0}, slope=0.5)
    assert (own_classes([RING], hill_m, classes) == GROUND_CLASS).all()


def cloud_of(roof_z: float, ground: np.ndarray, ground_class: int = GROUND_CLASS) -> Cloud:
    roof = np.column_stack([xy := grid((0, 0), (8, 10)), np.full(len(xy), roof_z)])
    x, y, z = np.vstack([roof, ground]).T.copy()
    classes = np.repeat([BUILDING_CLASS, ground_class], [len(roof), len(ground)]).astype(np.uint8)
    return Cloud(x, y, z, classes, None)


def test_the_ground_is_never_above_the_own_points() -> None:
    polygons = polygon_arrays.to_polygons(np.array([shapely.Polygon(RING)]))
    uphill = np.column_stack([xy := grid((-0.9, 0), (0, 10)), np.full(len(xy), 40.0)])
    downhill = np.column_stack([xy := grid((9, 0), (12, 10)), np.full(len(xy), 20.0)])
    terrain = Terrain(np.full((40, 40), 22.0, np.float32), -10.0, 30.0, 1.0)

    def found(cloud: Cloud, terrain: Terrain | None = None) -> tuple[float, str]:
        ground = ground_of(cloud, crop_cloud(cloud, polygons), polygons, terrain)
        assert np.isnan(ground.sd_m[0]) == (ground.source[0] == "around")
        return float(ground.z_m[0]), str(ground.source[0])

    assert found(cloud_of(45.0, uphill)) == (40.0, "around")
    assert found(cloud_of(28.0, np.vstack([uphill, downhill]))) == (20.0, "lowest-points")
    assert found(cloud_of(28.0, uphill), terrain) == (22.0, "terrain")
    assert found(cloud_of(28.0, uphill)) == (25.0, "storey")
    low = cloud_of(28.0, np.vstack([uphill, downhill]))
    is_low = low.z_m == 20.0
    low = replace(
        low, classification=np.where(is_low, UNCLASSIFIED_CLASS, low.classification).astype(np.uint8)
    )
    assert found(low) == (20.0, "lowest-points")


def test_without_any_ground_the_terrain_is_it_and_else_the_own_points_are() -> None:
    """As of a cloud of class building alone, which has points on a wall, too, down to 24 m."""
    polygons = polygon_arrays.to_polygons(np.array([shapely.Polygon(RING)]))
    cloud = cloud_of(28.0, np.column_stack([np.zeros(40), np.full(40, 5.0), np.linspace(24.0, 28.0, 40)]), 6)
    cropped = crop_cloud(cloud, polygons)
    terrain = Terrain(np.full((40, 40), 22.0, np.float32), -10.0, 30.0, 1.0)
    known, unknown = (ground_of(cloud, cropped, polygons, each) for each in (terrain, None))
    assert cropped.is_foot.all() and (known.z_m[0], known.source[0]) == (22.0, "terrain")
    assert unknown.source[0] == "own-points" and 24 < unknown.z_m[0] < 28 and unknown.sd_m[0] > 1
    ground = np.column_stack([xy := grid((9, 0), (12, 10)), np.full(len(xy), 20.0)])
    assert not crop_cloud(cloud_of(28.0, ground), polygons).is_foot.any()


def test_ground_of_points_without_class_alone_is_a_guess_and_the_terrain_is_better() -> None:
    """As of a cloud that was cut out along footprints: the lowest points around are on the eaves of neighbours."""
    polygons = polygon_arrays.to_polygons(np.array([shapely.Polygon(RING)]))
    eaves = np.column_stack([xy := grid((14, 0), (30, 10)), 38.0 + 0.05 * xy[:, 0]])
    cloud = cloud_of(45.0, eaves, UNCLASSIFIED_CLASS)
    cropped = crop_cloud(cloud, polygons)
    terrain = Terrain(np.full((40, 40), 22.0, np.float32), -10.0, 30.0, 1.0)
    known, unknown = (ground_of(cloud, cropped, polygons, each) for each in (terrain, None))
    assert (known.z_m[0], known.source[0]) == (22.0, "terrain")
    assert 37 < unknown.z_m[0] < 40 and unknown.source[0] == "unclassified-points" and unknown.sd_m[0] > 0.1
    # where some of them have class ground, ground is seen
    is_near = (cloud.x_m > 10) & (cloud.x_m < 15)
    seen = replace(
        cloud, classification=np.where(is_near, GROUND_CLASS, cloud.classification).astype(np.uint8)
    )
    ground = ground_of(seen, crop_cloud(seen, polygons), polygons, terrain)
    assert ground.source[0] == "around" and np.isnan(ground.sd_m[0])


@pytest.mark.parametrize(("share", "found"), [(0.2, (40.0, "around")), (0.8, (37.0, "storey"))])
def test_some_points_of_class_building_on_the_ground_are_no_roof(
    share: float, found: tuple[float, str]
) -> None:
    polygons = polygon_arrays.to_polygons(np.array([shapely.Polygon(RING)]))
    around = np.column_stack([xy := grid((-0.9, 0), (0, 10)), np.full(len(xy), 40.0)])
    cloud = cloud_of(45.0, around)
    is_low = (cloud.classification == BUILDING_CLASS) & (cloud.y_m < 10 * share)
    cloud = replace(cloud, z_m=np.where(is_low, 40.0, cloud.z_m))
    ground = ground_of(cloud, crop_cloud(cloud, polygons), polygons, None)
    assert (float(ground.z_m[0]), str(ground.source[0])) == found


def test_points_without_class_are_a_roof_where_those_beside_are_lower() -> None:
    """Class ground is on the slope above, a little higher than the roof; beside it, points are 8 m lower."""
    polygons = polygon_arrays.to_polygons(np.array([shapely.Polygon(RING)]))
    above = np.column_stack([xy := grid((-0.9, 0), (0, 10)), np.full(len(xy), 28.5)])
    beside = np.column_stack([xy := grid((8, 0), (9, 10)), np.full(len(xy), 20.0)])
    cloud = cloud_of(28.0, np.vstack([above, beside]))
    classes = np.where(cloud.z_m == 28.5, GROUND_CLASS, UNCLASSIFIED_CLASS).astype(np.uint8)
    cloud = replace(cloud, classification=classes)
    ground = ground_of(cloud, crop_cloud(cloud, polygons), polygons, None)
    assert (float(ground.z_m[0]), str(ground.source[0])) == (20.0, "lowest-points")
    # 1.5 m above that ground, they would not count
    low = replace(cloud, z_m=np.where(cloud.z_m == 28.5, 26.5, cloud.z_m))
    ground = ground_of(low, crop_cloud(low, polygons), polygons, None)
    assert (float(ground.z_m[0]), str(ground.source[0])) == (20.0, "lowest-points")


def test_a_shaft_is_where_low_points_are_and_no_roof() -> None:
    roof_m = surface({(0, 8): 12.0})
    roof_m = roof_m[np.isfinite(roof_m[:, 2])]
    well = (np.abs(roof_m[:, 0] - 4) < 1.1) & (np.abs(roof_m[:, 1] - 5) < 1.1)
    floor_m = np.column_stack([np.random.default_rng(0).uniform((3, 4), (5, 6), (20, 2)), np.full(20, 1.0)])
    polygon = shapely.Polygon(RING)

    def found(roof_m: np.ndarray, low_m: np.ndarray) -> np.ndarray:
        point_m = np.vstack([roof_m, low_m])
        classes = np.repeat([BUILDING_CLASS, UNCLASSIFIED_CLASS], [len(roof_m), len(low_m)]).astype(np.uint8)
        return shaft_points(polygon, point_m, classes, roof_m, 0.5)

    shaft_m = found(roof_m[~well], floor_m)
    assert len(shaft_m) > 30 and (shaft_m[:, 2] == 1.0).all()
    assert (np.abs(shaft_m[:, :2] - [4, 5]) < 1.3).all()
    # points under a roof, as of a canopy, and a hole without low points, as of water on it, are no shafts
    assert not len(found(roof_m, floor_m)) and not len(found(roof_m[~well], floor_m[:0]))
    # nor is the shadow of a higher neighbour, where only the wall to the street is seen
    street_m = np.column_stack([np.linspace(6.0, 7.9, 20), np.full((20, 2), [0.2, 1.0])])
    assert not len(found(roof_m[(roof_m[:, 0] < 6) | (roof_m[:, 1] > 3)], street_m))
    # nor is a place that is not far below
    assert not len(found(roof_m[~well], np.add(floor_m, (0, 0, 9.5))))


def test_the_shaft_of_a_long_diagonal_building_takes_no_grid_of_what_is_around_it() -> None:
    draw = np.random.default_rng(0)
    plan_m = draw.uniform((0, 0), (400, 10), (16_000, 2))
    low = (np.abs(plan_m - [30, 5]) < 3).all(axis=1)
    turn = np.array([[1, 1], [-1, 1]]) / np.sqrt(2)
    point_m = np.column_stack([plan_m @ turn, np.where(low, 0.0, 8.0)])
    classes = np.where(low, UNCLASSIFIED_CLASS, BUILDING_CLASS).astype(np.uint8)
    polygon = shapely.Polygon(np.array([(0, 0), (400, 0), (400, 10), (0, 10)]) @ turn)
    tracemalloc.start()
    shaft_m = shaft_points(polygon, point_m, classes, point_m[~low], 0.5)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert low.sum() < len(shaft_m) < 1000 and most < 2e7
