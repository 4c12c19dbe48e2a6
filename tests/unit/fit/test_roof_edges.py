"""Walls move inwards where open ground lies within the footprint, and only there."""

import numpy as np
import pytest

from p2wss.fit.roof_edges import move_walls

RING = np.array([[0, 0], [12, 0], [12, 8], [0, 8.0]])


def survey(
    angle_deg: float = 0.0, beyond_class: int = 2, begins_m: float = 0.6
) -> tuple[np.ndarray, np.ndarray]:
    """Points over the ring and 1 m around it; the building ends ``begins_m`` before the edge y = 0."""
    xy_m = np.random.default_rng(0).uniform((-1, -1), (13, 9), (2500, 2))
    x, y = xy_m.T
    is_roof = (x > 0) & (x < 12) & (y > begins_m) & (y < 8)
    z = np.where(is_roof, 6 + np.tan(np.radians(angle_deg)) * np.minimum(y - begins_m, 8 - y), 0)
    return np.column_stack([xy_m, z]), np.where(is_roof, 6, np.where(y < begins_m, beyond_class, 2))


def moved(point_m: np.ndarray, classes: np.ndarray, max_shift_m: float = 1.0) -> np.ndarray:
    inside = (point_m[:, :2] > 0).all(axis=1) & (point_m[:, :2] < RING[2]).all(axis=1)
    (ring,) = move_walls([RING], point_m[inside & (classes == 6)], point_m, classes, max_shift_m)
    return ring


@pytest.mark.parametrize("angle_deg", [0.0, 50.0])
def test_the_wall_moves_to_where_the_roof_begins(angle_deg):
    ring = moved(*survey(angle_deg))
    assert ring[:2, 1] == pytest.approx(0.65, abs=0.12) and ring[0, 1] == pytest.approx(ring[1, 1])
    assert ring[2:] == pytest.approx(RING[2:]) and ring[:2, 0] == pytest.approx(RING[:2, 0])


def test_it_moves_no_further_than_allowed():
    assert moved(*survey(), max_shift_m=0.4)[0, 1] == pytest.approx(0.4)
    assert np.array_equal(moved(*survey(), max_shift_m=0.0), RING)


@pytest.mark.parametrize("angle_deg", [0.0, 50.0])
def test_a_roof_up_to_the_edge_stays(angle_deg):
    assert np.array_equal(moved(*survey(angle_deg, begins_m=0.0)), RING)


def test_a_party_wall_stays():
    """The neighbour's lower roof, of class building, reaches into the footprint."""
    assert np.array_equal(moved(*survey(beyond_class=6)), RING)
