"""Fits of one height against buildings with known parameters."""

import numpy as np
import pytest
import shapely
from toy_roofs import sample

from p2wss.data.points import points_on_building
from p2wss.fit.parametric import Problem, edge_groups, evaluate, fit_roof
from p2wss.fit.points import even_order, every_kth
from p2wss.fit.settings import PARAMETRIC, Parametric
from p2wss.skeleton import Polygons
from p2wss.skeleton import roof_points as roof_points_of_kernel

RECTANGLE = np.array([[0, 0], [11, 0], [11, 7], [0, 7.0]])
ELL = np.array([[0, 0], [14, 0], [14, 6], [6, 6], [6, 12], [0, 12.0]])
OUTER = np.array([[0, 0], [24, 0], [24, 20], [0, 20.0]])
COURTYARD = np.array([[8, 7], [8, 13], [16, 13], [16, 7.0]])


@pytest.mark.parametrize(
    ("rings", "angle_deg"),
    [
        ([RECTANGLE], [35, 90, 35, 90]),
        ([RECTANGLE], [90, 48, 90, 48]),
        ([RECTANGLE], [30, 55, 30, 55]),
        ([RECTANGLE], [12, 90, 90, 90]),
        ([ELL], [40, 90, 40, 40, 90, 40]),
        ([OUTER, COURTYARD], [35] * 8),
    ],
)
def test_recovers_a_known_building(rings, angle_deg):
    point_m = sample(rings, angle_deg, 107.3, 400, noise_m=0.04)
    fit = fit_roof(rings, point_m)
    # whole degrees, up to the one that noise moves it by
    np.testing.assert_allclose(fit.angle_deg, angle_deg, atol=1)
    assert fit.eave_z_m == pytest.approx(107.3, abs=0.08)
    assert fit.loss_m < 0.05


def test_recovers_a_flat_roof_as_zero_degrees():
    point_m = sample([ELL], [0] * 6, 5.0, 200, noise_m=0.03)
    fit = fit_roof([ELL], point_m)
    assert fit.angle_deg.tolist() == [0] * 6
    assert fit.eave_z_m == pytest.approx(5.0, abs=0.01)


def test_a_roof_that_noise_of_few_points_tilts_is_flat():
    point_m = sample([RECTANGLE], [0] * 4, 5.0, 25, noise_m=0.1, seed=7)
    assert fit_roof([RECTANGLE], point_m).angle_deg.tolist() == [0] * 4


def test_outliers_do_not_move_the_roof():
    point_m = sample([RECTANGLE], [35, 90, 35, 90], 6.0, 300, noise_m=0.03)
    point_m[::12, 2] += 4.0
    fit = fit_roof([RECTANGLE], point_m)
    np.testing.assert_allclose(fit.angle_deg, [35, 90, 35, 90], atol=1)
    assert fit.eave_z_m == pytest.approx(6.0, abs=0.08)


def test_returns_from_a_wall_that_stands_back_are_not_a_steep_roof():
    point_m = sample([RECTANGLE], [35, 90, 35, 90], 6.0, 300, noise_m=0.03)
    rng = np.random.default_rng(1)
    wall_m = np.column_stack([np.full(20, 10.6), rng.uniform(2, 5, 20), rng.uniform(6.5, 8.0, 20)])
    fit = fit_roof([RECTANGLE], np.concatenate([point_m, wall_m]))
    np.testing.assert_allclose(fit.angle_deg, [35, 90, 35, 90], atol=1)


def test_a_steep_end_that_is_as_wide_as_a_roof_stays():
    point_m = sample([OUTER], [45, 63, 45, 63], 6.0, 600, noise_m=0.03)
    fit = fit_roof([OUTER], point_m, Parametric(num_points=600))
    np.testing.assert_allclose(fit.angle_deg, [45, 63, 45, 63], atol=2)


def test_edges_that_face_the_same_way_have_different_slopes_where_the_points_show_it():
    angle_deg = [40, 90, 25, 40, 45, 40]
    point_m = sample([ELL], angle_deg, 6.0, 400, noise_m=0.03)
    fit = fit_roof([ELL], point_m, Parametric(num_points=400))
    np.testing.assert_allclose(fit.angle_deg, angle_deg, atol=1)
    together = fit_roof([ELL], point_m, Parametric(num_points=400, separate_slope_gain_m=1.0))
    assert together.loss_m > fit.loss_m + 0.02


def loss_m(rings, angle_deg, eave_z_m, point_m, max_roof_height_m=np.inf, degree_cost_m=0.0):
    problem = Problem(
        Polygons.from_rings([list(rings)]),
        point_m,
        np.zeros(0, int),
        degree_cost_m,
        PARAMETRIC,
        max_roof_height_m,
    )
    return evaluate(problem, np.array([angle_deg], float), np.array([eave_z_m])).loss_m[0]


