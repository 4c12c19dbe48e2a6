"""Footprints survive the conversion between all forms."""

import numpy as np
import pyarrow as pa
import shapely

from p2wss.data import polygon_arrays

SQUARE = shapely.Polygon([(0, 0), (10, 0), (10, 8), (0, 8)], [[(3, 3), (3, 5), (6, 5), (6, 3)]])
TRIANGLE = shapely.Polygon([(700_000, 6_800_000), (700_009, 6_800_000), (700_000, 6_800_007)])
SHAPES = [SQUARE, TRIANGLE, shapely.Polygon(), SQUARE, None, TRIANGLE]


def test_ragged_arrays_keep_rings_and_empty_polygons():
    polygons = polygon_arrays.to_polygons(SHAPES)
    assert len(polygons) == len(SHAPES)
    assert polygons.polygon_offset.tolist() == [0, 2, 3, 3, 5, 5, 6]
    assert polygons.ring_offset.tolist() == [0, 4, 8, 11, 15, 19, 22]
    back = polygon_arrays.to_geometries(polygons)
    assert all(
        a.equals_exact(b if b is not None else shapely.Polygon(), 0)
        for a, b in zip(back, SHAPES, strict=True)
    )


def test_columns_are_local_and_survive_a_round_trip():
    polygons = polygon_arrays.to_polygons(SHAPES)
    origin = polygon_arrays.origins(polygons)
    table = pa.table(polygon_arrays.to_columns(polygons, origin))
    assert max(abs(v) for row in table.column("footprint_xy_m").to_pylist() for v in row) <= 5
    assert table.column("ring_offset").to_pylist() == [[0, 4, 8], [0, 3], [0], [0, 4, 8], [0], [0, 3]]
    back = polygon_arrays.from_columns(table)
    polygon = np.repeat(np.arange(len(polygons)), np.diff(polygons.vertex_offset))
    np.testing.assert_array_equal(back.xy_m + origin[polygon], polygons.xy_m)
    np.testing.assert_array_equal(back.ring_offset, polygons.ring_offset)
    np.testing.assert_array_equal(back.polygon_offset, polygons.polygon_offset)


def test_take_selects_and_reorders():
    polygons = polygon_arrays.to_polygons(SHAPES)
    selection = polygon_arrays.to_geometries(polygon_arrays.take(polygons, np.array([5, 2, 0])))
    assert selection[0].equals(TRIANGLE) and selection[1].is_empty and selection[2].equals(SQUARE)
    assert len(polygon_arrays.take(polygons, np.zeros(len(SHAPES), bool))) == 0
