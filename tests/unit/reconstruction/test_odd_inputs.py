"""Whatever points and footprints there are, a building has a result: drawn from what computes badly."""

from __future__ import annotations

import numpy as np
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from toy_clouds import LAMBERT

from p2wss.clouds.reading import Cloud
from p2wss.config import Reconstruct, Scenes
from p2wss.data import reasons
from p2wss.footprints.cleaning import clean_footprints
from p2wss.reconstruction.pipeline import run
from p2wss.storage.features import Features

NUMBERS = st.one_of(st.integers(-4, 24).map(lambda n: n / 2), st.sampled_from([0.001, 9.999]))
PLACES = st.tuples(NUMBERS, NUMBERS)


@st.composite
def footprints(draw: st.DrawFn) -> shapely.Polygon:
    """A box with spikes, tiny edges and a courtyard anywhere; or any ring."""
    ring = [(0.0, 0.0), (10.0, 0.0), (10.0, 8.0), (0.0, 8.0)]
    if draw(st.booleans()):
        for at, place in draw(st.lists(st.tuples(st.integers(0, 4), PLACES), max_size=4)):
            ring.insert(at, place)
    else:
        ring = draw(st.lists(PLACES, min_size=3, max_size=9))
    (x, y), side = draw(PLACES), draw(st.sampled_from([0.0, 0.5, 3.0, 5.0]))
    hole = [[(x, y), (x + side, y), (x + side, y + side), (x, y + side)]] if side else []
    return shapely.Polygon(ring, hole)


@st.composite
def points(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) that are all equal, on a line, on a grid, three, repeated, very high or free; and their classes."""
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    num, z = draw(st.integers(1, 80)), draw(st.sampled_from([0.0, 3.0, 8.0, 9e3]))
    along = np.linspace(0, 1, num)
    spread = np.column_stack([rng.uniform(0, 10, num), rng.uniform(0, 8, num), np.full(num, z)])
    x, y = (each.ravel() for each in np.meshgrid(np.arange(0, 10, 0.5), np.arange(0, 8, 0.5)))
    roof = draw(
        st.sampled_from(
            [
                np.tile([5.0, 4.0, z], (num, 1)),
                np.column_stack([10 * along, 8 * along, z + 3 * along]),
                np.column_stack([x, y, z + np.minimum(y, 8 - y)]),
                spread[:3],
                np.repeat(spread[:6], 20, axis=0),
                spread + [0, 0, 1] * rng.choice([0.0, 8000.0, -500.0], (num, 1)),
                np.array(draw(st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS), min_size=1, max_size=40))),
            ]
        )
    )
    num_ground = draw(st.sampled_from([0, 4, 40]))
    ground = np.column_stack(
        [rng.uniform(-3, 0, num_ground), rng.uniform(-3, 11, num_ground), np.zeros(num_ground)]
    )
    classes = np.repeat([draw(st.sampled_from([6, 1, 5])), 2], [len(roof), num_ground])
    return np.vstack([roof, ground]).round(3), classes.astype(np.uint8)


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(footprints(), points())
def test_any_footprint_with_any_points_has_a_result(
    footprint: shapely.Polygon, cloud: tuple[np.ndarray, np.ndarray]
) -> None:
    names, shapes = np.array(["a"], object), np.array([footprint], object)
    features = clean_footprints(Features(shapes, {"building_id": names}, LAMBERT), Scenes())
    x, y, z = np.ascontiguousarray(cloud[0].T)
    for row in run(features, Cloud(x, y, z, cloud[1], LAMBERT), None, "tile", Reconstruct()):
        assert row.reason is None if row.status == "ok" else row.reason in reasons.MEANINGS
        assert row.reconstruction.has_mesh == (row.status != "none")
