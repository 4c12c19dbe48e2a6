"""Footprints of a block are cleaned as one coverage: neighbours keep the walls that they share, to the bit."""

from __future__ import annotations

from itertools import combinations, pairwise
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import shapely
from feature_tables import clean_footprints, read_footprints, read_whole_blocks
from hypothesis import given, settings
from hypothesis import strategies as st
from places import SHARED

from p2wss.config import Scenes
from p2wss.data import polygon_arrays
from p2wss.footprints.coverage import _Rings, block_numbers, clean_coverage, kernel_status

DELFT = SHARED / "data" / "delft_ahn3" / "footprints.gpkg"
OLEMPS = SHARED / "data" / "olemps_bdtopo" / "BATIMENT.shp"
DEFAULTS = Scenes()
# far from the origin, as in Lambert-93
FAR = np.array([652_000.0, 6_862_000.0])


def clean(shapes: list[shapely.Polygon], settings: Scenes = DEFAULTS) -> list[shapely.Polygon]:
    frame = gpd.GeoDataFrame(
        {"building_id": [f"B{i}" for i in range(len(shapes))]}, geometry=shapes, crs="EPSG:2154"
    )
    result = clean_footprints(frame, settings)
    assert list(result["status"]) == ["ok"] * len(shapes)
    return list(result.geometry)


def moved(shape: shapely.Polygon, turn_deg: float = 17.0) -> shapely.Polygon:
    turn = np.radians(turn_deg)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return shapely.transform(shape, lambda xy: xy @ rotation + FAR)


def wall_m(a: shapely.Polygon, b: shapely.Polygon, within_m: float = 5e-9) -> float:
    """The length of the wall that two polygons share."""
    # near the origin a buffer of nanometres is accurate; the differences are exact
    origin = np.floor(shapely.bounds(a)[:2])
    first, second = (shapely.transform(shape, lambda xy: xy - origin).boundary for shape in (a, b))
    return first.intersection(second.buffer(within_m)).length


def overlap_m2(shapes: list[shapely.Polygon]) -> float:
    """The area in which polygons overlap, but for the rounding of coordinates."""
    pieces = [a.intersection(b) for a, b in combinations(shapes, 2)]
    return sum(piece.area for piece in pieces if piece.area > 1e-7)


def row_of_houses(seed: int, count: int, gap_m: float, noise_m: float) -> list[shapely.Polygon]:
    """Houses of different depths side by side, so that each has a corner within its neighbour's wall. Every corner of
    each is off by noise, and there is a gap (or an overlap, if negative) between any two."""
    draw = np.random.default_rng(seed)
    houses, x = [], 0.0
    for k in range(count):
        width, depth = draw.uniform(5, 9), 9.0 + 2.5 * (k % 3)
        corner = np.array([[x, 0], [x + width, 0], [x + width, depth], [x, depth]])
        houses.append(moved(shapely.Polygon(corner + draw.uniform(-noise_m, noise_m, (4, 2)))))
        x += width + gap_m
    return houses


def corners(shape: shapely.Polygon) -> set[tuple[float, float]]:
    return set(map(tuple, shapely.get_coordinates(shape).tolist()))


@pytest.mark.parametrize("gap_m", [0.0, 0.05, -0.05])
@pytest.mark.parametrize("seed", range(8))
def test_a_row_with_gaps_or_overlaps_shares_whole_walls(gap_m: float, seed: int) -> None:
    houses = row_of_houses(seed, 6, gap_m, 0.01)
    result = clean(houses)
    assert overlap_m2(result) == 0
    for k, (a, b) in enumerate(pairwise(result)):
        shorter = 9.0 + 2.5 * min(k % 3, (k + 1) % 3)
        assert wall_m(a, b) == pytest.approx(shorter, abs=0.1)
        # both ends of the wall are corners of one of the two houses at least, and one end is a corner of both
        assert len(corners(a) & corners(b)) >= 1
    for before, after in zip(houses, result, strict=True):
        assert shapely.hausdorff_distance(before.boundary, after.boundary, densify=0.05) < 0.16
        assert len(corners(after)) == 4, "a corner of a neighbour within a wall is no vertex"


