"""The old town: its true roofs are closed, shafts are open, roofs reach over borders, the map is older."""

from __future__ import annotations

from collections import Counter

import numpy as np
import shapely
from drawn_towns.files import recorded
from drawn_towns.old import TROUBLES, draw_old, hillside_z_m
from drawn_towns.surface import Surface
from drawn_towns.wings import true_solids

from p2wss.towns.site import BUILDING_CLASS, UNCLASSIFIED_CLASS


def test_an_old_town_has_what_it_is_for() -> None:
    town = draw_old(np.random.Generator(np.random.PCG64(3)))
    counts = Counter(building.kind for building in town)
    assert len(town) > 800 and set(counts) == set(TROUBLES)
    assert all(building.footprint.is_valid for building in town)
    again = draw_old(np.random.Generator(np.random.PCG64(3)))
    assert all(a.footprint.equals(b.footprint) for a, b in zip(town, again, strict=True))


def test_true_roofs_reaching_roofs_and_shafts() -> None:
    rng = np.random.Generator(np.random.PCG64(3))
    town = draw_old(rng)
    shaft = next(building for building in town if building.kind == "shaft")
    gone = next(building for building in town if building.kind == "gone")
    (vertex_m, triangle), _ = true_solids([shaft, gone])
    assert len(triangle) >= 20 and vertex_m[:, 2].min() < shaft.floor_m + 0.01
    surface = Surface([shaft, gone], rng)
    well = next(wing for wing in shaft.wings if wing.detail == "shaft")
    z, kind = surface.at(*well.outline.mean(axis=0)[:, None])
    assert abs(z[0] - shaft.floor_m - well.eave_m) < 1e-6 and kind[0] != BUILDING_CLASS
    # a house that is gone leaves the ground
    middle = gone.wings[0].outline.mean(axis=0)[:, None]
    assert abs(surface.at(*middle)[0][0] - hillside_z_m(*middle)[0]) < 0.1
    # a roof beyond its wall continues its planes
    eaves = next(wing for wing in shaft.wings if wing.detail == "eaves")
    body = shaft.wings[0]
    place = body.outline.mean(axis=0)[None]
    assert np.isclose(eaves.eave_m + eaves.rise_m(place), body.eave_m + body.rise_m(place))[0]
    assert shapely.Polygon(eaves.outline).area > shapely.Polygon(body.outline).area


def test_points_that_are_not_recorded_or_have_another_class() -> None:
    rng = np.random.Generator(np.random.PCG64(4))
    town = draw_old(rng)
    for kind in ("few-points", "unclassified"):
        house = next(building for building in town if building.kind == kind)
        house.hidden_ground_m = 0.0
        xy = house.wings[0].outline.mean(axis=0) + rng.uniform(-0.5, 0.5, (1000, 2))
        points = {"x": xy[:, 0], "y": xy[:, 1], "classification": np.full(1000, BUILDING_CLASS, np.uint8)}
        keep = recorded([house], points, rng)
        assert (keep.mean() < 0.1) == (kind == "few-points")
        assert (points["classification"] == UNCLASSIFIED_CLASS).all() == (kind == "unclassified")
