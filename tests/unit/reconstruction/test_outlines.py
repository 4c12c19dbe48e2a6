"""Outlines from points alone: known shapes, seams, trees, clouds without classes."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
import shapely
from shapely import affinity

import p2wss
from p2wss.clouds.reading import Cloud
from p2wss.config import Outlines
from p2wss.reconstruction.points import unclassified
from p2wss.reconstruction.points.unclassified import with_classes
from p2wss.reconstruction.tracing import outlines as tracing
from p2wss.reconstruction.tracing.outlines import outline_features, outlines_and_crowns
from p2wss.storage import files
from p2wss.storage.messages import InputError

LAMBERT = pyproj.CRS.from_epsg(2154)
ORIGIN = np.array([652_000.0, 6_862_000.0])
L_SHAPE = shapely.Polygon([(0, 0), (20, 0), (20, 8), (8, 8), (8, 18), (0, 18)])
BUILDING, GROUND, TREE = 6, 2, 5


def outlines(cloud: Cloud, settings: Outlines, is_classified: bool = True) -> np.ndarray:
    return outlines_and_crowns(cloud, settings, is_classified)[0]


def scene(
    *roofs: tuple[shapely.Polygon, float], tree: shapely.Polygon | None = None, angle_deg: float = 0.0
) -> Cloud:
    """15 points per m2 over flat roofs (polygon, z) and on the ground at 2 m around, turned by an angle."""
    draw = np.random.default_rng(3)
    x_min, y_min, x_max, y_max = shapely.union_all([roof for roof, _ in roofs]).buffer(8).bounds
    count = int(15 * (x_max - x_min) * (y_max - y_min))
    xy_m = draw.uniform([x_min, y_min], [x_max, y_max], (count, 2))
    z_m = 2 + draw.normal(0, 0.03, count)
    classes = np.full(count, GROUND, np.uint8)
    if tree is not None:
        inside = shapely.contains_xy(tree, *xy_m.T)
        z_m[inside] = draw.uniform(4, 11, inside.sum())
        classes[inside] = TREE
    for roof, height_m in roofs:
        inside = shapely.contains_xy(roof, *xy_m.T)
        z_m[inside] = height_m + draw.normal(0, 0.03, inside.sum())
        classes[inside] = BUILDING
    turn = np.radians(angle_deg)
    matrix = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    x_m, y_m = (xy_m @ matrix + ORIGIN).T
    return Cloud(x_m, y_m, z_m, classes, LAMBERT)


def placed(shape: shapely.Polygon, angle_deg: float = 0.0) -> shapely.Polygon:
    return affinity.translate(affinity.rotate(shape, angle_deg, origin=(0, 0)), *ORIGIN)


def corner_errors_m(outline: shapely.Polygon, truth: shapely.Polygon) -> np.ndarray:
    """Distance of each true corner to the nearest vertex."""
    vertex = shapely.MultiPoint(outline.exterior.coords)
    return np.array([vertex.distance(shapely.Point(xy)) for xy in truth.exterior.coords])


@pytest.mark.parametrize("angle_deg", [0.0, 17.0, 33.0, 45.0])
def test_outline_of_an_l_shape(angle_deg: float) -> None:
    (outline,) = outlines(scene((L_SHAPE, 8.0), angle_deg=angle_deg), Outlines(overhang_m=0))
    truth = placed(L_SHAPE, angle_deg)
    assert len(outline.exterior.coords) - 1 == 6
    assert corner_errors_m(outline, truth).max() <= 0.25
    assert outline.intersection(truth).area / outline.union(truth).area >= 0.96


@pytest.mark.parametrize("angle_deg", [0.0, 45.0, 60.0, 75.0])
def test_a_short_side_between_sides_that_would_meet_in_a_spike_stays(angle_deg: float) -> None:
    """They would meet 2.5 m beyond it."""
    wedge = shapely.Polygon([(0, -4), (12, -0.7), (12, 0.7), (0, 4)])
    (outline,) = outlines(scene((wedge, 6.0), angle_deg=angle_deg), Outlines(overhang_m=0, min_edge_m=2))
    xy_m = np.array(
        affinity.rotate(affinity.translate(outline, *-ORIGIN), -angle_deg, origin=(0, 0)).exterior.coords
    )
    assert xy_m[:, 0].max() < 12.7


@pytest.mark.parametrize("angle_deg", [20.0, 30.0, 40.0, 70.0])
def test_corners_that_a_coarse_raster_cuts_off_are_there_again(angle_deg: float) -> None:
    house = shapely.box(0, 0, 15, 10)
    dense = scene((house, 8.0), angle_deg=angle_deg)
    kept = np.random.default_rng(1).random(len(dense)) < 0.27
    cloud = Cloud(dense.x_m[kept], dense.y_m[kept], dense.z_m[kept], dense.classification[kept], LAMBERT)
    (outline,) = outlines(cloud, Outlines(overhang_m=0))
    assert len(outline.exterior.coords) - 1 == 4
    assert corner_errors_m(outline, placed(house, angle_deg)).max() <= 0.5


@pytest.mark.parametrize("angle_deg", [12.0, 17.0, 74.0])
def test_a_small_house_stands_as_its_points_do(angle_deg: float) -> None:
    """Along edges of few cells a trace follows the raster."""
    cloud = scene((shapely.box(0, 0, 5.5, 5), 6.0), angle_deg=angle_deg)
    (outline,) = outlines(cloud, Outlines(overhang_m=0, cell_m=0.7))
    truth = placed(shapely.box(0, 0, 5.5, 5), angle_deg)
    assert len(outline.exterior.coords) - 1 == 4
    assert corner_errors_m(outline, truth).max() <= 0.3


@pytest.mark.parametrize("angle_deg", [0.0, 8.0, 17.0, 70.0])
def test_the_border_of_a_cloud_gives_a_building_no_direction(angle_deg: float) -> None:
    """It cuts a house of 14 x 40 m lengthwise, and the edge along it is the longest."""
    house = shapely.box(-7, -20, 7, 20)
    cloud = scene((house, 8.0), angle_deg=angle_deg)
    is_inside = cloud.x_m <= ORIGIN[0]
    cut = Cloud(*(column[is_inside] for column in columns(cloud)), crs=LAMBERT)
    (outline,) = outlines(cut, Outlines(overhang_m=0))
    east_m, north_m = ORIGIN
    truth = shapely.clip_by_rect(placed(house, angle_deg), east_m - 40, north_m - 40, east_m, north_m + 40)
    assert len(outline.exterior.coords) - 1 <= 5
    assert outline.intersection(truth).area / outline.union(truth).area >= 0.96


@pytest.mark.parametrize("is_classified", [True, False])
def test_buildings_far_from_each_other_are_as_alone(is_classified: bool) -> None:
    near = scene((L_SHAPE, 9.0), angle_deg=20)
    if not is_classified:
        near = replace(near, classification=np.zeros(len(near), np.uint8))
    far = replace(near, x_m=near.x_m + 80_000, y_m=near.y_m + 90_000)
    both = Cloud(
        *(np.concatenate(pair) for pair in zip(columns(near), columns(far), strict=True)), crs=LAMBERT
    )
    # a raster of all would have 10 to the 10 cells
    together = outlines(with_classes(both)[0], Outlines(), is_classified)
    alone = [outlines(with_classes(each)[0], Outlines(), is_classified) for each in (near, far)]
    assert together.tolist() == np.concatenate(alone).tolist() and len(together) == 2


@pytest.mark.parametrize("is_classified", [True, False])
def test_tile_by_tile_is_as_in_one_raster(is_classified: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles of 10 m, which the sides of all houses cross, and one of which is longer than two tiles."""
    cloud = scene(
        (L_SHAPE, 9.0), (shapely.box(-4, 24, 40, 33), 7.0), (shapely.box(26, 0, 40, 9), 6.0), angle_deg=20
    )
    if not is_classified:
        cloud = replace(cloud, classification=np.zeros(len(cloud), np.uint8))
    whole = with_classes(cloud)[0]
    expected = outlines(whole, Outlines(), is_classified)
    monkeypatch.setattr(unclassified, "_MAX_CELLS", 400)
    monkeypatch.setattr(unclassified, "_TILE_CELLS", 20)
    monkeypatch.setattr(tracing, "_TILE_MARGIN_M", 6.0)
    tiled = with_classes(cloud)[0]
    assert np.array_equal(tiled.classification, whole.classification)
    assert outlines(tiled, Outlines(), is_classified).tolist() == expected.tolist() and len(expected) == 3