def test_a_corner_of_a_third_house_within_a_wall_lies_on_it() -> None:
    """A T-junction: the wall between the upper two ends within the long wall of the lower one."""
    lower = shapely.Polygon([(0, 0), (14, 0), (14, 8), (0, 8)])
    left, right = (
        shapely.Polygon([(0.02, 8.03), (6, 7.98), (6.02, 16), (0, 16)]),
        shapely.Polygon([(6, 7.98), (14.03, 8.02), (14, 16), (6.02, 16)]),
    )
    low, a, b = clean([moved(shape) for shape in (lower, left, right)])
    (junction,) = [c for c in corners(a) & corners(b) if shapely.Point(c).distance(low) < 0.1]
    assert junction not in corners(low)
    assert shapely.Point(junction).distance(low.boundary) < 1e-9
    assert wall_m(low, a) + wall_m(low, b) == pytest.approx(14, abs=0.05)


def test_a_house_that_fills_a_courtyard_and_one_within_it() -> None:
    outside = shapely.box(0, 0, 30, 30)
    filling, apart = shapely.box(10, 10, 20, 20), shapely.box(3, 3, 7, 7)
    yard = outside.difference(filling.buffer(0.03, join_style="mitre")).difference(
        apart.buffer(1.5, join_style="mitre")
    )
    ring, inner, alone = clean([moved(yard), moved(filling), moved(apart)])
    assert len(ring.interiors) == 2 and overlap_m2([ring, inner, alone]) == 0
    # the walls of the courtyard are the longer ones
    assert wall_m(ring, inner) == pytest.approx(4 * 10.06, abs=1e-6)
    assert corners(inner) <= corners(ring)
    assert alone.distance(ring) == pytest.approx(1.5, abs=1e-6)


def test_parts_of_a_multipolygon_may_touch_other_footprints() -> None:
    parts = shapely.MultiPolygon([shapely.box(0, 0, 8, 8), shapely.box(20, 0, 28, 8)])
    between = shapely.box(8.04, 0.01, 19.97, 8)
    frame = gpd.GeoDataFrame(
        {"building_id": ["a", "b"]}, geometry=[moved(parts), moved(between)], crs="EPSG:2154"
    )
    result = clean_footprints(frame, Scenes())
    assert list(result["building_id"]) == ["a-1", "a-2", "b"] and (result["status"] == "ok").all()
    first, last, middle = result.geometry
    assert wall_m(first, middle) == pytest.approx(8, abs=0.05) and wall_m(last, middle) == pytest.approx(
        8, abs=0.05
    )


def test_walls_keep_the_directions_of_their_longest_edges() -> None:
    """A corner that is cut off by 0.12 m is a corner again; the neighbour's wall beside it has the same ends."""
    left = shapely.Polygon([(0, 0), (10, 0), (10, 8), (0.12, 8), (0, 7.88)])
    right = shapely.Polygon([(10, 0), (18, 0), (18, 7.9), (17.9, 8), (10, 8)])
    cleaned = clean([moved(left), moved(right)])
    for shape in cleaned:
        along = np.diff(shapely.get_coordinates(shape), axis=0)
        turn_deg = (np.degrees(np.arctan2(along[:, 1], along[:, 0])) - 17) % 90
        assert len(along) == 4 and np.minimum(turn_deg, 90 - turn_deg).max() < 1e-5
    assert len(corners(cleaned[0]) & corners(cleaned[1])) == 2


@pytest.mark.parametrize("gap_m", [0.0, 0.06])
def test_walls_keep_their_directions_where_three_meet(gap_m: float) -> None:
    """A facade that turns by 0.13 m just before the deeper neighbour ends at the wall of that, straight on."""
    left = shapely.Polygon([(0, 0), (10, 0), (10, 8), (9.6, 8), (9.6, 7.87), (0, 7.87)])
    right = shapely.box(10 + gap_m, 0, 18, 10)
    cleaned = clean([moved(left), moved(right)])
    for shape in cleaned:
        along = np.diff(shapely.get_coordinates(shape), axis=0)
        turn_deg = (np.degrees(np.arctan2(along[:, 1], along[:, 0])) - 17) % 90
        assert len(along) == 4 and np.minimum(turn_deg, 90 - turn_deg).max() < 1e-5
    assert wall_m(*cleaned) == pytest.approx(7.87, abs=1e-6)


@pytest.mark.parametrize("step_m", [0.35, 0.5])
@pytest.mark.parametrize("turned_deg", [0.0, -3.0])
def test_a_step_between_long_walls_does_not_turn_them(step_m: float, turned_deg: float) -> None:
    """Both ends of the step are less than the tolerance off the line across it, which is 4 degrees off the walls."""
    turn = np.radians(turned_deg)
    front = np.array([[0, 0], [2.5, 0], [2.5, -step_m], [2.5 + 3 * np.cos(turn), 3 * np.sin(turn) - step_m]])
    # no other wall has their direction
    house = moved(shapely.Polygon([*front, (5.5, 10), (0, 8)]))
    (cleaned,) = clean([house], Scenes(simplify_m=0.3))
    before, along = shapely.get_coordinates(house)[:4], np.diff(shapely.get_coordinates(cleaned), axis=0)
    for wall in (before[1] - before[0], before[3] - before[2]):
        sine = np.abs(along @ [[0, -1], [1, 0]] @ wall) / np.hypot(*along.T) / np.hypot(*wall)
        assert np.degrees(np.arcsin(sine.min())) < 1


