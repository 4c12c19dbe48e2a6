"""Towns of large buildings: their true roofs are closed, of many planes, and some are hard to classify."""

from __future__ import annotations

from collections import Counter

import numpy as np
from drawn_towns.large import SHAPES, draw_large
from drawn_towns.wings import true_solids

from p2wss.mesh import Mesh
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
        solid = Mesh.of_triangles(vertex_m, triangle)
        assert solid.is_closed
        num_planes.append(np.count_nonzero(~solid.planes.is_wall))
    assert np.median(num_planes) > 20 and max(num_planes) > 45
    assert max(each.footprint.area for each in town) > 5000
    assert 0 < sum(each.wings[0].seen_as != BUILDING_CLASS for each in town) < len(town)
    assert any(each.footprint.interiors and each.crowns for each in town)
