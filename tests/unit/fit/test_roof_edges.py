"""Walls move inwards where open ground lies within the footprint, only there."""

import numpy as np
import pytest

from p2wss.fit.roof_edges import mean_overhang_m, move_walls, overhangs_m

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


def test_a_wall_moves_by_the_median_of_what_its_length_shows():
    """A bay of a third of the length reaches the edge."""
    point_m, classes = survey()
    x, y = point_m[:, :2].T
    is_bay = (x > 0) & (x < 4) & (y > 0) & (y < 0.6)
    point_m[is_bay, 2], classes[is_bay] = 6.0, 6
    assert moved(point_m, classes)[:2, 1] == pytest.approx(0.65, abs=0.12)


def test_a_vertex_twice_moves_with_its_wall():
    point_m, classes = survey()
    inside = (point_m[:, :2] > 0).all(axis=1) & (point_m[:, :2] < RING[2]).all(axis=1)
    twice = RING[[0, 0, 1, 2, 3]]
    (ring,) = move_walls([twice], point_m[inside & (classes == 6)], point_m, classes, 1.0)
    assert np.isfinite(ring).all() and ring[3:] == pytest.approx(twice[3:])


def test_it_moves_no_further_than_allowed():
    assert moved(*survey(), max_shift_m=0.4)[0, 1] == pytest.approx(0.4)
    assert np.array_equal(moved(*survey(), max_shift_m=0.0), RING)


@pytest.mark.parametrize("angle_deg", [0.0, 50.0])
def test_a_roof_up_to_the_edge_stays(angle_deg):
    assert np.array_equal(moved(*survey(angle_deg, begins_m=0.0)), RING)


def test_a_party_wall_stays():
    """The neighbour's lower roof, of class building, reaches into the footprint."""
    assert np.array_equal(moved(*survey(beyond_class=6)), RING)


def with_eaves(eaves_m: float, neighbour: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """A roof that reaches ``eaves_m`` beyond the edge y = 0 of the ring, with a lower neighbour beyond x = 12."""
    xy_m = np.random.default_rng(1).uniform((-1, -1), (13, 9), (4000, 2))
    x, y = xy_m.T
    is_roof = (x > 0) & (x < 12) & (y > -eaves_m) & (y < 8)
    z = np.where(is_roof, 6 + 0.4 * np.minimum(y, 8 - y), 0.0)
    classes = np.where(is_roof, 6, 2)
    if neighbour:
        beyond = (x >= 12) & (y > 0) & (y < 8)
        z[beyond], classes[beyond] = 3.0, 6
    return np.column_stack([xy_m, z]), classes


def test_the_overhang_of_each_edge_is_measured():
    overhang_m = overhangs_m(RING, *with_eaves(0.5))
    assert overhang_m[0] == pytest.approx(0.5, abs=0.06)
    assert overhang_m[1:] == pytest.approx([0, 0, 0], abs=0.1)
    assert mean_overhang_m(RING, *with_eaves(0.5)) == pytest.approx(0.5 * 12 / 40, abs=0.06)
    # within the footprint it is negative, and where a neighbour stands there is none
    assert overhangs_m(RING, *survey(begins_m=0.6))[0] == pytest.approx(-0.6, abs=0.1)
    assert np.isnan(overhangs_m(RING, *with_eaves(0.5, neighbour=True))).tolist() == [
        False,
        True,
        False,
        False,
    ]
    point_m, classes = with_eaves(0.5)
    assert np.isnan(overhangs_m(RING, point_m, np.where(classes == 2, 5, classes))).all()
    assert np.isnan(mean_overhang_m(RING, point_m[:0], classes[:0]))


def drawn_askew(near_m: float, far_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of a flat roof whose edge lies ``near_m`` behind the start of the edge y = 0, ``far_m`` behind its end."""
    point_m, _ = survey(begins_m=0.0)
    x, y = point_m[:, 0], point_m[:, 1]
    is_roof = (x > 0) & (x < 12) & (y < 8) & (y > near_m + (far_m - near_m) * x / 12)
    return np.column_stack([point_m[:, :2], np.where(is_roof, 6.0, 0.0)]), np.where(is_roof, 6, 2)


@pytest.mark.parametrize(("far_m", "within_m"), [(0.9, 0.5), (1.9, 1.0)])
def test_an_edge_that_is_drawn_askew_keeps_its_direction(far_m: float, within_m: float):
    """It moves to the middle of the wall, but no further than allowed."""
    ring = moved(*drawn_askew(0.1, far_m))
    assert ring[0, 1] == ring[1, 1] == pytest.approx(within_m, abs=0.12)
    assert np.abs(ring[:2, 0] - RING[:2, 0]).max() < 1e-6 and ring[2:] == pytest.approx(RING[2:])


def test_a_short_edge_between_two_that_move_goes_with_them():
    """A chamfer, which would be swallowed if it stayed."""
    ring = np.array([[0, 1.0], [1.0, 0], [12, 0], [12, 8], [0, 8.0]])
    point_m, _ = survey(begins_m=0.0)
    x, y = point_m[:, 0], point_m[:, 1]
    is_roof = (x > 0.6) & (x < 12) & (y > 0.6) & (y < 8) & (x + y > 1.9)
    point_m = np.column_stack([point_m[:, :2], np.where(is_roof, 6.0, 0.0)])
    (result,) = move_walls([ring], point_m[is_roof], point_m, np.where(is_roof, 6, 2), 1.0)
    assert result[[1, 2], 1] == pytest.approx(0.65, abs=0.15)
    assert result[[0, 4], 0] == pytest.approx(0.65, abs=0.15)
    chamfer = result[1] - result[0]
    assert np.hypot(*chamfer) > 0.5 and chamfer[0] > 0 > chamfer[1]
