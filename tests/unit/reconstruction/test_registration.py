"""Footprints are moved to where the points clearly show the buildings, and stay where they do not."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import geopandas as gpd
import numpy as np
import pytest
import shapely
from shapely import affinity
from toy_clouds import LAMBERT

from p2wss.clouds.crops import ground_height
from p2wss.clouds.reading import Cloud
from p2wss.config import Reconstruct
from p2wss.data import polygon_arrays
from p2wss.reconstruction.outputs.attributes import input_footprints
from p2wss.reconstruction.outputs.attributes import table as reconstruct_table
from p2wss.reconstruction.pipeline import run
from p2wss.reconstruction.points.unclassified import with_classes
from p2wss.reconstruction.registration import register as registration
from p2wss.reconstruction.registration.blocks import find_blocks
from p2wss.reconstruction.registration.footprint_flags import contradictions
from p2wss.reconstruction.registration.register import (
    EDGES,
    NOTHING,
    OWN_BUILDINGS,
    OWN_CLASSES,
    Registration,
    Shifts,
    decide,
    register,
    shift_around,
)
from p2wss.reconstruction.registration.register import summary as registration_summary
from p2wss.reconstruction.registration.shifts import Estimate
from p2wss.storage.features import Features

POINTS_PER_M2 = 10
ORIGIN = np.array([652_000.0, 6_862_000.0])
# two houses of a row and an annex that share walls
BLOCK = [
    shapely.Polygon([(0, 0), (7, 0), (7, 11), (0, 11)]),
    shapely.Polygon([(7, 0), (14, 0), (14, 9), (7, 9)]),
    shapely.Polygon([(14, 0), (18, 0), (18, 5), (14, 5)]),
]
AROUND = shapely.box(-14, -14, 32, 26)


def registered(frame: gpd.GeoDataFrame, cloud: Cloud) -> tuple[gpd.GeoDataFrame, list[Registration]]:
    result, rows = register(Features.of(frame), cloud)
    return result.to_frame(), rows


def frame_of(shapes: list[shapely.Polygon], shift: tuple[float, float] = (0, 0)) -> gpd.GeoDataFrame:
    """The footprints, moved, as the cleaning returns them."""
    placed = [affinity.translate(shape, *(ORIGIN + shift)) for shape in shapes]
    names = [f"b{k}" for k in range(len(placed))]
    frame = gpd.GeoDataFrame(
        {"building_id": names, "status": ["ok"] * len(placed)}, geometry=placed, crs=LAMBERT
    )
    return frame.assign(
        **dict(
            zip(("centre_x_m", "centre_y_m"), np.array([p.centroid.coords[0] for p in placed]).T, strict=True)
        )
    )


def cloud_of(
    roof: shapely.Geometry,
    trees: shapely.Geometry | None = None,
    around: shapely.Geometry = AROUND,
    roof_class: int = 6,
    seed: int = 0,
) -> Cloud:
    """Points of the roof class at 6 m, of trees (class 5) at 4 m over ground and roofs, and ground elsewhere."""
    draw = np.random.default_rng(seed)
    x_min, y_min, x_max, y_max = around.bounds
    count = int(POINTS_PER_M2 * (x_max - x_min) * (y_max - y_min))
    x, y = draw.uniform(x_min, x_max, count), draw.uniform(y_min, y_max, count)
    classes = np.where(shapely.contains_xy(roof, x, y), roof_class, 2).astype(np.uint8)
    if trees is not None:
        classes[shapely.contains_xy(trees, x, y) & (draw.uniform(size=count) < 0.8)] = 5
    z = np.select([classes == 2, classes == 5], [0.0, 4.0], 6.0)
    return Cloud(x + ORIGIN[0], y + ORIGIN[1], z, classes, LAMBERT)


def shift_of(rows: list[Registration], row: int = 0) -> np.ndarray:
    return np.array(rows[row].shift_m)


def roofs(overhang: float = 0.0) -> shapely.Geometry:
    return shapely.union_all(BLOCK).buffer(overhang, join_style="mitre")


@pytest.mark.parametrize("overhang", [0.0, 0.5])
@pytest.mark.parametrize("shift", [(1.2, -0.7), (-0.5, 0.0), (1.9, 1.9), (0.0, -2.6)])
def test_a_moved_block_comes_back(shift: tuple[float, float], overhang: float) -> None:
    _, rows = registered(frame_of(BLOCK, shift), cloud_of(roofs(overhang)))
    for row in rows:
        assert np.linalg.norm(np.add(row.shift_m, shift)) < 0.1
        assert row.shift_sd_m is not None and 0 < row.shift_sd_m < 0.2


@pytest.mark.parametrize("seed", [4, 7, 10])
def test_sparse_points_do_not_move_an_inaccurate_block_from_where_it_fits(seed: int) -> None:
    """Eight houses whose fronts and backs are wrong by up to a metre, on a point per two square metres: their steps
    agreed on a shift of 0.5 m, under which more of the roofs were outside."""
    draw = np.random.default_rng(seed)
    ends_m = np.concatenate([[0], np.cumsum(draw.uniform(4, 8, 8))])
    true = [
        shapely.box(first, draw.uniform(-3, 3), last, draw.uniform(8, 16)) for first, last in pairwise(ends_m)
    ]
    count = draw.poisson((ends_m[-1] + 30) * 50 * 0.5)
    x, y = draw.uniform([-15, -18], [ends_m[-1] + 15, 32], (count, 2)).T
    is_roof = shapely.contains_xy(shapely.union_all(true), x, y)
    classes = np.where(is_roof, 6, 2).astype(np.uint8)
    cloud = Cloud(x + ORIGIN[0], y + ORIGIN[1], np.where(is_roof, 8.0, 0.0), classes, LAMBERT)
    wrong_m = draw.uniform(-1, 1, (8, 2))
    drawn = [
        shapely.box(*np.add(house.bounds, [0, front, 0, back]))
        for house, (front, back) in zip(true, wrong_m, strict=True)
    ]
    _, rows = registered(frame_of(drawn), cloud)
    assert {row.shift_m for row in rows} == {(0.0, 0.0)}


def test_a_block_moves_as_one_and_keeps_what_it_was() -> None:
    frame = frame_of(BLOCK, (1.2, -0.7))
    result, rows = registered(frame, cloud_of(roofs()))
    before, after = frame.geometry.to_numpy(), result.geometry.to_numpy()
    # shared walls stay equal to the bit: every vertex has moved by the same addition
    for shape, moved, row in zip(before, after, rows, strict=True):
        expected = shapely.get_coordinates(shape) + row.shift_m
        assert np.array_equal(shapely.get_coordinates(moved), expected)
        assert row.input_polygon.equals(shape)
    assert frame.geometry.geom_equals_exact(frame_of(BLOCK, (1.2, -0.7)).geometry, 0).all()


@pytest.mark.parametrize("overhang", [0.0, 0.3, 0.8])
def test_overhang_on_all_sides_is_no_shift(overhang: float) -> None:
    cloud = cloud_of(roofs(overhang))
    frame = frame_of(BLOCK)
    result, rows = registered(frame, cloud)
    assert result.geometry.geom_equals_exact(frame.geometry, 0).all()
    assert rows[0].overhang_m == pytest.approx(overhang, abs=0.1)


def test_a_tree_over_one_side_is_no_shift() -> None:
    tree = shapely.Point(0, 5).buffer(4)
    for shift in ((0.0, 0.0), (0.9, 0.9)):
        _, rows = registered(frame_of(BLOCK, shift), cloud_of(roofs(), tree))
        assert np.linalg.norm(shift_of(rows) + shift) < 0.15


@pytest.mark.parametrize("roof_class", [1, 2, 5])
def test_without_points_on_buildings_nothing_moves(roof_class: int) -> None:
    frame = frame_of(BLOCK, (1.0, 0.5))
    result, rows = registered(frame, cloud_of(roofs(), roof_class=roof_class))
    assert result.geometry.geom_equals_exact(frame.geometry, 0).all()
    assert [row.source for row in rows] == [NOTHING] * 3
    assert all(row.shift_sd_m is None for row in rows)


@pytest.mark.parametrize("missed_class", [1, 5, 12])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.2, -0.7)])
def test_roofs_of_which_the_producer_missed_half_are_found(
    shift: tuple[float, float], missed_class: int
) -> None:
    cloud = cloud_of(roofs())
    is_missed = (cloud.classification == 6) & (np.random.default_rng(1).random(len(cloud)) < 0.5)
    classes = np.where(is_missed, missed_class, cloud.classification).astype(np.uint8)
    _, rows = registered(frame_of(BLOCK, shift), replace(cloud, classification=classes))
    assert {row.source for row in rows} == {EDGES}
    assert np.linalg.norm(shift_of(rows) + shift) < 0.15


@pytest.mark.parametrize("depth_m", [0.5, 1.0, 1.5])
@pytest.mark.parametrize("sides", ["w", "ws"])
@pytest.mark.parametrize("ground", [1, 2])
def test_decks_and_low_annexes_of_a_traced_outline_are_no_shift(
    depth_m: float, sides: str, ground: int
) -> None:
    """The outline is that of all points; only those on the house have the class of a roof."""
    outline = shapely.box(-depth_m, -depth_m * (sides == "ws"), 10, 8)
    house = shapely.box(0, 0, 10, 8)
    cloud = cloud_of(house)
    is_deck = shapely.contains_xy(outline - house, cloud.x_m - ORIGIN[0], cloud.y_m - ORIGIN[1])
    cloud.classification[is_deck] = ground
    assert registered(frame_of([outline]), cloud)[1][0].shift_m == (0.0, 0.0)


def test_a_shed_under_a_tree_beside_a_house_stays() -> None:
    shed = shapely.box(21, 0, 24, 3)
    tree = shapely.Point(22.5, 1.5).buffer(3.2)
    _, rows = registered(frame_of([*BLOCK, shed]), cloud_of(roofs(), tree))
    assert rows[3].shift_m == (0.0, 0.0)
    assert rows[3].source == NOTHING


def test_a_shed_beside_a_roof_that_has_no_footprint_stays() -> None:
    roof = shapely.box(20, -10, 30, 20)
    for x in np.arange(16.5, 18.0, 0.5):
        shed = shapely.box(x, 2, x + 2.5, 4.5)
        assert np.array_equal(shift_of(registered(frame_of([shed]), cloud_of(roof))[1]), [0, 0])


def test_blocks_are_footprints_that_touch() -> None:
    corner, apart, across = (
        shapely.box(18, 5, 22, 9),
        shapely.box(18.3, 0, 22, 4),
        shapely.box(-3, -3, 0.5, 4),
    )
    blocks = find_blocks(np.array([*BLOCK, corner, apart, across, shapely.Polygon()], dtype=object))
    assert blocks.of_footprint.tolist() == [0, 0, 0, 0, 1, 2, -1]
    # party walls are no edges of a block
    blocks = find_blocks(np.array(BLOCK, dtype=object))
    assert shapely.union_all(BLOCK).length == pytest.approx(
        np.linalg.norm(blocks.edge[blocks.of_edge == 0] @ [[1, 0], [0, 1], [-1, 0], [0, -1]], axis=1).sum()
    )


@pytest.mark.parametrize(("overlap_m", "num_blocks"), [(0.005, 1), (0.3, 2)])
def test_footprints_that_overlap_share_no_wall(overlap_m: float, num_blocks: int) -> None:
    pair = np.array([shapely.box(0, 0, 8, 6), shapely.box(8 - overlap_m, 0, 16, 6)], dtype=object)
    assert len(set(find_blocks(pair).of_footprint)) == num_blocks


def test_a_block_of_which_geos_would_leave_nothing() -> None:
    """Two buildings of which eroding the common outline by 12 mm gave nothing: the search of their shift failed."""
    corner = [
        [8.46, -3.552],
        [4.49, 5.928],
        [-0.108, 4.002],
        [-1.836, 0.645],
        [2.969, -10.827],
        [5.195, -9.895],
    ]
    beside = [[4.49, 5.928], [8.46, -3.552], [10.858, 1.106], [9.867, 3.472]]
    pair = np.array(
        [affinity.translate(shapely.Polygon(each), 292_824, 6_832_718) for each in (corner, beside)]
    )
    blocks = find_blocks(pair)
    assert len(blocks) == 1 and len(blocks.edge)
    assert polygon_arrays.to_geometries(blocks.outline)[0].area == pytest.approx(
        shapely.area(pair).sum(), rel=0.01
    )


def decided(*estimates: tuple[float, float, float], is_own: bool = False) -> Shifts:
    """What is decided of blocks beside each other, by shifts and deviations."""
    rows = [Estimate(np.array(each[:2]), each[2], 0.1) for each in estimates]
    pairs = [(a, b) for a in range(len(rows)) for b in range(len(rows)) if a != b]
    return decide(rows, np.array(pairs, np.int64).reshape(-1, 2), np.full(len(rows), is_own))


def test_only_clear_evidence_moves_a_block() -> None:
    assert decided((1.0, 0.5, 0.15)).shift_m[0] == pytest.approx([1.0, 0.5])
    # below three tenths of a metre, footprints and roofs say the same
    assert (decided((0.2, 0.1, 0.05)).shift_m == 0).all()
    assert (decided((3.2, 0.0, 0.15)).shift_m == 0).all()
    # edges of one direction alone, or one that may mislead, say little
    assert (decided((0.0, 0.9, 50.0)).shift_m == 0).all()
    assert (decided((0.4, 0.0, 0.4)).shift_m == 0).all()
    assert decided((0.8, 0.0, 0.4)).shift_m[0] == pytest.approx([0.8, 0.0])
    # classes of p2wss itself show less
    assert (decided((0.6, 0.0, 0.15), is_own=True).shift_m == 0).all()
    assert (decided((0.8, 0.0, 0.45), is_own=True).shift_m == 0).all()
    assert decided((0.8, 0.0, 0.15), is_own=True).shift_m[0] == pytest.approx([0.8, 0.0])


def test_a_block_without_evidence_moves_as_all_around_it() -> None:
    around = [(1.5, 0.1, 0.15), (1.4, -0.1, 0.15), (1.6, 0.0, 0.15), (1.5, 0.2, 0.15), (1.5, -0.2, 0.15)]
    alike = decided(*around, (0.0, 0.0, np.inf))
    assert alike.source.tolist() == [EDGES] * 5 + [registration.AROUND]
    assert alike.shift_m[5] == pytest.approx([1.5, 0.0]) and np.isnan(alike.overhang_m[5])
    assert 0.15 < alike.sd_m[5] < 0.35
    # evidence of its own that says something else is used only if it is clear
    assert decided(*around, (-1.0, 0.0, 0.9)).shift_m[5] == pytest.approx([1.5, 0.0])
    assert decided(*around, (-1.0, 0.0, 0.2)).shift_m[5] == pytest.approx([-1.0, 0.0])
    # where the others are in place, and where they do not agree
    in_place = decided(*((x - 1.5, y, sd) for x, y, sd in around), (0.0, 0.0, np.inf))
    assert (in_place.shift_m == 0).all() and in_place.source[5] == registration.AROUND
    apart = decided((1.5, 0.0, 0.15), (-1.0, 1.0, 0.15), (0.0, -1.2, 0.15), (0.0, 0.0, np.inf))
    assert apart.source[3] == NOTHING and np.isnan(apart.sd_m[3]) and (apart.shift_m[3] == 0).all()
    assert decided((1.5, 0.0, 0.15), (0.0, 0.0, np.inf)).source[1] == NOTHING


def test_a_block_moves_as_far_as_the_blocks_around_it_allow() -> None:
    """Evidence of its own and that around it are two observations, where they can be of one map."""
    in_place = [(0.1, 0.0, 0.1), (-0.1, 0.0, 0.1), (0.0, 0.1, 0.1), (0.0, -0.1, 0.1)]
    assert decided((0.4, 0.0, 0.2)).shift_m[0] == pytest.approx([0.4, 0.0])
    assert (decided((0.4, 0.0, 0.2), *in_place).shift_m == 0).all()
    # the surer it is, the more it keeps
    sure = decided((0.4, 0.0, 0.1), *in_place)
    assert 0.3 < sure.shift_m[0, 0] < 0.4 and sure.sd_m[0] < 0.1
    # a block that moved alone
    assert decided((1.5, 0.0, 0.15), *in_place).shift_m[0] == pytest.approx([1.5, 0.0])


@pytest.mark.parametrize("num_around", [2, 3, 5, 12])
def test_the_deviation_of_what_is_around_holds(num_around: int) -> None:
    """A further block of the same distribution is within two of them in 95 of 100 cases, however few show it."""
    draw = np.random.default_rng(num_around)
    held = []
    for _ in range(2000):
        shift_m = draw.normal(0, 0.3, (num_around + 1, 2))
        expected_m, sd_m = shift_around(shift_m[1:])
        held.append(np.linalg.norm(shift_m[0] - expected_m) <= 2 * sd_m)
    assert 0.945 < np.mean(held) < 0.98


@pytest.mark.parametrize("share_missed", [0.0, 0.4])
def test_a_shift_depends_on_the_neighbourhood_alone(share_missed: float) -> None:
    """Far blocks, their order and the points elsewhere change nothing, to the bit. share_missed: of the roof points of
    one row of blocks, those that the producer missed."""
    shapes, parts = [], []
    for k in range(8):
        for row in (0, 1):
            moved = [affinity.translate(shape, 60 * k, 45 * row) for shape in BLOCK]
            shapes += moved
            parts.append(cloud_of(roofs(0.2), seed=2 * k + row))
            parts[-1] = Cloud(
                parts[-1].x_m + 60 * k,
                parts[-1].y_m + 45 * row,
                parts[-1].z_m,
                parts[-1].classification,
                LAMBERT,
            )
    draw = np.random.default_rng(1)
    by_block = np.repeat(draw.uniform(-1.2, 1.2, (16, 2)), 3, axis=0)
    shapes = [affinity.translate(shape, *shift) for shape, shift in zip(shapes, by_block, strict=True)]
    frame = frame_of(shapes)
    columns = [
        np.concatenate(c) for c in zip(*((p.x_m, p.y_m, p.z_m, p.classification) for p in parts), strict=True)
    ]
    is_missed = (
        (columns[3] == 6) & (columns[1] < ORIGIN[1] + 30) & (draw.random(len(columns[3])) < share_missed)
    )
    cloud = Cloud(
        columns[0], columns[1], columns[2], np.where(is_missed, 1, columns[3]).astype(np.uint8), LAMBERT
    )
    whole, whole_rows = registered(frame, cloud)
    assert np.median([np.linalg.norm(shift_of(whole_rows, k) + by_block[k]) for k in range(48)]) < 0.1
    is_chosen = np.zeros(48, bool)
    is_chosen[1] = True
    rows = registration.Surroundings(frame.geometry.to_numpy()).around(is_chosen)
    assert 2 < rows.sum() < 48
    subset = frame[rows].reset_index(drop=True)
    x_min, y_min, x_max, y_max = subset.total_bounds
    near = (
        (cloud.x_m > x_min - 10)
        & (cloud.x_m < x_max + 10)
        & (cloud.y_m > y_min - 10)
        & (cloud.y_m < y_max + 10)
    )
    order = draw.permutation(np.flatnonzero(near))
    window = Cloud(cloud.x_m[order], cloud.y_m[order], cloud.z_m[order], cloud.classification[order], LAMBERT)
    part, part_rows = registered(subset, window)
    row = subset.index[subset["building_id"] == "b1"][0]
    assert part_rows[row] == whole_rows[1]
    assert part.geometry.iloc[row].equals_exact(whole.geometry.iloc[1], 0)


def test_the_outputs_say_what_was_moved() -> None:
    frame = frame_of(BLOCK, (1.2, -0.7))
    cloud = cloud_of(roofs())
    moved, rows = registered(frame, cloud)
    results = run(Features.of(moved), cloud, None, "tile", Reconstruct(), registrations=rows)
    table = reconstruct_table(results, LAMBERT).to_frame()
    assert table["shift_x_m"].to_numpy() == pytest.approx(-1.2, abs=0.1)
    assert table["shift_y_m"].to_numpy() == pytest.approx(0.7, abs=0.1)
    assert (table["shift_source"] == "edges").all() and (table["shift_sd_m"] < 0.2).all()
    assert (
        table["overhang_m"].to_numpy() == pytest.approx(0.0, abs=0.1)
        and table["footprint_flags"].isna().all()
    )
    before = input_footprints(results, LAMBERT)
    assert before is not None
    assert before.to_frame().geometry.geom_equals_exact(frame.geometry, 0.002).all()
    assert not table.geometry.geom_equals_exact(frame.geometry, 0.5).any()
    # without a registration nothing is said about one
    plain = run(Features.of(frame), cloud, None, "tile", Reconstruct())
    assert input_footprints(plain, LAMBERT) is None
    assert set(reconstruct_table(plain, LAMBERT)["shift_x_m"]) == {None}


def flags_of(shapes: list[shapely.Polygon], roof: shapely.Geometry) -> list[registration.Registration]:
    return registered(frame_of(shapes), cloud_of(roof))[1]


def test_footprints_that_the_cloud_contradicts_are_flagged_with_the_area() -> None:
    gone = shapely.box(22, -10, 28, -2)
    rows = flags_of([*BLOCK, gone], roofs())
    assert [row.flags for row in rows] == [(), (), (), ("no-building",)]
    # the part of the second house beyond y = 4 is ground
    rows = flags_of([*BLOCK, gone], shapely.union_all([*BLOCK, gone]) - shapely.box(8, 4, 14, 9))
    assert [row.flags for row in rows] == [(), ("partly-demolished",), (), ()]
    assert rows[1].ground_inside_m2 == pytest.approx(30, abs=10)
    assert rows[1].shift_m == (0.0, 0.0)
    # the annex reaches 5 m further
    rows = flags_of([*BLOCK, gone], shapely.union_all([*BLOCK, gone, shapely.box(18, 0, 23, 5)]))
    assert [row.flags for row in rows] == [(), (), ("extended",), ()]
    assert rows[2].roof_outside_m2 == pytest.approx(25, abs=8)


def test_a_demolished_part_is_flagged_where_points_are_few() -> None:
    """Of a point per square metre, a third of the cells inside have none, and hardly any square of nine has nine."""
    cloud = cloud_of(shapely.box(0, 0, 10, 10))
    few = Cloud(
        *(each[::POINTS_PER_M2] for each in (cloud.x_m, cloud.y_m, cloud.z_m, cloud.classification)), LAMBERT
    )
    shapes = np.array([affinity.translate(shapely.box(0, 0, 20, 10), *ORIGIN)], object)
    assert contradictions(polygon_arrays.to_polygons(shapes), few).flags == [("partly-demolished",)]


def test_a_building_without_a_footprint_extends_none_of_its_neighbours() -> None:
    rows = flags_of(BLOCK, shapely.union_all([*BLOCK, shapely.box(21, 0, 27, 6)]))
    assert [(row.flags, row.roof_outside_m2) for row in rows] == [((), 0.0)] * 3


@pytest.mark.parametrize(("roof", "shift"), [(0.9, (0.0, 0.0)), (0.0, (0.2, 0.1)), (-0.5, (0.0, 0.0))])
def test_eaves_and_small_errors_are_no_contradiction(roof: float, shift: tuple[float, float]) -> None:
    _, rows = registered(frame_of(BLOCK, shift), cloud_of(roofs(roof)))
    assert [row.flags for row in rows] == [()] * 3


def test_the_log_counts_what_was_moved_and_flagged() -> None:
    gone = shapely.box(22, -10, 28, -2)
    far = affinity.translate(shapely.box(0, 0, 5, 5), 500, 0)
    frame = frame_of([*[affinity.translate(shape, 1.0, 0.0) for shape in BLOCK], gone, far])
    line = registration_summary(registered(frame, cloud_of(roofs()))[1])
    assert line.startswith("registration: 3 of 5 footprints moved, ")
    assert line.endswith(" m (columns shift_x_m, shift_y_m); 0 in place, 2 without evidence; no-building: 1")


def test_nothing_to_register() -> None:
    empty = Cloud(*(np.zeros(0),) * 3, np.zeros(0, np.uint8), LAMBERT)
    frame = frame_of(BLOCK)
    assert registered(frame.iloc[:0], cloud_of(roofs()))[1] == []
    for cloud in (empty, cloud_of(roofs())):
        # a rejected footprint has an empty polygon
        hollow = frame.set_geometry(gpd.GeoSeries([shapely.Polygon()] * 3, crs=LAMBERT))
        assert [row.source for row in registered(hollow, cloud)[1]] == [NOTHING] * 3
    rows = registered(frame, empty)[1]
    assert [(row.shift_m, row.shift_sd_m, row.flags) for row in rows] == [((0.0, 0.0), None, ())] * 3
    assert registration.Surroundings(hollow.geometry.to_numpy()).around(np.ones(3, bool)).all()
    assert registration.Surroundings(frame.geometry.to_numpy()[:0]).around(np.zeros(0, bool)).tolist() == []


@pytest.mark.parametrize("registers", [None, OWN_CLASSES])
def test_footprints_that_the_border_of_the_cloud_cuts_are_flagged(registers: int | None) -> None:
    """The second house has its last 3 m beyond all cells beside those with points; the third has no point."""
    long = shapely.box(7, 0, 19, 9)
    cloud = cloud_of(shapely.union_all([BLOCK[0], long]))
    is_seen = cloud.x_m < ORIGIN[0] + 12
    points = (each[is_seen] for each in (cloud.x_m, cloud.y_m, cloud.z_m, cloud.classification))
    seen = Cloud(*points, LAMBERT)
    each = None if registers is None else np.full(3, registers)
    _, rows = register(Features.of(frame_of([BLOCK[0], long, shapely.box(22, 0, 30, 9)])), seen, each)
    assert [row.flags for row in rows] == [(), ("beyond-points",), ()]
    _, rows = register(Features.of(frame_of([BLOCK[0], long])), cloud)
    assert [row.flags for row in rows] == [(), ()]


@pytest.mark.parametrize(
    ("num_per_m2", "is_hidden", "flags"),
    [(8.0, True, ("beyond-points",)), (8.0, False, ()), (0.4, False, ())],
)
def test_footprints_of_which_most_has_no_point_are_flagged_unless_points_are_few(
    num_per_m2: float, is_hidden: bool, flags: tuple[str, ...]
) -> None:
    """Of 7 m, 4.5 m in the middle, as under black glass, are near points on both sides; of a sparse cloud, most cells
    of 1 m of any roof have no point."""
    cloud = cloud_of(BLOCK[0])
    x_m = cloud.x_m - ORIGIN[0]
    is_seen = np.random.default_rng(9).random(len(cloud)) < num_per_m2 / POINTS_PER_M2
    is_seen &= (not is_hidden) | (x_m < 1.5) | (x_m > 6)
    seen = Cloud(
        *(each[is_seen] for each in (cloud.x_m, cloud.y_m, cloud.z_m, cloud.classification)), LAMBERT
    )
    shapes = polygon_arrays.to_polygons(np.array([affinity.translate(BLOCK[0], *ORIGIN)], object))
    assert contradictions(shapes, seen).flags == [flags]


def test_buildings_whose_ground_is_a_podium_are_flagged() -> None:
    """The ground of a cloud without classes is a podium that is wider than the filter of the ground, under a tower."""
    podium, tower, house = shapely.box(0, 0, 70, 70), shapely.box(30, 30, 42, 42), shapely.box(-22, 0, -12, 9)
    xy_m = np.random.default_rng(5).uniform(-40, 110, (50_000, 2))
    z_m = 100 + 0.05 * xy_m[:, 0]
    for shape, height_m in ((podium, 6.0), (tower, 30.0), (house, 6.0)):
        z_m[shapely.contains_xy(shape, *xy_m.T)] = 100 + height_m
    cloud = Cloud(*(xy_m + ORIGIN).T, z_m, np.ones(len(z_m), np.uint8), LAMBERT)
    cloud, features = with_classes(cloud)[0], Features.of(frame_of([tower, house]))
    assert ground_height(cloud, polygon_arrays.to_polygons(features.geometry))[0][0] > 105
    for registers, flags in ((OWN_CLASSES, ("raised-ground",)), (OWN_BUILDINGS, ())):
        assert [row.flags for row in register(features, cloud, np.full(2, registers))[1]] == [flags, ()]


def test_a_footprint_far_larger_than_the_cloud_takes_the_work_of_the_points(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A border of 100 by 100 km, of which a cloud covers a house: the cells of 3 m that it has are never made."""
    num_boxes, box = 0, shapely.box

    def counted(*sides_m: Any) -> Any:
        nonlocal num_boxes
        num_boxes += len(sides_m[0])
        assert num_boxes < 1e4
        return box(*sides_m)

    cloud = cloud_of(BLOCK[0])
    border = shapely.buffer(BLOCK[0], 5e4, quad_segs=2)
    shapes = polygon_arrays.to_polygons(np.array([affinity.translate(border, *ORIGIN)], object))
    monkeypatch.setattr(shapely, "box", counted)
    assert "beyond-points" in contradictions(shapes, cloud).flags[0]
    assert num_boxes > 0


def test_areas_that_contradict_do_not_depend_on_the_density() -> None:
    """Half of a footprint is open ground, and a part of the building is outside."""
    shapes = polygon_arrays.to_polygons(np.array([shapely.box(20, 20, 40, 30)], object))
    areas_m2 = []
    for seed in range(20):
        x, y = np.random.default_rng(seed).uniform(0, 60, (2, 3600))
        is_roof = (abs(x - 37.5) < 7.5) & (abs(y - 25) < 5)
        cloud = Cloud(x, y, np.zeros(len(x)), np.where(is_roof, 6, 2).astype(np.uint8), None)
        evidence = contradictions(shapes, cloud)
        areas_m2.append([evidence.ground_inside_m2[0], evidence.roof_outside_m2[0]])
    np.testing.assert_allclose(np.mean(areas_m2, axis=0), [100, 50], rtol=0.2)