def test_a_slit_in_a_wall_is_closed_whose_sides_are_long() -> None:
    """Its sides are walls that turn where they vanish."""
    house = shapely.Polygon([(0, 0), (6, 0), (6.03, 2.5), (6.09, 0), (9, 0.0), (9, 7), (0, 7)])
    (cleaned,) = clean([moved(house)], Scenes(simplify_m=0.3))
    assert len(shapely.get_coordinates(cleaned)) == 5


def test_a_curve_of_short_edges_has_no_more_corners_than_it_needs() -> None:
    """Within 0.3 m of a circle of 8 m: walls may turn that are shorter than 1.5 m."""
    (cleaned,) = clean([moved(shapely.Point(0, 0).buffer(8, quad_segs=16))], Scenes(simplify_m=0.3))
    assert len(shapely.get_coordinates(cleaned)) - 1 <= 20


def test_a_gap_wider_than_snap_stays() -> None:
    a, b = shapely.box(0, 0, 8, 8), shapely.box(8.15, 0, 16, 8)
    for snap_m, distance_m in ((0.1, 0.15), (0.2, 0.0)):
        first, second = clean([moved(a), moved(b)], Scenes(snap_m=snap_m))
        assert first.distance(second) == pytest.approx(distance_m, abs=2e-3)


def test_without_snap_shared_corners_stay_in_place() -> None:
    houses = row_of_houses(3, 4, 0.0, 0.0)
    shared = [shapely.Polygon(np.round(shapely.get_coordinates(shape), 3)) for shape in houses]
    result = clean(shared, Scenes(snap_m=0, simplify_m=0))
    for before, after in zip(shared, result, strict=True):
        assert corners(after) <= corners(before)


def test_a_short_edge_shrinks_to_the_corner_where_walls_meet() -> None:
    """The corner that two houses share stays in place, and the vertex beside it, which one of them has, goes."""
    left = shapely.Polygon([(0, 0), (6, 0), (6, 8), (5.94, 8.03), (0, 8)])
    right = shapely.box(6, 0, 12, 8)
    a, b = clean([left, right], Scenes(snap_m=0, simplify_m=0))
    assert corners(a) == corners(shapely.box(0, 0, 6, 8)) and corners(b) == corners(right)


@pytest.mark.parametrize("turned", [False, True])
def test_neighbours_that_overlap_are_divided_where_fewer_corners_are_left(turned: bool) -> None:
    """A house in front of two reaches into them by up to 0.4 m, and keeps its wall: they end at it."""
    front = shapely.Polygon([(1, -8), (11, -8), (11, 0.4), (1, 0)])
    left, right = shapely.box(0, 0, 6, 8), shapely.box(6, 0, 12, 8)
    shapes = [moved(shape) for shape in (front, left, right)][:: -1 if turned else 1]
    result = clean(shapes, Scenes())
    assert overlap_m2(result) == 0
    assert sum(shape.area for shape in result) == pytest.approx(shapely.union_all(shapes).area, abs=0.1)
    assert sum(wall_m(a, b) for a, b in combinations(result, 2)) == pytest.approx(8 + 10, abs=0.5)


def test_real_overlaps_and_collapsing_footprints_are_no_error() -> None:
    """A roof over half a house, a duplicate, a strip narrower than the snap distance: each has a result or a reason."""
    house = shapely.box(0, 0, 10, 10)
    roof, strip = shapely.box(5, 5, 15, 15), shapely.box(10, 0, 10.05, 10)
    thin = shapely.box(10.05, 0, 10.1, 60)
    shapes = [moved(shape) for shape in (house, house, roof, strip, thin)]
    frame = gpd.GeoDataFrame({"building_id": list("abcde")}, geometry=shapes, crs="EPSG:2154")
    result = clean_footprints(frame, Scenes())
    assert sorted(result["status"].iloc[:2]) == ["duplicate", "ok"]
    assert result["status"].iloc[2] == "ok"
    assert result.geometry.iloc[:3].area.sum() == pytest.approx(175, rel=0.02)
    assert shapely.union_all(result.geometry.iloc[:3].to_numpy()).area == pytest.approx(175, rel=0.02)
    assert (result["status"].iloc[3:] != "ok").all()


