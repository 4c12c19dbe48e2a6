"""Towns of large buildings: their true roofs are closed, of many planes, and some are hard to classify."""

from __future__ import annotations

from collections import Counter

import numpy as np
import shapely
from drawn_towns.large import SHAPES, draw_complexes, draw_large
from drawn_towns.planes import mesh_of
from drawn_towns.wings import true_solids

from p2wss.mesh.surface import topmost
from p2wss.towns.site import BUILDING_CLASS, in_lidar_tile


def test_large_buildings_have_closed_true_roofs_of_many_planes() -> None:
    towns = [draw_large(np.random.Generator(np.random.PCG64(seed))) for seed in (1, 1, 2)]
    one, again, other = towns
    assert [each.footprint for each in one] == [each.footprint for each in again]
    town = [*one, *other]
    assert set(Counter(each.kind for each in town)) == set(SHAPES)
    assert all(in_lidar_tile(each.footprint) for each in town)
    num_planes = []
    for vertex_m, triangle in true_solids(town):
        solid = mesh_of(vertex_m, triangle)
        assert solid.is_closed
        num_planes.append(np.count_nonzero(~solid.planes.is_wall))
    assert np.median(num_planes) > 20 and max(num_planes) > 45
    assert max(each.footprint.area for each in town) > 5000
    assert 0 < sum(each.wings[0].seen_as != BUILDING_CLASS for each in town) < len(town)
    assert any(each.footprint.interiors and each.crowns for each in town)


def test_complexes_have_closed_true_roofs_of_50_to_300_planes() -> None:
    """Their true roofs are as high as their bodies at any place."""
    num_planes = []
    for seed in (1, 2, 3):
        town = draw_complexes(np.random.Generator(np.random.PCG64(seed)))
        for building, (vertex_m, triangle) in zip(town, true_solids(town), strict=True):
            solid = mesh_of(vertex_m, triangle)
            assert building.footprint.geom_type == "Polygon" and in_lidar_tile(building.footprint)
            assert solid.is_closed
            num_planes.append(np.count_nonzero(~solid.planes.is_wall))
            low, high = np.array(building.footprint.bounds).reshape(2, 2)
            xy = np.random.default_rng(seed).uniform(low, high, (2000, 2))
            roof_m = np.full(len(xy), -np.inf)
            for wing in building.wings:
                is_in = shapely.contains_xy(shapely.Polygon(wing.outline), *xy.T) & (wing.detail == "")
                top_m = building.floor_m + wing.eave_m + wing.rise_m(xy[is_in])
                roof_m[is_in] = np.maximum(roof_m[is_in], top_m)
            start = building.wings[0].outline[0]
            corner_m = np.ascontiguousarray((solid.vertex_m - [*start, 0])[triangle])
            found_m = topmost(corner_m, np.column_stack([xy - start, np.zeros(len(xy))]))[1]
            np.testing.assert_allclose(found_m, roof_m, atol=0.003)
    assert min(num_planes) > 50 and 240 < max(num_planes) < 300