@pytest.mark.parametrize("seed", range(6))
def test_never_worse_than_a_flat_roof(seed):
    rng = np.random.default_rng(seed)
    angle_deg = rng.choice([0, 90, 25, 45, 60.0], len(ELL))
    point_m = sample([ELL], angle_deg, 5.0, 80, noise_m=0.3, seed=seed)
    point_m = point_m[np.isfinite(point_m[:, 2])]
    fit = fit_roof([ELL], point_m)
    flat = np.abs(point_m[:, 2] - np.median(point_m[:, 2])).clip(max=1.0).mean()
    assert fit.loss_m <= flat + 1e-9
    again = loss_m([ELL], fit.angle_deg, fit.eave_z_m, point_m, degree_cost_m=0.003 / len(point_m))
    assert again == pytest.approx(fit.loss_m, abs=1e-12)


def test_same_result_whatever_the_order_of_the_points():
    point_m = sample([ELL], [40, 90, 40, 40, 90, 40], 5.0, 500, noise_m=0.1)
    first = fit_roof([ELL], point_m)
    again = fit_roof([ELL], point_m[np.random.default_rng(1).permutation(len(point_m))])
    assert first.angle_deg.tolist() == again.angle_deg.tolist()
    assert first.eave_z_m == again.eave_z_m


def test_unusual_slopes_cost_a_little():
    """Up to 20 degrees count, of slopes alone."""
    point_m = sample([RECTANGLE], [35, 90, 60, 90], 6.0, 50)
    values = [RECTANGLE], [35, 90, 60, 90], 6.0, point_m
    assert loss_m(*values, degree_cost_m=0.01) - loss_m(*values) == pytest.approx(0.01 * (3 + 20))


def test_a_ring_of_many_edges_gets_the_best_simple_roof():
    turn = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    ring = np.column_stack([np.cos(turn), np.sin(turn)]) * 15
    point_m = np.column_stack([sample([RECTANGLE], [0] * 4, 6.0, 200)[:, :2] - 4, np.full(200, 6.0)])
    assert fit_roof([ring], point_m).loss_m < 0.05


def test_direction_groups():
    direction, axis = edge_groups([ELL])
    assert len(set(direction[[0, 2, 4]].tolist())) == 2 and len(set(direction.tolist())) == 4
    assert axis.tolist() == [0, 1, 0, 1, 0, 1]


@pytest.mark.parametrize("top_m", [np.inf, 1.0])
def test_the_loss_is_that_of_the_roof_of_the_kernel(top_m):
    angle_deg = np.array([40, 90, 25, 40, 45, 40.0])
    point_m = sample([ELL], angle_deg, 5.0, 300, noise_m=0.5, top_m=top_m)
    point_m = point_m[np.isfinite(point_m[:, 2])]
    exact = roof_points_of_kernel(
        Polygons.from_rings([[ELL]]), angle_deg, 5.0, point_m[:, :2], np.zeros(len(point_m), int),
        max_roof_height_m=top_m,
    )  # fmt: skip
    cosine = np.where(exact.edge >= 0, np.cos(np.radians(angle_deg[exact.edge])), 1.0)
    expected = np.minimum(np.abs(exact.z_m - point_m[:, 2]) * cosine, 1.0).mean()
    loss = loss_m([ELL], angle_deg, 5.0, point_m, top_m)
    assert loss == pytest.approx(expected, abs=1e-9)


def test_points_outside_count_in_full():
    ring = np.array([[0, 0], [9, 0], [9, 5], [0, 5.0]])
    point_m = np.array([[4, 2.5, 5.0], [-0.1, 2, 5.0], [4, 5.2, 5.0], [8.9, 2, 5.25]])
    assert loss_m([ring], np.zeros(4), 5.0, point_m) == pytest.approx((0 + 1 + 1 + 0.25) / 4)


def test_the_order_of_points_in_the_file_does_not_matter():
    rng = np.random.default_rng(0)
    point_m = np.round(rng.uniform(0, 3, (200, 3)), 1)
    point_m[50:100, 0] = point_m[:50, 0]
    shuffled = rng.permutation(point_m)
    assert np.array_equal(point_m[even_order(point_m)], shuffled[even_order(shuffled)])


def test_roof_points_are_those_over_the_footprint():
    polygon = shapely.Polygon(RECTANGLE)
    point_m = np.array([[1, 1, 9], [12, 1, 9], [2, 2, 9], [3, 3, 9], [4, 4, 1.0]])
    building = np.full(5, 6, np.uint8)
    assert points_on_building(polygon, np.tile(point_m, (4, 1)), np.tile(building, 4)).sum() == 16
    unclassified = np.ones(5, np.uint8)
    assert point_m[points_on_building(polygon, point_m, unclassified), 0].tolist() == [1, 2, 3]


def test_every_kth_along_the_curve_is_even():
    rng = np.random.default_rng(0)
    point_m = np.column_stack([rng.uniform(0, 16, (4096, 2)), np.zeros(4096)])
    chosen = point_m[even_order(point_m)][every_kth(4096, 64)]
    counts = np.histogram2d(chosen[:, 0], chosen[:, 1], bins=4, range=[[0, 16]] * 2)[0]
    # 4 each would be perfect; independent draws spread from 0 to 9
    assert counts.min() >= 2 and counts.max() <= 6