def wkb(shapes: list[shapely.Polygon]) -> list[bytes]:
    return [shape.wkb for shape in shapes]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_neither_order_nor_other_blocks_change_anything(seed: int) -> None:
    draw = np.random.default_rng(seed)
    row = row_of_houses(seed, 5, float(draw.uniform(-0.06, 0.06)), 0.03)
    other = [
        shapely.transform(shape, lambda xy: xy + np.array([40.0, 35.0]))
        for shape in row_of_houses(seed + 1, 4, 0.0, 0.03)
    ]
    expected = wkb(clean(row))
    order = draw.permutation(9)
    mixed = clean([[*row, *other][k] for k in order])
    assert [mixed[list(order).index(k)].wkb for k in range(5)] == expected


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_any_tessellation_stays_one(seed: int) -> None:
    """Voronoi cells with noise: the result is valid, without overlaps, and shares as much wall."""
    draw = np.random.default_rng(seed)
    points = shapely.MultiPoint(draw.uniform(0, 40, (int(draw.integers(3, 25)), 2)))
    cells = shapely.get_parts(shapely.voronoi_polygons(points))
    cells = [cell.intersection(shapely.box(0, 0, 40, 40)) for cell in cells]
    cells = [moved(cell) for cell in cells if cell.area > 10]
    if len(cells) < 2:
        return
    noise = float(draw.choice([0.0, 0.01, 0.03]))
    noisy = [
        shapely.Polygon(
            shapely.get_coordinates(cell)[:-1]
            + draw.uniform(-noise, noise, (len(cell.exterior.coords) - 1, 2))
        )
        for cell in cells
    ]
    if not all(cell.is_valid for cell in noisy):
        return
    result = clean_coverage(np.array(noisy, object), Scenes())
    present = [shape for shape in result if shape is not None]
    assert len(present) >= len(noisy) - 1 and all(shape.is_valid for shape in present)
    if len(present) < len(noisy):
        return
    assert overlap_m2(present) < 1e-6
    before = sum(wall_m(a, b, 1e-6) for a, b in combinations(cells, 2))
    after = sum(wall_m(a, b) for a, b in combinations(present, 2))
    assert after > 0.98 * before - 0.5


def test_a_corner_of_a_neighbour_that_is_hardly_off_a_wall_moves_onto_it() -> None:
    """3 mm off the long wall of a row: the wall stays one edge, and both houses of it end there."""
    long = np.array([[0, 0], [20, 0], [20, 8], [8, 8.003], [0, 8]])
    above = [
        np.array([[0, 8], [8, 8.003], [8, 15], [0, 15]]),
        np.array([[8, 8.003], [20, 8], [20, 15], [8, 15]]),
    ]
    cleaned = clean([shapely.Polygon(each) for each in (long, *above)], Scenes())
    assert [len(shape.exterior.coords) - 1 for shape in cleaned] == [4, 4, 4]
    corner = min(shapely.get_coordinates(cleaned[1]).tolist(), key=lambda xy: abs(xy[0] - 8) + abs(xy[1] - 8))
    assert corner == pytest.approx([8, 8], abs=1e-9)
    assert overlap_m2(cleaned) == 0


def test_walls_of_two_houses_that_have_a_short_stretch_in_common_are_straight_together() -> None:
    """Each has a corner within the other's wall, 3 mm off: moved one by one, each would bend the other wall."""
    below = np.array([[0, 0], [10.3, 0], [10.3, 7.997], [0, 8]])
    above = np.array([[10, 8.003], [20, 8], [20, 15], [10, 15]])
    cleaned = clean([shapely.Polygon(below), shapely.Polygon(above)], Scenes())
    assert [len(shape.exterior.coords) - 1 for shape in cleaned] == [4, 4]
    assert wall_m(*cleaned) == pytest.approx(0.3, abs=1e-6)


def test_blocks_are_those_that_touch() -> None:
    shapes = np.array(
        [shapely.box(0, 0, 5, 5), shapely.box(30, 0, 35, 5), shapely.box(5.09, 0, 9, 5), shapely.Polygon()]
    )
    number = block_numbers(shapes, 0.1)
    assert number[0] == number[2] and len(set(number[[0, 1, 3]])) == 3