def test_a_corridor_takes_no_raster_of_what_is_around_it() -> None:
    """30 km from the south-west to the north-east, with a house at each end: a raster of it has 10 to the 9 cells."""
    near = scene((L_SHAPE, 9.0), angle_deg=20)
    far = replace(near, x_m=near.x_m + 21_000, y_m=near.y_m + 21_000)
    way_m = np.arange(0, 21_000, 40.0)
    way = replace(
        near,
        x_m=ORIGIN[0] + way_m,
        y_m=ORIGIN[1] + way_m,
        z_m=np.full(len(way_m), 2.0),
        classification=np.full(len(way_m), GROUND, np.uint8),
    )
    parts = zip(*(columns(each) for each in (near, way, far)), strict=True)
    corridor = Cloud(*(np.concatenate(each) for each in parts), crs=LAMBERT)
    assert len(unclassified.tiles(corridor.x_m, corridor.y_m, 1.0)) > 20
    tracemalloc.start()
    together = outlines(corridor, Outlines())
    assert tracemalloc.get_traced_memory()[1] < 300e6
    tracemalloc.stop()
    alone = [outlines(each, Outlines()) for each in (near, far)]
    assert [*map(shapely.area, together)] == pytest.approx(
        [*map(shapely.area, np.concatenate(alone))], rel=0.05
    )


