"""The cropping kernel agrees with shapely."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from p2wss.clouds import cropping
from p2wss.clouds.cropping import crop_points, seen_share
from p2wss.data.polygon_arrays import to_polygons


def oracle(x, y, shapes, buffer_m):
    """Sorted pairs (polygon, point), and whether the point is inside."""
    points = shapely.points(x, y)
    polygon, point = shapely.STRtree(points).query(shapes, predicate="dwithin", distance=buffer_m)
    order = np.lexsort((point, polygon))
    return (
        polygon[order],
        point[order],
        shapely.contains_xy(shapes[polygon[order]], x[point[order]], y[point[order]]),
    )


def check(x, y, shapes, buffer_m):
    shapes = np.array(shapes, dtype=object)
    point, inside, offset = crop_points(x, y, to_polygons(shapes), buffer_m)
    polygon = np.repeat(np.arange(len(shapes)), np.diff(offset))
    order = np.lexsort((point, polygon))
    expected = oracle(x, y, shapes, buffer_m)
    np.testing.assert_array_equal(polygon[order], expected[0])
    np.testing.assert_array_equal(point[order], expected[1])
    differ = inside[order] != expected[2]
    at = shapely.points(x[point[order][differ]], y[point[order][differ]])
    # only a point on the boundary may be called inside by one and outside by the other
    assert (shapely.distance(shapely.boundary(shapes[polygon[order][differ]]), at) < 1e-9).all()
    return len(point)


def town(rng, count, extent_m, origin):
    shapes = []
    for _ in range(count):
        w, h = rng.uniform(4, 30, 2)
        shape = shapely.box(-w / 2, -h / 2, w / 2, h / 2)
        kind = rng.integers(4)
        if kind == 1:
            shape = shape.difference(shapely.box(0, 0, w, h))
        elif kind == 2 and min(w, h) > 8:
            shape = shape.difference(shapely.box(-w / 4, -h / 4, w / 4, h / 4))
        elif kind == 3:
            shape = shapely.Point(0, 0).buffer(w / 2, quad_segs=int(rng.integers(2, 40)))
        if rng.uniform() < 0.7:
            shape = shapely.affinity.rotate(shape, rng.uniform(0, 360))
        shapes.append(shapely.affinity.translate(shape, *(origin + rng.uniform(0, extent_m, 2))))
    return shapes


@pytest.mark.parametrize("count", [50_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_pairs_agree_with_dwithin(count):
    rng = np.random.default_rng(count)
    extent_m = np.sqrt(count / 10)
    origin = np.array([652_000.0, 6_861_000.0])
    xy = np.round(origin + rng.uniform(-5, extent_m + 5, (count, 2)), 3)
    pairs = check(xy[:, 0], xy[:, 1], town(rng, count // 1500, extent_m, origin), 1.0)
    assert pairs > count / 20


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.25, 1.0, 4.0, 16.0]))
def test_points_and_corners_on_a_grid(seed, buffer_m):
    # everything on whole quarters: many points lie on edges or at exactly the buffer's distance
    rng = np.random.default_rng(seed)
    x, y = rng.integers(-80, 160, (2, 400)) / 4 + 652_000.0
    shapes = []
    for _ in range(6):
        x0, y0, w, h = rng.integers(0, 60, 2).tolist() + rng.integers(3, 40, 2).tolist()
        shape = shapely.box(x0, y0, x0 + w, y0 + h)
        if min(w, h) > 4:
            shape = shape.difference(shapely.box(x0 + 1, y0 + 1, x0 + w - 2, y0 + h - 1))
        shapes.append(
            shapely.affinity.translate(
                shapely.affinity.scale(shape, 0.25, 0.25, origin=(0, 0)), 652_000, 652_000
            )
        )
    check(x, y, shapes, buffer_m)


def test_the_order_of_the_points_changes_only_their_indices():
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0, 60, (2, 3000))
    polygons = to_polygons(town(rng, 12, 60, np.zeros(2)))
    point, _, offset = crop_points(x, y, polygons, 1.0)
    shuffle = rng.permutation(len(x))
    again, _, same = crop_points(x[shuffle], y[shuffle], polygons, 1.0)
    np.testing.assert_array_equal(offset, same)
    for p in range(len(polygons)):
        assert set(point[offset[p] : offset[p + 1]]) == set(shuffle[again[offset[p] : offset[p + 1]]])


def test_scattered_buildings_need_no_cells_between_them(monkeypatch):
    """Such as 41 of a city, whose points were sorted into 16 million cells."""
    sizes, sort_points = [], cropping._sort_points

    def sorted_points(*arguments):
        result = sort_points(*arguments)
        sizes.append(len(result.start))
        return result

    monkeypatch.setattr(cropping, "_sort_points", sorted_points)
    rng = np.random.default_rng(5)
    corner = rng.uniform(0, 20_000, (20, 2))
    shapes = [shapely.box(x, y, x + 9, y + 7) for x, y in corner.tolist()]
    x, y = (corner[:, None] + rng.uniform(-4, 12, (20, 300, 2))).reshape(-1, 2).T.copy()
    assert check(x, y, shapes, 1.0) > 1000
    assert sizes[0] < 50_000


def test_a_polygon_far_away_makes_the_cells_of_a_town_no_larger(monkeypatch):
    """Each of its polygons was compared with all of its points."""
    grids, crop = [], cropping._crop

    def cropped(cells, grid, *arguments):
        grids.append(grid)
        return crop(cells, grid, *arguments)

    monkeypatch.setattr(cropping, "_crop", cropped)
    rng = np.random.default_rng(7)
    shapes = town(rng, 30, 300, np.array([652_000.0, 6_861_000.0]))
    shapes = [*shapes[:9], shapely.box(1.6e6, 7.5e6, 1.6e6 + 9, 7.5e6 + 9), shapely.Polygon(), *shapes[9:]]
    x, y = np.round(rng.uniform(-5, 305, (2, 20_000)), 3)
    x, y = x + 652_000.0, y + 6_861_000.0
    x[:50], y[:50] = x[:50] % 13 + 1.6e6 - 2, y[:50] % 13 + 7.5e6 - 2
    assert check(x, y, shapes, 1.0) > 1000
    assert max(grid.cell_m for grid in grids) == 4.0


def test_empty_polygons_and_no_points():
    polygons = to_polygons([shapely.Polygon(), shapely.box(0, 0, 2, 2), None])
    point, inside, offset = crop_points(np.array([1.0, 2.5, 9.0]), np.array([1.0, 1.0, 9.0]), polygons, 1.0)
    assert offset.tolist() == [0, 0, 2, 2]
    assert dict(zip(point.tolist(), inside.tolist(), strict=True)) == {0: True, 1: False}
    assert crop_points(np.zeros(0), np.zeros(0), polygons, 1.0)[2].tolist() == [0, 0, 0, 0]
    assert crop_points(np.ones(1), np.ones(1), to_polygons([]), 1.0)[2].tolist() == [0]


def test_seen_share_counts_cells_of_one_metre():
    x_m, y_m = np.array([0.5, 0.6, 3.5, 4.5]), np.array([0.5, 0.6, 2.5, 0.5])
    assert seen_share(shapely.box(0, 0, 4, 3), x_m, y_m) == 2 / 12
    without_cell = shapely.box(0.1, 0.1, 0.3, 0.3)
    assert seen_share(without_cell, x_m[:1], y_m[:1]) == 1 and seen_share(without_cell, x_m[:0], y_m[:0]) == 0
    assert seen_share(shapely.Polygon(), x_m, y_m) == 0