@pytest.mark.skipif(not DELFT.exists(), reason="no shared/data/delft_ahn3")
def test_the_houses_of_delft_share_their_walls() -> None:
    frame = read_footprints(DELFT)
    before = frame.geometry.to_numpy()
    after = np.array(clean(list(before), Scenes(simplify_m=0.3)), object)
    first, second = shapely.STRtree(before).query(before, predicate="dwithin", distance=1e-6)
    pairs = [(i, j) for i, j in zip(first.tolist(), second.tolist(), strict=True) if i < j]
    assert len(pairs) == 73
    assert all(after[i].distance(after[j]) < 2e-9 for i, j in pairs)
    assert overlap_m2(list(after)) == 0
    shared = sum(wall_m(before[i], before[j], 1e-6) for i, j in pairs)
    assert sum(wall_m(after[i], after[j]) for i, j in pairs) > 0.99 * shared > 600


@pytest.mark.skipif(not OLEMPS.exists(), reason="no shared/data/olemps_bdtopo")
def test_a_footprint_of_olemps_depends_on_its_block_only() -> None:
    frame = read_footprints(OLEMPS)
    everything = clean_footprints(frame, Scenes()).set_index("building_id")
    usable = everything[everything["status"] == "ok"]
    assert len(usable) >= 2270
    number = block_numbers(frame.geometry.to_numpy(), Scenes().snap_m)
    draw = np.random.default_rng(0)
    for _ in range(5):
        some = draw.choice(np.unique(number), 60, replace=False)
        rows = draw.permutation(np.flatnonzero(np.isin(number, some)))
        for row in clean_footprints(frame.iloc[rows], Scenes()).itertuples():
            whole = everything.loc[row.building_id]
            assert row.status == whole.status and row.geometry.wkb == whole.geometry.wkb
    # what the kernel takes for itself passes
    polygons = polygon_arrays.to_polygons(usable.geometry.to_numpy())
    assert (kernel_status(polygons) == 0).all()
    assert shapely.is_valid(usable.geometry.to_numpy()).all()


def test_whole_blocks_are_read_around_a_window(tmp_path: Path) -> None:
    """A row that leaves the window is read to its end, also where it comes back; what lies beside it is not."""
    row = [shapely.box(x, 0, x + 10.05, 9) for x in range(0, 300, 10)]
    hook = [shapely.box(290, 9.05, 300, 30), shapely.box(200, 30, 300, 39)]
    beside = [shapely.box(150, 12, 160, 20), shapely.box(150, -20, 160, -9)]
    frame = gpd.GeoDataFrame(
        {"building_id": [f"B{i}" for i in range(34)]}, geometry=[*row, *hook, *beside], crs="EPSG:2154"
    )
    path = tmp_path / "footprints.gpkg"
    frame.to_file(path)
    read = read_whole_blocks(path, (-5, -5, 25, 5), 0.1)
    assert list(read["building_id"]) == [f"B{i}" for i in range(32)]
    assert list(read_whole_blocks(path, (140, -30, 170, -8), 0.1)["building_id"]) == ["B33"]
    assert len(read_whole_blocks(path, (900, 0, 950, 50), 0.1)) == 0


@pytest.mark.skipif(not OLEMPS.exists(), reason="no shared/data/olemps_bdtopo")
@pytest.mark.parametrize("tile_size_m", [150.0, 330.0])
def test_any_tiling_of_olemps_gives_the_same_footprints(tile_size_m: float) -> None:
    everything = clean_footprints(read_footprints(OLEMPS), DEFAULTS).set_index("building_id")
    centre = everything[["centre_x_m", "centre_y_m"]].median()
    count, reached = 0, 0
    for column in range(-2, 2):
        x_min, y_min = centre + np.array([column, -0.5]) * tile_size_m
        window = (x_min, y_min, x_min + tile_size_m, y_min + tile_size_m)
        features = read_whole_blocks(OLEMPS, window, DEFAULTS.snap_m)
        inside = shapely.intersects(features.geometry.to_numpy(), shapely.box(*window))
        reached += int((~inside).sum())
        for row in clean_footprints(features, DEFAULTS).itertuples():
            whole = everything.loc[row.building_id]
            assert row.status == whole.status and row.geometry.wkb == whole.geometry.wkb
            count += 1
    assert count > 60 and reached > 0, "some blocks continue beyond their window"


def test_a_ring_that_has_become_an_edge_has_no_vertex_within_a_wall() -> None:
    """Before and after each of its nodes is the other one: there is no line between them."""
    rings = _Rings(np.array([0, 1]), np.array([0, 2]), np.array([0, 1]))
    with np.errstate(all="raise"):
        assert not rings._is_inner(np.array([[0.0, 0.0], [3.0, 1.0]]), 0.1).any()