def columns(cloud: Cloud) -> tuple[np.ndarray, ...]:
    return cloud.x_m, cloud.y_m, cloud.z_m, cloud.classification


def test_courtyards_stay() -> None:
    court = shapely.box(6, 6, 14, 13)
    (outline,) = outlines(scene((shapely.box(0, 0, 20, 20) - court, 8.0), angle_deg=20.0), Outlines())
    assert len(outline.interiors) == 1
    hole = shapely.Polygon(outline.interiors[0])
    truth = placed(court, 20.0)
    assert len(hole.exterior.coords) - 1 == 4
    assert hole.intersection(truth).area / hole.union(truth).area >= 0.9


def test_a_hall_of_few_points_is_whole(caplog: pytest.LogCaptureFixture) -> None:
    """A cell of 1 m with points has one at least, also of a cloud with a third of a point per square metre."""
    hall = shapely.box(0, 0, 60, 40)
    dense = scene((hall, 9.0))
    some = np.random.default_rng(5).permutation(len(dense))[: len(dense) // 50]
    arrays = (dense.x_m[some], dense.y_m[some], dense.z_m[some], dense.classification[some])
    (outline,) = outlines(Cloud(*arrays, LAMBERT), Outlines())
    truth = placed(hall)
    assert len(outline.interiors) == 0
    assert outline.intersection(truth).area / outline.union(truth).area >= 0.9
    assert "warning: 0.29 points per m2 on buildings: outlines are coarse" in caplog.text


@pytest.mark.parametrize("angle_deg", [0.0, 28.0])
def test_houses_of_different_height_are_apart(angle_deg: float) -> None:
    low, high = shapely.box(0, 0, 9, 10), shapely.box(9, 0, 20, 10)
    shapes = outlines(scene((low, 6.0), (high, 10.0), angle_deg=angle_deg), Outlines())
    assert len(shapes) == 2
    for truth in (placed(low, angle_deg), placed(high, angle_deg)):
        assert max(shape.intersection(truth).area / shape.union(truth).area for shape in shapes) >= 0.93
    # the wall that they share is the same to the bit
    assert shapes[0].intersection(shapes[1]).length == pytest.approx(10, abs=0.5)
    assert shapely.coverage_is_valid(shapes)


def test_houses_of_one_height_are_one() -> None:
    cloud = scene((shapely.box(0, 0, 9, 10), 6.0), (shapely.box(9, 0, 20, 10), 7.0))
    assert len(outlines(cloud, Outlines(max_area_m2=1000))) == 1
    assert len(outlines(cloud, Outlines(jump_m=0.5))) == 2


def test_small_parts_that_join_one_after_another_are_one() -> None:
    """A part of one cell joins one of two, and both the part of six beside that."""
    label = np.array([0, 1, 1, 2, 2, 2, 2, 2, 2])
    assert tracing._joined(label, np.arange(8), np.arange(1, 9), 4).tolist() == 9 * [2]


def test_large_buildings_are_split_at_smaller_jumps() -> None:
    # 1 m: less than the jump, more than half of it
    cloud = scene((shapely.box(0, 0, 9, 10), 6.0), (shapely.box(9, 0, 20, 10), 7.0))
    assert len(outlines(cloud, Outlines(max_area_m2=190))) == 2
    assert len(outlines(cloud, Outlines(max_area_m2=220))) == 1


def test_a_steep_roof_is_not_split_along_its_slope() -> None:
    """At 50 degrees, cells of 0.7 m differ by 0.8 m, more than the least jump."""
    roof = shapely.box(0, 0, 30, 14)
    dense = scene((roof, 20.0))
    some = np.random.default_rng(5).permutation(len(dense))[: len(dense) // 3]
    x_m, y_m, z_m, classes = (
        column[some] for column in (dense.x_m, dense.y_m, dense.z_m, dense.classification)
    )
    on_roof = classes == BUILDING
    z_m[on_roof] -= np.tan(np.radians(50)) * np.abs(y_m[on_roof] - ORIGIN[1] - 7)
    assert len(outlines(Cloud(x_m, y_m, z_m, classes, LAMBERT), Outlines())) == 1
    # half of it 2 m higher, at right angles to the slope
    z_m[on_roof & (x_m < ORIGIN[0] + 15)] += 2.0
    assert len(outlines(Cloud(x_m, y_m, z_m, classes, LAMBERT), Outlines())) == 2


@pytest.mark.parametrize("is_classified", [True, False])
def test_a_tree_beside_is_not_of_the_building(is_classified: bool) -> None:
    tree = shapely.Point(23, 4).buffer(3.5)
    cloud = scene((L_SHAPE, 8.0), tree=tree)
    if not is_classified:
        cloud = replace(cloud, classification=np.where(cloud.classification == TREE, 1, cloud.classification))
    (outline,) = outlines(cloud, Outlines())
    assert corner_errors_m(outline, placed(L_SHAPE)).max() <= 0.25


def test_a_cloud_without_classes() -> None:
    cloud = scene((L_SHAPE, 8.0), tree=shapely.Point(32, 4).buffer(3.5))
    cloud, warnings = with_classes(replace(cloud, classification=np.ones(len(cloud), np.uint8)))
    assert len(warnings) == 2
    shapes = outlines(cloud, Outlines())
    truth = placed(L_SHAPE)
    best = max(shapes, key=lambda shape: shape.intersection(truth).area)
    assert best.intersection(truth).area / best.union(truth).area >= 0.93


def under(cloud: Cloud, roof: shapely.Polygon, share: float) -> Cloud:
    """The cloud without classes, with a share of the points of a roof anywhere under it."""
    draw = np.random.default_rng(4)
    passes = shapely.contains_xy(placed(roof), cloud.x_m, cloud.y_m) & (draw.random(len(cloud)) < share)
    z_m = np.where(passes, draw.uniform(2, 6, len(cloud)), cloud.z_m)
    return replace(cloud, z_m=z_m, classification=np.ones(len(cloud), np.uint8))


def test_crowns_that_pulses_pass_through_are_left_out(caplog: pytest.LogCaptureFixture) -> None:
    roof, crown = shapely.box(0, 0, 10, 8), shapely.box(20, 0, 27, 7)
    cloud = under(scene((roof, 8.0), (crown, 9.0)), crown, 0.4)
    supposed, _ = with_classes(cloud)
    assert len(outlines(supposed, Outlines())) == 2
    assert len(outline_features(outlines(supposed, Outlines()), LAMBERT)) == 2
    (outline,) = p2wss.outlines(cloud).geometry
    assert outline.intersection(placed(roof)).area >= 0.9 * roof.area
    assert "left out, as pulses pass through them as through trees: 1" in caplog.text
    assert "no point has class 6 (building)" in caplog.text
    assert "footprints are not moved" not in caplog.text
    # few pulses, as through windows in a roof
    assert len(p2wss.outlines(under(scene((roof, 8.0), (crown, 9.0)), crown, 0.1))) == 2
    # the producer says that it is a building
    building = np.where(supposed.classification == BUILDING, BUILDING, 1).astype(np.uint8)
    assert len(p2wss.outlines(replace(cloud, classification=building))) == 2


def test_and_are_plants() -> None:
    roof, crown = shapely.box(0, 0, 10, 8), shapely.box(20, 0, 27, 7)
    config = {"reconstruct": {"vegetation": True}}
    cloud = under(scene((roof, 8.0), (crown, 9.0)), crown, 0.4)
    with p2wss.reconstruct(cloud, None, config=config, model="none", progress=False) as result:
        (house,) = result.values()
        plants = [shapely.MultiPoint(plant.vertex_m[:, :2]).convex_hull for plant in result.plants.values()]
        top_z_m = [plant.vertex_m[:, 2].max() for plant in result.plants.values()]
    assert house.footprint.intersection(placed(roof)).area >= 0.9 * roof.area
    # as high as the planar points, not as those under them
    assert top_z_m == pytest.approx([9.0] * len(plants), abs=0.2)
    covered = shapely.union_all(plants)
    assert covered.intersection(placed(crown)).area >= 0.7 * crown.area
    assert not covered.intersects(placed(roof).buffer(-1))


def test_buildings_like_crowns_are_to_be_checked(tmp_path: Path) -> None:
    """Of crowns whose surface alone the points show, through which no pulse passes."""
    roof, crown = shapely.box(0, 0, 10, 8), shapely.box(20, 0, 30, 10)
    cloud, draw = scene((roof, 8.0), (crown, 9.0)), np.random.default_rng(2)
    lumps_m = 0.8 * np.sin(3.0 * cloud.x_m) * np.sin(2.6 * cloud.y_m) + draw.normal(0, 0.1, len(cloud))
    is_crown = shapely.contains_xy(placed(crown), cloud.x_m, cloud.y_m)
    cloud = replace(cloud, z_m=cloud.z_m + is_crown * lumps_m)
    without = replace(cloud, classification=np.ones(len(cloud), np.uint8))
    # with class 6, the producer says that it is a building
    for each, flag in ((without, "like-trees"), (cloud, None)):
        with p2wss.reconstruct(each, None, model="none", progress=False) as result:
            flags = [building.attributes["footprint_flags"] for building in result.values()]
            counts = files.read_json(result.write(tmp_path, ["gpkg"])[-1], dict)["buildings"]
        assert flags == [None, flag] and counts["status"] == {"ok": 2}
        assert ("like-trees" in counts["doubts"]) is (flag is not None) and counts["to_check"] == ["2"]


def test_walls_with_many_points_do_not_make_a_crown() -> None:
    """More points are under this roof than on it, but under its edges only."""
    roof, count = shapely.box(0, 0, 10, 8), 8000
    cloud, draw = scene((roof, 8.0)), np.random.default_rng(5)
    wall = placed(roof).buffer(-0.3).exterior
    x_m, y_m = shapely.get_coordinates(
        shapely.line_interpolate_point(wall, draw.uniform(0, wall.length, count))
    ).T
    walled = Cloud(
        np.concatenate([cloud.x_m, x_m]),
        np.concatenate([cloud.y_m, y_m]),
        np.concatenate([cloud.z_m, draw.uniform(2, 7.5, count)]),
        np.concatenate([cloud.classification, np.ones(count, np.uint8)]),
        LAMBERT,
    )
    (outline,) = outlines(walled, Outlines(), is_classified=False)
    assert shapely.contains_xy(outline, x_m, y_m).all()


def test_a_cloud_of_crowns_alone_is_an_error() -> None:
    crown = shapely.box(0, 0, 7, 7)
    with pytest.raises(InputError, match="pulses pass through all 1 as through trees; give footprints"):
        p2wss.outlines(under(scene((crown, 9.0)), crown, 0.4))


def test_the_order_of_points_does_not_matter() -> None:
    cloud = scene((L_SHAPE, 6.0), (shapely.box(20, 0, 30, 8), 10.0), angle_deg=12.0)
    order = np.random.default_rng(1).permutation(len(cloud))
    shuffled = replace(
        cloud,
        x_m=cloud.x_m[order],
        y_m=cloud.y_m[order],
        z_m=cloud.z_m[order],
        classification=cloud.classification[order],
    )
    first, second = (outline_features(outlines(each, Outlines()), LAMBERT) for each in (cloud, shuffled))
    assert first["building_id"].tolist() == ["1", "2"]
    assert shapely.to_wkb(first.geometry).tolist() == shapely.to_wkb(second.geometry).tolist()


def test_clouds_without_outlines() -> None:
    cloud = scene((L_SHAPE, 8.0))
    empty = Cloud(*[np.zeros(0)] * 3, np.zeros(0, np.uint8), LAMBERT)
    with pytest.raises(InputError, match="has no points"):
        outlines(empty, Outlines())
    ground = replace(cloud, classification=np.full(len(cloud), 2, np.uint8))
    for is_classified, missing in ((True, "class 6"), (False, "planes 2 m above the ground")):
        with pytest.raises(InputError, match=missing):
            outlines(ground, Outlines(), is_classified)
    with pytest.raises(InputError, match="no building has at least 1000 m2"):
        outlines(cloud, Outlines(min_area_m2=1000))


def test_buildings_far_from_each_other_are_split_without_copies_of_the_raster() -> None:
    block = np.zeros((2000, 2000), np.int32)
    block[2:30, 2:30], block[-30:-2, -30:-2] = 1, 2
    height_m = np.where(np.arange(2000) % 1990 < 12, 5.0, 9.0) * np.ones((2000, 1))
    tracemalloc.start()
    building = tracing._split(block, height_m, Outlines(), 0.5)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert [np.unique(building[block == number]).size for number in (1, 2)] == [2, 2]
    assert peak < 3 * height_m.nbytes


def test_free_edges_stand_inside_the_edge_of_the_roof() -> None:
    court = shapely.box(6, 6, 14, 13)
    cloud = scene((shapely.box(0, 0, 20, 20) - court, 8.0), angle_deg=20.0)
    (roof,), (walls,) = outlines(cloud, Outlines(overhang_m=0)), outlines(cloud, Outlines(overhang_m=0.4))
    for ring, sign in ((0, -1), (1, 1)):
        outer, inner = (shapely.Polygon(shapely.get_rings(shape)[ring]) for shape in (roof, walls))
        expected = outer.buffer(sign * 0.4, join_style="mitre")
        assert expected.symmetric_difference(inner).area < 0.02 * outer.length
    # the walls between the buildings of a block are none
    low, high = shapely.box(0, 0, 9, 10), shapely.box(9, 0, 20, 10)
    first, second = outlines(scene((low, 6.0), (high, 10.0)), Outlines(overhang_m=0.4))
    assert first.intersection(second).length == pytest.approx(9.2, abs=0.5)
    assert first.union(second).area == pytest.approx((20 - 0.8) * (10 - 0.8), rel=0.03)


def test_outlines_have_no_heights_and_no_vertical_crs() -> None:
    features = outline_features(np.array([shapely.box(0, 0, 10, 5)], object), pyproj.CRS("EPSG:2154+5720"))
    assert features.crs == pyproj.CRS("EPSG:2154") and features["area_m2"].tolist() == [50.0]
