"""Roofs of planes: what is detected in points, the cells between lines, the cheapest labels, and the solid below."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import shapely
from cell_costs import all_costs
from scipy.sparse.csgraph import maximum_flow
from scipy.spatial import cKDTree

from p2wss.fit.directions import directions
from p2wss.fit.planes import arrangement, lines
from p2wss.fit.planes.arrangement import GRID_M, _pieces, arrange
from p2wss.fit.planes.costs import candidates_of, costs_of
from p2wss.fit.planes.detection import RoofPlanes, _merged, detect, height_over, heights, payable
from p2wss.fit.planes.fit import PlanesFit, _without_pinches, fit_planes
from p2wss.fit.planes.labelling import least_cost
from p2wss.fit.planes.lines import Line, edges_of, ends_of, lines_of
from p2wss.fit.planes.regularity import regular
from p2wss.fit.planes.solid import _Borders, at_pinch, solid_below
from p2wss.fit.settings import Limits, Planes
from p2wss.mesh import Mesh
from p2wss.mesh.repair import surfaces_to_write
from p2wss.mesh.topology import doubled_areas, is_closed, unit_normals
from p2wss.skeleton import FaceKind
from p2wss.skeleton.groups import cell_neighbours

PLANES = Planes()
SLOPE = np.tan(np.radians(40))


def sampled(rings: list[np.ndarray], plane: np.ndarray, seed: int, density: float = 12.0) -> np.ndarray:
    """Points (m, 3) with noise on the lower of the planes, over a footprint."""
    rng = np.random.default_rng(seed)
    low, high = rings[0].min(axis=0), rings[0].max(axis=0)
    xy_m = rng.uniform(low, high, (int(density * np.prod(high - low)), 2))
    polygon = shapely.Polygon(rings[0], rings[1:])
    xy_m = xy_m[shapely.contains_xy(polygon, xy_m[:, 0], xy_m[:, 1])]
    return np.column_stack([xy_m, heights(plane, xy_m).min(axis=1) + rng.normal(0, 0.03, len(xy_m))])


def gable(length_m: float, width_m: float, eave_m: float, turn: float) -> tuple[list[np.ndarray], np.ndarray]:
    """(rings, planes (2, 3)) of a gable roof around the origin, along a direction."""
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length_m / 2, width_m / 2]
    across = np.array([0.0, SLOPE]) @ rotation
    top_m = eave_m + SLOPE * width_m / 2
    return [corner @ rotation], np.array([[*across, top_m], [*-across, top_m]])


def residuals_m(fit: PlanesFit, point_m: np.ndarray) -> np.ndarray:
    """Heights between the roof and points (m, 3) over it."""
    xy_m = point_m[:, :2]
    return np.abs(height_over(fit.plane, fit.label[fit.cells.cells_at(xy_m)], xy_m) - point_m[:, 2])


def volume_m3(mesh: Mesh) -> float:
    a, b, c = mesh.vertex_m[mesh.triangle].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("turn", [0.0, 0.3, 1.1])
def test_the_planes_of_a_gable_roof_are_found_and_made_regular(turn: float) -> None:
    rings, plane = gable(12, 8, 4, turn)
    point_m = sampled(rings, plane, 1)
    found = detect(point_m, 12.0, directions(rings, 4.0), PLANES.detection)
    assert len(found.plane) == 2
    assert (found.label >= 0).mean() > 0.98
    along = directions(rings, 4.0)
    exact = regular(found, point_m, along)
    steep = np.hypot(exact[:, 0], exact[:, 1])
    assert steep[0] == pytest.approx(steep[1], abs=1e-12)
    assert abs(exact[0, :2] @ exact[1, :2]) == pytest.approx(steep[0] * steep[1])
    assert np.degrees(np.arctan(steep[0])) == pytest.approx(40, abs=0.7)


@pytest.mark.parametrize("num_points", [12, 30, 100])
def test_few_points_show_the_planes_of_a_gable_roof_beside_a_level_annex(num_points: int) -> None:
    rings, plane = gable(12, 8, 4, 0.3)
    turn = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    annex_m = np.random.default_rng(3).uniform([6, -4], [10, 4], (num_points // 3, 2)) @ turn
    annex_m = np.column_stack([annex_m, np.full(len(annex_m), 2.5)])
    point_m = np.vstack([sampled(rings, plane, 1)[:num_points], annex_m])
    found = detect(point_m, num_points / 96, directions(rings, 4.0), PLANES.detection)
    off_m = np.abs(heights(found.plane, point_m[:, :2]) - point_m[:, 2:]).min(axis=1)
    assert len(found.plane) == 3
    assert (off_m < 0.15).all() and (found.label >= 0).mean() > 0.9


def test_planes_are_found_where_the_surface_around_a_point_shows_nothing() -> None:
    rings, plane = gable(12, 8, 4, 0.3)
    along, num_found = directions(rings, 4.0), []
    for seed in range(20):
        few = sampled(rings, plane, seed)[:14]
        num_found.append(len(detect(few, 14 / 96, along, PLANES.detection).plane))
    assert num_found.count(2) >= 17


@pytest.mark.parametrize(("hidden_m", "height_m"), [(4.0, 4.0), (1.0, 4.0 + 8 * SLOPE)])
def test_a_side_of_a_gable_that_is_hidden_falls_as_steeply_as_the_other(
    hidden_m: float, height_m: float
) -> None:
    """The roof rises over 8 m of which the last ones are hidden: half of it, or nearly nothing of a shed."""
    rings, plane = gable(10, 8, 4, 0.0)
    point_m = sampled(rings, plane[:1], 3)
    point_m = point_m[point_m[:, 1] < 4 - hidden_m]
    fit = fit_planes(rings, point_m, PLANES)
    assert fit is not None
    at_wall = fit.mesh.vertex_m[np.isclose(fit.mesh.vertex_m[:, 1], 4)]
    assert at_wall[:, 2].max() == pytest.approx(height_m, abs=0.2)
    assert fit.num_bodies == 1 and is_closed(fit.mesh.vertex_m, fit.mesh.triangle)


def test_no_roof_falls_below_the_ground() -> None:
    """Of a steep roof only the upper third is seen: further down its plane is below the ground."""
    rings = [np.array([[0, 0], [12, 0], [12, 8], [0, 8.0]])]
    rng = np.random.default_rng(0)
    xy_m = rng.uniform([8, 0], [12, 8], (300, 2))
    point_m = np.column_stack([xy_m, 1.5 * (xy_m[:, 0] - 6) + rng.normal(0, 0.02, 300)])
    assert fit_planes(rings, point_m, PLANES) is None


def test_where_high_and_low_roofs_touch_in_a_corner_one_of_them_gives_way_there() -> None:
    """Quarters of a square, high and low in turn: no solid has an upright edge of four walls."""
    square = np.array([[0.0, 0.0], [12.0, 0.0], [12.0, 12.0], [0.0, 12.0]])
    rng = np.random.default_rng(5)
    xy_m = rng.uniform(0, 12, (1500, 2))
    high = (xy_m > 6).sum(axis=1) % 2 == 1
    point_m = np.column_stack([xy_m, np.where(high, 8.0, 4.0) + (xy_m[:, 0] > 6) + rng.normal(0, 0.02, 1500)])
    fit = fit_planes([square], point_m, PLANES)
    assert fit is not None
    off_m = np.abs(height_over(fit.plane, fit.label[fit.cells.cells_at(xy_m)], xy_m) - point_m[:, 2])
    # one quarter is lost, all others are as they were measured
    assert 0.2 < np.mean(off_m > 0.2) < 0.3


@pytest.mark.parametrize("limits", [Limits(num_planes=2), Limits(num_lines=6), Limits(num_places=16)])
def test_of_too_many_planes_the_largest_are_built(limits: Limits) -> None:
    """Four flat roofs side by side, each larger and higher than the one before."""
    edge_m = np.array([0.0, 3.0, 8.0, 16.0, 30.0])
    square = np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 10.0], [0.0, 10.0]])
    rng = np.random.default_rng(3)
    xy_m = rng.uniform(0, [30, 10], (1800, 2))
    number = np.searchsorted(edge_m, xy_m[:, 0]) - 1
    point_m = np.column_stack([xy_m, 4.0 + 2 * number + rng.normal(0, 0.02, len(xy_m))])
    whole, few = (fit_planes([square], point_m, each) for each in (PLANES, PLANES._replace(limits=limits)))
    assert whole is not None and len(whole.plane) == 4 and not whole.is_simplified
    assert few is not None and len(few.plane) < 4 and few.is_simplified
    over_m = height_over(few.plane, few.label[few.cells.cells_at(xy_m)], xy_m) - point_m[:, 2]
    assert np.abs(over_m[number == 3]).max() < 0.2
    assert fit_planes([square], point_m, PLANES._replace(limits=Limits(num_lines=3))) is None


def test_points_along_a_line_show_no_steep_roof() -> None:
    """Returns from a wall: a plane of any slope across the line is near to them."""
    y = np.linspace(0, 6, 13)
    x = 0.1 + np.where(np.arange(13) % 2, 0.005, -0.005)
    wall_m = np.column_stack([x, y, 5 + 2 * y + 15 * (x - 0.1)])
    roof_m = np.column_stack([each.ravel() for each in np.meshgrid(np.arange(1.0, 9), np.arange(0.0, 7))])
    point_m = np.vstack([wall_m, np.column_stack([roof_m, np.full(len(roof_m), 3.0)])])
    found = detect(point_m, 1.0, (0.0,), PLANES.detection)
    assert len(found.plane) == 1 and np.abs(found.plane[0] - [0, 0, 3]).max() < 1e-6
    assert (found.label[:13] == -1).all() and (found.label[13:] == 0).all()


@pytest.mark.parametrize(("angle_deg", "is_roof"), [(65.0, True), (80.0, True), (86.0, False), (90.0, False)])
def test_what_is_steeper_than_a_spire_is_a_wall(angle_deg: float, is_roof: bool) -> None:
    rng = np.random.default_rng(8)
    x, z = rng.uniform(0, 10, 800), rng.uniform(1, 6, 800)
    point_m = np.column_stack([x, z / np.tan(np.radians(angle_deg)) + rng.normal(0, 0.06, 800), z])
    found = detect(point_m, 12.0, [0.0], PLANES.detection)
    assert ((found.label >= 0).mean() > 0.5) == is_roof


def test_planes_are_found_though_lines_of_the_scanner_are_far_apart() -> None:
    """The nearest points of each are on its own line: many planes have that in common."""
    xy_m = np.array([(x, y) for x in np.arange(0, 18, 0.9) for y in np.arange(0, 16, 0.1)])
    turn = np.radians(30.0)
    xy_m = xy_m @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    draw = np.random.default_rng(0)
    xy_m += draw.normal(0, 0.03, xy_m.shape)
    height_m = 9 - 0.6 * np.abs(xy_m[:, 0] - 4) + draw.normal(0, 0.02, len(xy_m))
    found = detect(np.column_stack([xy_m, height_m]), 11.0, (0.0,), PLANES.detection)
    assert len(found.plane) == 2 and np.mean(found.label >= 0) > 0.95
    assert found.plane[np.argsort(found.plane[:, 0]), :2] == pytest.approx(
        np.array([[-0.6, 0], [0.6, 0]]), abs=0.01
    )


@pytest.mark.parametrize("seed", range(4))
def test_the_ridge_between_two_low_slopes_is_where_it_is(seed: int) -> None:
    """Within 15 cm of the ridge a point is hardly nearer to its own slope, and the first planes have points of both."""
    rng = np.random.default_rng(seed)
    xy_m = rng.uniform([0, -11], [50, 11], (9000, 2))
    fall = np.where(xy_m[:, 1] > 0, *np.tan(np.radians([2.9, -1.7]))) * xy_m[:, 1]
    found = detect(
        np.column_stack([xy_m, 8 - fall + rng.normal(0, 0.03, 9000)]), 8.2, [0.0], PLANES.detection
    )
    assert len(found.plane) == 2
    a, b, c = found.plane[0] - found.plane[1]
    assert abs((a * 25 + c) / b) < 0.12


@pytest.mark.parametrize(("num_along", "num_planes"), [(9, 2), (7, 1)])
def test_the_least_area_of_a_plane_is_that_of_its_surface(num_along: int, num_planes: int) -> None:
    """The side of a dormer, at 45 degrees: of 1.15 m2, and 0.81 in plan; of 0.7 m2."""
    grid_m = np.stack(np.meshgrid(np.arange(80.0), np.arange(80.0)), axis=-1).reshape(-1, 2) / 10
    is_on = ((grid_m > 3.95) & (grid_m < 3.95 + num_along / 10)).all(axis=1)
    z_m = np.where(is_on, grid_m[:, 0], 3.0)
    found = detect(np.column_stack([grid_m, z_m]), 100.0, (0.0,), PLANES.detection)
    assert len(found.plane) == num_planes


@pytest.mark.parametrize(("num_along", "num_planes"), [(3, 2), (1, 1)])
def test_a_dormer_of_few_points_is_found_beside_a_slope_of_many(num_along: int, num_planes: int) -> None:
    """With four points per square metre, a dormer of 1.5 m2 has fewer points than surfaces around them need; of 0.5 m2
    it is none."""
    grid_m = np.stack(np.meshgrid(np.arange(16.0), np.arange(12.0)), axis=-1).reshape(-1, 2) / 2
    (x, y), z_m = grid_m.T, 3 + 0.7 * grid_m[:, 1]
    is_on = (x > 3.9) & (x < 3.9 + num_along / 2) & (y > 2.9) & (y < 3.9)
    z_m[is_on] = 6.2
    found = detect(np.column_stack([grid_m, z_m]), 4.0, (0.0,), PLANES.detection)
    assert len(found.plane) == num_planes
    assert (found.plane[found.label[is_on]] == [0.0, 0.0, 6.2]).all() == (num_planes == 2)


def test_points_off_every_plane_have_none() -> None:
    rings, plane = gable(12, 8, 4, 0.3)
    point_m = sampled(rings, plane, 2)
    point_m[::40, 2] += 2.0
    found = detect(point_m, 12.0, directions(rings, 4.0), PLANES.detection)
    assert len(found.plane) == 2
    assert (found.label[::40] == -1).all()


def test_two_halves_of_a_plane_become_one_and_two_slopes_do_not() -> None:
    rings, plane = gable(12, 8, 4, 0.0)
    point_m = sampled(rings, plane, 6)
    neighbour = cKDTree(point_m).query(point_m, 12)[1]
    quarter = 2 * (point_m[:, 1] > 0) + (point_m[:, 0] > 0)
    merged, label = _merged(point_m, plane[[0, 0, 1, 1]], quarter, neighbour, 8, PLANES.detection)
    assert len(merged) == 2
    assert len(np.unique(np.column_stack([label, quarter // 2]), axis=0)) == 2


def test_planes_that_agree_are_the_same_but_for_others_of_their_slope() -> None:
    # two patches of one plane, detected 4 mm apart, the other side of the ridge, and a wing 0.3 m lower
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 4, (2, 4, 200)) + np.array([[[0], [8], [0], [16]], [[0], [0], [5], [0]]])
    truth = np.array([[0, 0.5, 5], [0, 0.5, 5], [0, -0.5, 9.5], [0, 0.5, 4.7]])
    z = truth[:, 1:2] * y + truth[:, 2:] + rng.normal(0, 0.02, (4, 200))
    point_m = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    found = truth + np.array([[0, 0, 0.001], [0, 0, -0.003], [0, 0, 0], [0, 0, 0]])

    planes = RoofPlanes(found, np.repeat(np.arange(4), 200), np.zeros((800, 1), int), PLANES.detection)
    plane = regular(planes, point_m, [0.0])

    assert (plane[0] == plane[1]).all()
    assert len(np.unique(plane, axis=0)) == 3


@pytest.mark.parametrize(("step_m", "num_kept"), [(0.2, 1), (1.0, 2)])
def test_a_plane_that_saves_less_than_a_face_costs_is_no_candidate(step_m: float, num_kept: int) -> None:
    # 1 m2 above a roof, at 4 points per m2
    x, y = np.meshgrid(np.arange(8) / 2, np.arange(8) / 2)
    is_on = ((x > 0.9) & (x < 1.6) & (y > 0.9) & (y < 1.6)).ravel()
    point_m = np.column_stack([x.ravel(), y.ravel(), 5 + step_m * is_on])
    _, neighbour = cKDTree(point_m[:, :2]).query(point_m[:, :2], 9)
    plane = np.array([[0, 0, 5], [0, 0, 5 + step_m]])
    planes = RoofPlanes(plane, is_on.astype(int), neighbour, PLANES.detection)
    found = payable(point_m, planes, plane, 0.25, PLANES.prices)
    assert found.plane.tolist() == plane[:num_kept].tolist()
    assert found.label.tolist() == (is_on * (num_kept - 1)).tolist()


def test_of_two_planes_that_save_little_beside_each_other_one_stays() -> None:
    # 1 m2 each, 6 cm apart; without both, there would be no roof
    height_m = 5 + 0.06 * np.repeat([0, 1], 4)
    point_m = np.column_stack([np.arange(8) / 2, np.zeros(8), height_m])
    plane = np.array([[0, 0, 5], [0, 0, 5.06]])
    planes = RoofPlanes(plane, np.repeat([0, 1], 4), np.tile(np.arange(8), (8, 1)), PLANES.detection)
    found = payable(point_m, planes, plane, 0.25, PLANES.prices)
    assert len(found.plane) == 1 and (found.label == 0).all()


def test_faces_of_a_solid_are_those_of_its_planes_however_little_these_differ() -> None:
    square = np.array([[0, 0], [10, 0], [10, 6], [0, 6.0]])
    cells = arrange([square], [Line(np.array([1.0, 0.0]), 4.0)])
    # they meet over the line, and are less than 4 mm apart everywhere
    plane = np.array([[0.0, 0.0, 5.0], [5e-4, 0.0, 5.0 - 4 * 5e-4]])
    mesh = solid_below(cells, (cells.middle_m[:, 0] > 4).astype(int), plane, square)

    assert mesh is not None and mesh.is_closed
    # two roofs, four walls, and the floor, none with a corner within
    assert len(mesh.surfaces) == 7 and (mesh.num_planes_at >= 3).all()
    over = mesh.corner_m[mesh.kind == FaceKind.FLAT].mean(axis=1)
    np.testing.assert_allclose(over[:, 2], heights(plane, over[:, :2]).max(axis=1), atol=1e-12)


def test_no_side_turns_around_where_its_ends_move_to_different_lines() -> None:
    rectangle = np.array([[0, 0], [8, 0], [8, 7], [0, 7.0]])
    cells = arrange(
        [rectangle], [Line(np.array(n), o) for n, o in (([1.0, 0], 4), ([0, 1.0], 3.5), ([0, 1.0], 3.52))]
    )
    # the ridge on the left is drawn 4 cm beside where its planes meet, beyond the step on the right
    plane = np.array([[0, 0.5, 4], [0, -0.5, 7.54], [0, 0, 3], [0, 0, 8.5]])
    x, y = cells.middle_m.T
    label = np.where(x < 4, (y > 3.5).astype(int), 2 + (y > 3.52))
    borders = _Borders.of(cells, label, rectangle)
    place_m, _ = borders.exact_places(cells, plane)

    start, end = borders.side.T
    before_m, after_m = (each[end] - each[start] for each in (borders.xy_m, place_m))
    assert ((before_m * after_m).sum(axis=1) > 0).all()
    mesh = solid_below(cells, label, plane, rectangle)
    assert mesh is not None and mesh.is_closed and surfaces_to_write(mesh)[1] == []


def test_a_border_a_millimetre_beside_a_corner_goes_through_it() -> None:
    square = np.array([[0, 0], [10, 0], [10, 6], [0, 6.0]])
    cells = arrange([square], [Line(np.array([0.6, -0.8]), 1e-3)])
    side = np.array([0.6, -0.8]) @ cells.middle_m.T > 0
    mesh = solid_below(cells, side.astype(int), np.array([[0, 0, 4.0], [0, 0, 7.0]]), square)

    assert mesh is not None and mesh.is_closed
    assert mesh.edge_m.min() > 1.0
    assert (mesh.vertex_m[:, :2] == 0.0).all(axis=1).sum() == 3


def test_a_face_of_millimetres_between_two_others_vanishes() -> None:
    square = np.array([[0, 0], [10, 0], [10, 6], [0, 6.0]])
    cells = arrange([square], [Line(np.array([1.0, 0.0]), each) for each in (5.0, 5.002)])
    label = np.searchsorted((5.0, 5.002), cells.middle_m[:, 0])
    mesh = solid_below(cells, label, np.array([[0, 0, 4.0], [0, 0, 7.0], [0, 0, 5.5]]), square)

    assert mesh is not None and mesh.is_closed and mesh.edge_m.min() > 1.0
    # two roofs, four walls, the floor, and the step between the roofs
    assert len(mesh.surfaces) == 8 and (mesh.num_planes_at >= 3).all()


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_the_parameters_of_a_gable_roof_and_its_exact_planes(turn: float) -> None:
    rings, plane = gable(12, 8, 4, turn)
    fit = fit_planes(rings, sampled(rings, plane, 7), PLANES)
    assert fit is not None
    eave_m, angle_deg = fit.parameters(rings)
    assert eave_m == pytest.approx(4.0, abs=0.05)
    assert angle_deg == pytest.approx([40, 90, 40, 90], abs=0.7)
    mesh = fit.mesh
    assert mesh is not None
    roof_m = mesh.vertex_m[mesh.vertex_m[:, 2] > 0]
    assert np.abs(heights(fit.plane, roof_m[:, :2]) - roof_m[:, 2:]).min(axis=1).max() < 1e-6
    ridge_m = roof_m[roof_m[:, 2] > 6]
    assert np.abs(heights(fit.plane, ridge_m[:, :2]) - ridge_m[:, 2:]).max() < 1e-6


def test_an_edge_at_a_sharp_corner_has_the_angle_of_the_roof_behind_it() -> None:
    ring = np.array([[0.0, 0.0], [1.0, 0.0], [20.0, -8.0], [20.0, 1.0]])  # 3 degrees at the first corner
    xy_m = np.random.default_rng(0).uniform([0, -8], [20, 1], (4000, 2))
    xy_m = xy_m[shapely.contains_xy(shapely.Polygon(ring), *xy_m.T)]
    low_m, high_m = np.full(len(xy_m), 4.0), 12 + SLOPE * xy_m[:, 1]
    fit = fit_planes([ring], np.column_stack([xy_m, np.where(xy_m[:, 0] < 10, low_m, high_m)]), PLANES)
    assert fit is not None and len(set(fit.label)) == 2
    assert fit.parameters([ring])[1][0] == 0


def test_roofs_that_change_places_along_an_edge_meet_in_a_point_of_it() -> None:
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    cells = arrange([square], [Line(np.array([1.0, 0.0]), 5.0)])
    plane = np.array([[0.0, 0.2, 4.0], [0.0, -0.2, 6.0]])
    mesh = solid_below(cells, (cells.middle_m[:, 0] > 5).astype(int), plane, square)
    assert mesh is not None
    assert np.abs(mesh.vertex_m - [5.0, 5.0, 5.0]).max(axis=1).min() < 1e-9
    walls = mesh.vertex_m[mesh.triangle[mesh.kind == FaceKind.WALL]]
    assert np.abs(doubled_areas(walls)[:, 2]).max() < 1e-12
    assert volume_m3(mesh) == pytest.approx(500)


def test_lines_divide_a_footprint() -> None:
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    # the last line ends at x = 5, within the middle column, which it does not divide
    lines = [Line(np.array([1.0, 0.0]), x) for x in (3.0, 7.0)] + [Line(np.array([0.0, 1.0]), 4.0, -5.0, 1.0)]
    cells = arrange([square], lines)
    assert sorted(np.round(cells.area_m2, 6)) == [12, 18, 30, 40]
    shared = cells.xy_m[cells.side[(cells.pair >= 0).all(axis=1)]]
    assert sorted(np.round(np.linalg.norm(shared[:, 1] - shared[:, 0], axis=1), 6)) == [3, 4, 6, 10]
    number = cells.cells_at(np.array([[1.0, 9.0], [1.0, 1.0], [5.0, 9.0], [5.0, 1.0], [-1.0, 5.0]]))
    assert len(set(number[:3])) == 3
    assert number[2] == number[3]
    assert number[4] == -1


def cells_by_geos(rings: list[np.ndarray], lines: list[Line]) -> np.ndarray:
    """The cells of GEOS's own snap rounding."""
    polygon = shapely.Polygon(rings[0], rings[1:])
    drawn = shapely.linestrings(ends_of(lines, 100.0))
    network = shapely.union_all([polygon.boundary, *drawn], grid_size=GRID_M)
    cells = shapely.get_parts(shapely.polygonize(shapely.get_parts(network)))
    return cells[shapely.contains(polygon, shapely.point_on_surface(cells))]


@pytest.mark.filterwarnings("error")
def test_lines_of_roofs_around_divide_no_footprint() -> None:
    square = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10]])
    beyond = [Line(np.array([1.0, 0.0]), 5.0, 200.0, 210.0), Line(np.array([0.0, 1.0]), 5.0, -300.0, -200.0)]
    assert len(arrange([square], beyond).area_m2) == 1


@pytest.mark.parametrize("seed", range(12))
def test_cells_are_those_of_geos(seed: int) -> None:
    """Of lines through common points, along edges, askew by a hair, and of some that end within the footprint, around
    a cell of their own, too."""
    rng = np.random.default_rng([5, seed])
    outside = np.array([[0.0, 0.0], [14.0, 0.0], [14.0, 6.0], [9.0, 6.0], [9.0, 11.0], [0.0, 11.0]])
    rings = [outside, np.array([[3.0, 3.0], [3.0, 5.0], [6.0, 5.0], [6.0, 3.0]])][: 1 + seed % 2]
    turn = rng.uniform(0, np.pi)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    rings, common = [ring @ rotation.T for ring in rings], rng.uniform(1, 9, 2) @ rotation.T
    angle = rng.uniform(0, np.pi, 6)
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    lines = [Line(each, float(each @ common)) for each in normals[:3]]
    lines += [Line(each, float(each @ rng.uniform(1, 9, 2)), -9.0, 3.0) for each in normals[3:]]
    lines += [edge for edge, is_reflex in edges_of(rings) if is_reflex]
    lines.append(lines[-1]._replace(offset_m=lines[-1].offset_m + 1e-4))
    box = edges_of([np.array([[10.0, 1.0], [11.5, 1.0], [11.5, 2.0], [10.0, 2.0]]) @ rotation.T])
    ends_m = np.array([[10.0, 1.0], [11.5, 1.0], [11.5, 2.0], [10.0, 2.0]]) @ rotation.T
    lines += [
        edge.along(np.array(ends), 0.0)
        for (edge, _), *ends in zip(box, ends_m, np.roll(ends_m, -1, axis=0), strict=True)
    ]
    cells, expected = arrange(rings, lines), cells_by_geos(rings, lines)
    expected = expected[shapely.area(expected) > 0.01]
    large = cells.area_m2 > 0.01
    assert np.sort(cells.area_m2[large]) == pytest.approx(np.sort(shapely.area(expected)), abs=0.02)
    assert cells.area_m2.sum() == pytest.approx(shapely.Polygon(rings[0], rings[1:]).area, abs=0.02)
    place_m = np.round(rng.uniform(-14, 14, (500, 2)), 3)
    pair, number = shapely.STRtree(expected).query(shapely.points(place_m), predicate="within")
    middle = cells.middle_m[cells.cells_at(place_m[pair])]
    beside = shapely.distance(expected[number], shapely.points(middle))
    assert (beside > 2e-3).sum() <= 2
    is_outside = ~shapely.intersects_xy(shapely.Polygon(rings[0], rings[1:]), place_m[:, 0], place_m[:, 1])
    assert (cells.cells_at(place_m)[is_outside] == -1).all()


def test_pieces_have_only_ends_in_common() -> None:
    rng = np.random.default_rng(6)
    # a fan through one place, and lines almost along each other
    ends_m = rng.uniform(-20, 20, (30, 2, 2))
    fan = rng.uniform(-20, 20, (10, 2))
    ends_m = np.concatenate([ends_m, np.stack([fan, 2 * ends_m[0, 0] - fan], axis=1), ends_m[:9] + 4e-4])
    place, link, _ = _pieces(ends_m / GRID_M)
    pieces = shapely.linestrings(place[link])
    first, second = shapely.STRtree(pieces).query(pieces, predicate="intersects")
    first, second = first[first < second], second[first < second]
    meeting = shapely.intersection(pieces[first], pieces[second])
    assert (shapely.get_type_id(meeting) == shapely.GeometryType.POINT).all()
    assert shapely.touches(pieces[first], pieces[second]).all()


def test_lines_halfway_between_places_of_the_grid_leave_no_gap() -> None:
    """Their crossings are rounded to either side."""
    ring = np.array([[-100.0, -64.0], [100.0, -64.0], [100.0, 64.0], [-100.0, 64.0]])
    x_m, y_m = np.linspace(-91.687, 88.3, 40), np.array([-39.9805, 8.0275, 47.9755])
    lines = [Line(np.array([1.0, 0.0]), x) for x in x_m.tolist()]
    # a turn of less than a grid's place over the footprint
    lines += [Line(np.array([1e-16, 1.0]), y, -101.995, 101.997) for y in y_m.tolist()]
    cells = arrange([ring], lines)
    assert len(cells.area_m2) == 41 * 4 and cells.area_m2.sum() == pytest.approx(200 * 128)


@pytest.mark.parametrize("askew_m", [0.12, 0.03, 6e-4])
def test_steps_go_through_the_corners_that_they_pass_by(askew_m: float) -> None:
    """Of two wings that stand a hair askew, between their inner corners, with so much between the lines of their
    walls."""
    x_m = 6 + askew_m
    ring = np.array([[0, 0], [6, 0], [6, -3], [12, -3], [12, 8], [x_m, 8], [x_m, 11], [0, 11.0]])
    rng = np.random.default_rng(7)
    xy_m = rng.uniform([0, -3], [12, 11], (2500, 2))
    xy_m = xy_m[shapely.contains_xy(shapely.Polygon(ring), xy_m[:, 0], xy_m[:, 1])]
    point_m = np.column_stack([xy_m, np.where(xy_m[:, 0] < 6.01, 5.0, 8.0)])
    fit = fit_planes([ring], point_m, PLANES)
    assert fit is not None and len(fit.plane) == 2
    lines = lines_of([ring], fit.plane, (xy_m[:, 0] > 6.01).astype(int), point_m, [0.0], PLANES.drawing)
    off_m = np.array([np.abs(ring @ line.normal - line.offset_m) for line in lines])
    place_m = np.array([ring @ line.direction for line in lines])
    low_m, high_m = np.array([(line.low_m, line.high_m) for line in lines]).T[..., None]
    passes = (place_m > low_m + 0.01) & (place_m < high_m - 0.01) & (off_m < PLANES.drawing.corner_m)
    assert off_m[passes].max() < 1e-6
    assert fit.mesh.edge_m.min() > 2.5


def test_cells_do_not_depend_on_the_order_of_lines() -> None:
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    lines = [Line(np.array([np.cos(a), np.sin(a)]), 6.0 + a) for a in (0.1, 0.5, 0.9, 1.3)]
    one, other = arrange([square], lines), arrange([square], lines[::-1])
    assert np.array_equal(one.middle_m, other.middle_m)
    assert np.array_equal(one.pair, other.pair)


def test_a_border_along_pieces_of_several_lines_gives_way_to_a_straight_one() -> None:
    """A step on one line jumps aside for half a metre, which saves less than another line costs."""
    prices = PLANES.prices._replace(face_m3=0.0, edge_m2=0.1, line_m3=0.2)
    # the cells of a strip to the left, between two lines, and to the right; in the middle one, the points agree little
    # more with the right
    cell_m3 = np.array([[0, 9], [0.0, 0.3], [9, 0], [0, 9], [0.3, 0.0], [9, 0.0]])
    pair = np.array([[0, 1], [1, 2], [3, 4], [4, 5], [0, 3], [1, 4], [2, 5]])
    length_m = np.array([4.0, 4.0, 0.5, 0.5, 1.0, 0.3, 1.0])
    line = np.array([0, 1, 0, 1, 2, 2, 2])
    costs = all_costs(cell_m3, pair, length_m, prices, line)
    assert least_cost(costs).tolist() == [0, 0, 1, 0, 0, 1]
    assert not costs.problem.is_barred.any()
    jagged = replace(costs, prices=prices._replace(line_m3=0.01))
    assert least_cost(jagged).tolist() == [0, 0, 1, 0, 1, 1]
    # a shorter step elsewhere is tried first, and stays, as its points are clear
    apart = all_costs(
        np.vstack([cell_m3, [[0, 9], [9, 0]]]),
        np.vstack([pair, [[6, 7]]]),
        np.append(length_m, 0.2),
        prices,
        np.append(line, 3),
    )
    assert least_cost(apart).tolist() == [0, 0, 1, 0, 0, 1, 0, 1]


def test_a_tiny_face_does_not_save_the_price_of_a_line() -> None:
    """Between a low and a high roof, a corner of 5 cm has a step on a line of its own, with either of them; a third
    roof, between both, would have none."""
    prices = PLANES.prices._replace(face_m3=0.06, edge_m2=0.1, line_m3=0.15)
    cell_m3 = np.array([[0, 9, 9], [9, 0, 9], [0.002, 0.002, 0.0]])
    pair, length_m = np.array([[0, 1], [0, 2], [2, 1]]), np.array([3.0, 0.05, 0.05])
    plane = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 3.1], [0.0, 0.0, 3.05]])
    costs = all_costs(cell_m3, pair, length_m, prices, plane=plane)
    assert least_cost(costs).tolist() in ([0, 1, 0], [0, 1, 1])
    whole = replace(costs, prices=prices._replace(whole_line_m=1e-3))
    assert least_cost(whole).tolist() == [0, 1, 2]


@pytest.mark.parametrize("seed", range(20))
def test_two_planes_are_divided_at_least_cost(seed: int) -> None:
    """One minimum cut, against all ways to divide ten cells with twenty sides."""
    rng = np.random.default_rng(seed)
    pair = rng.permutation(list(itertools.combinations(range(10), 2)))[:20]
    prices = PLANES.prices._replace(face_m3=0.0, line_m3=0.0, edge_m2=1.0)
    costs = all_costs(rng.uniform(0, 2, (10, 2)), pair, rng.uniform(0, 1, 20), prices)
    best_m3 = min(costs.total_m3(np.array(each)) for each in itertools.product(range(2), repeat=10))
    assert costs.total_m3(least_cost(costs)) == pytest.approx(best_m3)


@pytest.mark.parametrize("seed", range(10))
def test_two_planes_are_divided_at_least_cost_over_many_cells(seed: int) -> None:
    """Against the greatest flow that scipy finds, in which capacities are whole numbers."""
    rng = np.random.default_rng(seed)
    grid = np.arange(900).reshape(30, 30)
    pair = np.column_stack(cell_neighbours(grid >= 0))
    # in lumps, so that much flows far, and some of it nowhere
    cell_m3 = np.repeat(np.repeat(rng.integers(0, 2000, (6, 6, 2)), 5, 0), 5, 1).reshape(-1, 2)
    cell_m3 += rng.integers(0, 500, (900, 2))
    length_m = rng.integers(0, 800, len(pair))
    rows = np.concatenate([pair[:, 0], pair[:, 1], np.full(900, 900), grid.ravel()])
    columns = np.concatenate([pair[:, 1], pair[:, 0], grid.ravel(), np.full(900, 901)])
    capacity = np.concatenate([length_m, length_m, cell_m3[:, 0], cell_m3[:, 1]])
    graph = scipy.sparse.csr_array((capacity.astype(np.int32), (rows, columns)), shape=(902, 902))
    least_m3 = maximum_flow(graph, 900, 901).flow_value
    prices = PLANES.prices._replace(face_m3=0.0, line_m3=0.0, edge_m2=1.0)
    costs = all_costs(cell_m3, pair, length_m.astype(float), prices)
    label = least_cost(costs)
    assert 0 < label.sum() < 900
    assert costs.total_m3(label) == pytest.approx(least_m3)


RING = np.array([[i, (i + 1) % 6] for i in range(6)])


def test_labels_cost_little_more_than_the_least() -> None:
    """Against all labellings of six cells in a ring, by three planes that meet here and have steps there."""
    prices, share = PLANES.prices._replace(face_m3=0.3, line_m3=0.1, edge_m2=0.3), []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        plane = np.column_stack([rng.normal(0, 0.1, (3, 2)), rng.uniform(0, 0.3, 3)])
        end_m = rng.uniform(-1, 1, (6, 2, 2))
        costs = all_costs(rng.uniform(0, 2, (6, 3)), RING, np.ones(6), prices, plane=plane, end_m=end_m)
        best = min(costs.total_m3(np.array(each)) for each in itertools.product(range(3), repeat=6))
        share.append(costs.total_m3(least_cost(costs)) / best)
    assert max(share) < 1.2 and np.mean(share) < 1.01 and np.mean(np.array(share) < 1 + 1e-9) > 0.9


def test_most_labels_are_the_cheapest() -> None:
    num_best = 0
    for seed in range(100):
        rng = np.random.default_rng([1, seed])
        prices = PLANES.prices._replace(face_m3=0.2, line_m3=0.1, edge_m2=0.2)
        costs = all_costs(rng.uniform(0, 1, (6, 3)), RING, np.ones(6), prices)
        best = min(costs.total_m3(np.array(each)) for each in itertools.product(range(3), repeat=6))
        num_best += costs.total_m3(least_cost(costs)) < best + 1e-9
    assert num_best >= 80


@pytest.mark.parametrize("seed", range(10))
def test_what_a_search_gains_it_gains_in_all(seed: int) -> None:
    """On a grid of cells with eight planes: moves are judged by what is around them, and no end is above a start."""
    rng = np.random.default_rng(seed)
    number = np.arange(100).reshape(10, 10)
    pair = np.vstack([np.column_stack([a.ravel(), b.ravel()]) for a, b in
                      ((number[:, 1:], number[:, :-1]), (number[1:], number[:-1]))])  # fmt: skip
    line = np.concatenate([np.tile(np.arange(9), 10), 9 + np.repeat(np.arange(9), 10)])
    prices = PLANES.prices._replace(face_m3=0.3, line_m3=0.5, edge_m2=0.2)
    costs = all_costs(rng.uniform(0, 1, (100, 8)), pair, np.ones(len(pair)), prices, line)
    free = replace(costs, prices=prices._replace(face_m3=0.0, line_m3=0.0, short_line_m=0.0))
    label = least_cost(costs)
    assert costs.total_m3(label) < costs.total_m3(least_cost(free))


def test_planes_are_candidates_near_their_points_and_where_nothing_is_seen() -> None:
    strip = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 4.0], [0.0, 4.0]])
    cells = arrange([strip], [Line(np.array([1.0, 0.0]), float(x)) for x in range(2, 60, 2)])
    x_m = np.array([1.0, 11.0, 19.0, 21.0, 29.0, 51.0, 59.0])
    point_m = np.column_stack([x_m, np.full(7, 2.0)])
    label, cell = np.array([0, 0, 1, 1, 1, 2, 2]), cells.cells_at(point_m)
    first, number = candidates_of(cells, point_m, label, point_m, cell, 1.5)

    def at(x: float) -> list[int]:
        k = int(cells.cells_at(np.array([[x, 2.0]]))[0])
        return number[first[k] : first[k + 1]].tolist()

    assert at(1.0) == [0] and at(21.0) == [1] and at(59.0) == [2]
    assert at(15.0) == [0, 1] and at(40.0) == [1, 2]


def test_roofs_that_touch_along_an_upright_edge_only_are_no_solid() -> None:
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    cells = arrange([square], [Line(np.array([1.0, 0.0]), 5.0), Line(np.array([0.0, 1.0]), 5.0)])
    plane = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 6.0]])
    label = (cells.middle_m > 5).sum(axis=1) % 2
    assert solid_below(cells, label, plane, square) is None
    every = np.arange(len(cells.side))
    pinch_m = cells.xy_m[at_pinch(cells, label, plane, every)]
    assert pinch_m.tolist() == [[5.0, 5.0]]
    assert solid_below(cells, label * 0, plane, square) is not None
    assert not len(at_pinch(cells, label * 0, plane, every))


def test_all_cells_of_a_roof_at_an_upright_edge_of_four_walls_change_together() -> None:
    """Lines along the diagonals divide each of four quarters, high and low in turn, into two cells."""
    square = np.array([[-5.0, -5.0], [5.0, -5.0], [5.0, 5.0], [-5.0, 5.0]])
    cells = arrange(
        [square],
        [Line(each, 0.0) for each in np.eye(2)] + [Line(np.array([0.6, s * 0.8]), 0.0) for s in (1, -1)],
    )
    label = (cells.middle_m > 0).sum(axis=1) % 2
    plane = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 6.0]])
    # points show three quarters well, and the fourth with a single point
    x, y = np.meshgrid(np.arange(-4.5, 5.0, 1.0), np.arange(-4.5, 5.0, 1.0))
    xy_m = np.column_stack([x.ravel(), y.ravel()])
    xy_m = xy_m[(xy_m < 0.0).any(axis=1) | (xy_m == 2.5).all(axis=1)]
    cell = cells.cells_at(xy_m)
    point_m = np.column_stack([xy_m, height_over(plane, label[cell], xy_m)])
    every = np.arange(len(label) + 1) * 2, np.tile(np.arange(2), len(label))
    costs = costs_of(cells, plane, point_m, cell, np.ones(len(point_m)), PLANES.prices, every)
    result = _without_pinches(cells, costs, label, plane)
    x_m, y_m = cells.middle_m.T
    assert result.tolist() == np.where((x_m > 0) & (y_m > 0), 1, label).tolist()
    assert solid_below(cells, result, plane, square) is not None


def test_a_solid_is_closed_where_no_sides_are_at_a_pinch() -> None:
    num_closed = 0
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    for seed in range(60):
        rng = np.random.default_rng([4, seed])
        angle = rng.uniform(0, np.pi, 3)
        lines = [
            Line(each, each @ rng.uniform(2, 8, 2))
            for each in np.column_stack([np.cos(angle), np.sin(angle)])
        ]
        cells = arrange([square], lines)
        plane = np.column_stack([rng.uniform(-0.3, 0.3, (3, 2)), rng.uniform(6, 9, 3)])
        label = rng.integers(3, size=len(cells.area_m2))
        is_closed_solid = solid_below(cells, label, plane, square) is not None
        assert is_closed_solid == (not len(at_pinch(cells, label, plane, np.arange(len(cells.side)))))
        num_closed += is_closed_solid
    assert 10 < num_closed < 55


def test_a_solid_is_closed_where_lines_cross_within_millimetres() -> None:
    """Without the side of 3 mm between the low roofs, four walls would share an upright edge."""
    ring = np.array([[-5, -5], [5, -5], [5, 5], [-5, 5.0]])
    across, along = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    cells = arrange([ring], [Line(across, 0.0), Line(across, 0.003), Line(along, 0.0)], 100)
    assert cells is not None
    x_m, y_m = cells.middle_m.T
    label = np.where(y_m > 0, np.where(x_m < 0, 0, 1), np.where(x_m < 0.003, 2, 3))
    mesh = solid_below(cells, label, np.array([[0, 0, 9.0], [0, 0, 3.0], [0, 0, 4.0], [0, 0, 8.0]]), ring)
    assert mesh is not None and is_closed(mesh.vertex_m, mesh.triangle)
    assert volume_m3(mesh) == pytest.approx(25 * (9 + 3 + 4 + 8), abs=0.2)


@pytest.mark.parametrize("seed", range(16))
def test_solids_are_closed_planar_and_upright(seed: int) -> None:
    """Random planes over a random division of a footprint with a courtyard."""
    rng = np.random.default_rng(seed)
    outside = np.array([[0.0, 0.0], [14.0, 0.0], [14.0, 6.0], [9.0, 6.0], [9.0, 11.0], [0.0, 11.0]])
    courtyard = np.array([[3.0, 3.0], [3.0, 5.0], [6.0, 5.0], [6.0, 3.0]])
    angle = rng.uniform(0, np.pi, 4)
    lines = [
        Line(np.array([np.cos(a), np.sin(a)]), np.array([np.cos(a), np.sin(a)]) @ rng.uniform(2, 8, 2))
        for a in angle
    ]
    cells = arrange([outside, courtyard], lines)
    plane = np.column_stack([rng.uniform(-0.5, 0.5, (3, 2)), rng.uniform(15, 17, 3)])
    # connected faces that meet in steps, as planes shifted by half a metre would
    label = (heights(plane, cells.middle_m) + rng.uniform(-0.5, 0.5, 3)).argmin(axis=1)
    mesh = solid_below(cells, label, plane, np.concatenate([outside, courtyard]))
    assert mesh is not None
    assert is_closed(mesh.vertex_m, mesh.triangle)
    corners = {tuple(corner) for corner in np.concatenate([outside, courtyard]).tolist()}
    assert corners <= {tuple(xy) for xy in mesh.vertex_m[:, :2].tolist()}
    x, y = np.meshgrid(np.arange(0.05, 14, 0.1), np.arange(0.05, 11, 0.1))
    place_m = np.column_stack([x.ravel(), y.ravel()])
    cell = cells.cells_at(place_m)
    exact = 0.01 * float(height_over(plane, label[cell], place_m)[cell >= 0].sum())
    assert volume_m3(mesh) == pytest.approx(exact, rel=2e-3)


@pytest.mark.parametrize("density", [10.0, 2.0])
def test_a_spire_is_a_pyramid(density: float) -> None:
    """80 degrees steep, as on churches. It was a block of the height of its middle."""
    ring = np.array([[-4.0, -4.0], [4.0, -4.0], [4.0, 4.0], [-4.0, 4.0]])
    slope = np.tan(np.radians(80)) * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    spire = np.column_stack([slope, np.full(4, 20 + 4 * slope[0, 0])])
    point_m = sampled([ring], spire, 3, density)
    fit = fit_planes([ring], point_m, PLANES)
    assert fit is not None and residuals_m(fit, point_m).mean() < 0.1
    assert len(np.unique(fit.costs.faces(fit.label))) == 4
    assert fit.mesh.vertex_m[:, 2].max() == pytest.approx(spire[0, 2], abs=0.5)


def test_a_wing_askew_meets_the_main_roof_in_valleys() -> None:
    rings, main = gable(14, 8, 4, 0.0)
    wing_rings, wing = gable(12, 5, 4, np.pi / 2 - 0.35)
    shift = np.array([1.0, -5.0])
    wing[:, 2] -= wing[:, :2] @ shift
    body, side = shapely.Polygon(rings[0]), shapely.Polygon(wing_rings[0] + shift)
    whole = shapely.orient_polygons(body.union(side))
    ring = np.array(whole.exterior.coords)[:-1]
    rng = np.random.default_rng(5)
    xy_m = rng.uniform(ring.min(axis=0), ring.max(axis=0), (4000, 2))
    xy_m = xy_m[shapely.contains_xy(whole, xy_m[:, 0], xy_m[:, 1])]
    over = [
        np.where(
            shapely.contains_xy(polygon, xy_m[:, 0], xy_m[:, 1]), heights(planes, xy_m).min(axis=1), -np.inf
        )
        for polygon, planes in ((body, main), (side, wing))
    ]
    point_m = np.column_stack([xy_m, np.maximum(*over) + rng.normal(0, 0.03, len(xy_m))])
    fit = fit_planes([ring], point_m, PLANES)
    assert fit is not None
    assert len(np.unique(fit.label)) == 4
    assert residuals_m(fit, point_m).mean() < 0.05
    mesh = fit.mesh
    assert mesh is not None
    # walls are planes, also when vertices within them are gone
    assert (mesh.num_planes_at >= 3).all()
    normal = unit_normals(mesh.corner_m[mesh.kind == FaceKind.WALL])
    assert np.abs(normal[:, 2]).max() < 1e-6
    # the roofs meet in valleys, with hardly any wall between them
    corner_m = mesh.vertex_m[mesh.triangle[mesh.kind == FaceKind.WALL]]
    within = shapely.contains_xy(whole.buffer(-0.05), *corner_m[:, :, :2].mean(axis=1).T)
    assert np.linalg.norm(doubled_areas(corner_m[within]), axis=1).sum() / 2 < 0.3


def test_a_ridge_goes_on_in_the_shadow_of_a_higher_house() -> None:
    rings, plane = gable(14, 9, 4, 0.0)
    point_m = sampled(rings, plane, 4)
    fit = fit_planes(rings, point_m[point_m[:, 0] < 1], PLANES)
    assert fit is not None and residuals_m(fit, point_m).mean() < 0.06


def test_lines_go_on_where_nothing_is_seen_and_nowhere_else() -> None:
    """Three roofs of two levels in a row; the last is in a shadow but for 5 m."""
    footprint = [np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 20.0], [0.0, 20.0]])]
    xy_m = np.stack(np.meshgrid(np.arange(0.25, 60, 0.5), np.arange(0.25, 20, 0.5)), axis=-1).reshape(-1, 2)
    number = (xy_m[:, 0] // 20).astype(int)
    label = 2 * number + (xy_m[:, 1] > 6 + 4 * number)
    point_m = np.column_stack([xy_m, 5.0 + label])
    is_seen = xy_m[:, 0] < 45
    plane = np.column_stack([np.zeros((6, 2)), 5.0 + np.arange(6)])
    lines = lines_of(
        footprint, plane, label[is_seen], point_m[is_seen], [0.0], PLANES.drawing._replace(hidden_m=16.0)
    )
    ends_m = {
        number: max(
            line.direction[0] * (line.high_m if line.direction[0] > 0 else line.low_m)
            for line in lines
            if abs(line.normal[1]) == 1 and abs(line.offset_m * line.normal[1] - 6 - 4 * number) < 0.3
        )
        for number in range(3)
    }
    reach_m = PLANES.drawing.reach_m
    assert ends_m[0] < 20 + 2 * reach_m and ends_m[1] < 40 + 2 * reach_m
    assert ends_m[2] >= 60


def test_edges_go_on_beyond_a_reflex_corner_for_some_metres() -> None:
    ring = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 20.0], [40.0, 20.0], [40.0, 8.0], [0.0, 8.0]])
    xy_m = np.stack(np.meshgrid(np.arange(0.5, 40, 1), np.arange(0.5, 8, 1)), axis=-1).reshape(-1, 2)
    point_m, label = np.column_stack([xy_m, np.full(len(xy_m), 5.0)]), np.zeros(len(xy_m), int)
    lines = lines_of([ring], np.array([[0.0, 0.0, 5.0]]), label, point_m, [0.0], PLANES.drawing)
    along = [line for line in lines if abs(line.normal[1]) == 1 and line.offset_m * line.normal[1] == 8.0]
    end_m = np.concatenate(ends_of(along))[:, 0]
    assert end_m.max() == 40 + PLANES.drawing.beyond_m
    assert end_m.min() == -PLANES.drawing.beyond_m


def test_two_of_few_points_make_no_face_and_five_do() -> None:
    """Each stands for six square metres."""
    xy_m = np.array([[x, y] for x in np.arange(1, 20, 2.5) for y in np.arange(1, 12, 2.5)])
    rings = [np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 12.0], [0.0, 12.0]])]
    num_planes = []
    for num_high in (2, 5):
        z_m = np.full(len(xy_m), 4.0)
        z_m[:num_high] += 2.0
        fit = fit_planes(rings, np.column_stack([xy_m, z_m]), PLANES)
        assert fit is not None
        num_planes.append(len(np.unique(fit.label)))
    assert num_planes == [1, 2]


@pytest.mark.parametrize(("per_m2", "is_dense"), [(12.0, True), (4.0, True), (1.0, False), (0.1, False)])
def test_lines_and_prices_change_only_where_points_are_far_apart(per_m2: float, is_dense: bool) -> None:
    drawing, prices = PLANES.drawing.for_density(per_m2), PLANES.prices.for_density(per_m2)
    assert (drawing == PLANES.drawing) is is_dense
    assert (prices.edge_m2 == PLANES.prices.edge_m2) is is_dense


def test_planes_meet_on_a_line_that_is_far_from_all_of_few_points() -> None:
    rings, plane = gable(12, 8, 4, 0.0)
    xy_m = np.array([[x, y] for x in (-5.0, -2.0, 1.0, 4.0) for y in (-3.5, -1.5, 1.0, 3.0)])
    point_m = np.column_stack([xy_m, heights(plane, xy_m).min(axis=1)])
    label = (xy_m[:, 1] > 0).astype(int)
    found = {
        density: lines_of(rings, plane, label, point_m, [0.0], PLANES.drawing.for_density(density))
        for density in (4.0, len(xy_m) / 96)
    }
    num_ridges = {
        density: sum(abs(line.offset_m) < 1e-9 and abs(line.normal[1]) == 1 for line in lines)
        for density, lines in found.items()
    }
    assert [*num_ridges.values()] == [0, 1]


def test_a_roof_house_has_walls_where_its_points_end() -> None:
    """A level roof of 20 m, a house of 3 by 2.4 m on it, and a few points at its height further along."""
    rings, _ = gable(20, 20, 4, 0.0)
    xy_m = np.array([[x, y] for x in np.arange(-9.8, 10, 0.4) for y in np.arange(-9.8, 10, 0.4)])
    in_house = (np.abs(xy_m[:, 0]) < 1.6) & (np.abs(xy_m[:, 1]) < 1.2)
    beside = (np.abs(xy_m[:, 0] - 3.0) < 0.5) & (np.abs(xy_m[:, 1]) < 0.3)
    label = (in_house | beside).astype(int)
    plane = np.array([[0.0, 0.0, 4.0], [0.0, 0.0, 6.5]])
    lines = lines_of(
        rings, plane, label, np.column_stack([xy_m, plane[label, 2]]), [0.0], PLANES.drawing.for_density(6.25)
    )
    for axis, half_m in enumerate((1.6, 1.2)):
        offset_m = np.array([line.offset_m for line in lines if line.normal[axis] == 1])
        for wall_m in (-half_m, half_m):
            assert np.abs(offset_m - wall_m).min() < 0.3


def test_lines_that_few_points_cannot_tell_apart_are_one() -> None:
    """A level roof that ends at a step, and the same a little further along."""
    rings, _ = gable(20, 20, 4, 0.0)
    xy_m = np.array([[x, y] for x in np.arange(-9.0, 10, 3) for y in np.arange(-9.0, 10, 3)])
    label = np.where(xy_m[:, 0] > np.where(xy_m[:, 1] > 0, 1.0, 1.7), 1, 0)
    label[label == 1] += xy_m[label == 1, 1] > 0
    plane = np.array([[0.0, 0.0, 4.0], [0.0, 0.0, 8.0], [0.0, 0.0, 6.0]])
    xy_m[:, 0] += np.where(xy_m[:, 1] > 0, 0.0, 0.6)
    point_m = np.column_stack([xy_m, plane[label, 2]])
    drawing = PLANES.drawing.for_density(len(xy_m) / 400)
    num_lines = [
        len(lines_of(rings, plane, label, point_m, [0.0], each))
        for each in (drawing._replace(snap_m=PLANES.drawing.snap_m), drawing)
    ]
    assert num_lines[1] < num_lines[0]


def test_the_highest_of_many_points_may_be_of_no_plane() -> None:
    rings, plane = gable(40, 30, 4, 0.0)
    point_m = np.vstack([sampled(rings, plane, 1, 0.3), [-9.0, 5.0, 30.0], [5.0, 5.0, 40.0]])
    assert len(point_m) > PLANES.detection.num_few_points
    fit = fit_planes(rings, point_m, PLANES)
    assert fit is not None and (heights(fit.plane, point_m[-1:, :2]) < 30).all()


def test_two_points_show_no_slope_and_three_do() -> None:
    rings, _ = gable(20, 8, 4, 0.0)
    along = directions(rings, 4.0)
    rising_m = np.array([[-8.0, 0.0, 3.0], [-4.0, 0.0, 5.0], [0.0, 0.0, 7.0]])
    for num_points, num_sloped in ((1, 0), (2, 0), (3, 1)):
        found = detect(rising_m[:num_points], 0.5, along, PLANES.detection)
        assert np.count_nonzero(np.hypot(*found.plane[:, :2].T) > 0.1) == num_sloped
        height_m = height_over(found.plane, found.label, rising_m[:num_points, :2])
        assert height_m == pytest.approx(rising_m[:num_points, 2])


def test_a_point_that_stands_for_a_large_area_shows_no_level_roof() -> None:
    along = directions(gable(20, 8, 4, 0.0)[0], 4.0)
    for per_m2, num_planes in ((0.5, 1), (0.2, 0)):
        assert len(detect(np.array([[1.0, 2.0, 5.0]]), per_m2, along, PLANES.detection).plane) == num_planes


def test_a_roof_rises_no_further_than_few_points_show() -> None:
    rings, _ = gable(20, 8, 4, 0.0)
    rising_m = np.array([[x, y, 7 + x / 2] for x in (-8.0, -4.0, 0.0) for y in (-3.0, 0.0, 3.0)])
    fit = fit_planes(rings, rising_m, PLANES)
    assert fit is not None and fit.mesh.vertex_m[:, 2].max() == pytest.approx(7.0, abs=0.5)


def test_few_points_that_are_all_outside_of_moved_walls_still_show_a_roof() -> None:
    """As where walls have moved inwards past the points at an eave."""
    own_m = np.array([[-0.3, 4.0, 6.0], [10.2, 4.0, 6.0], [5.0, 8.2, 6.0]])
    around_m = np.column_stack([np.linspace(12, 20, 40), np.tile([1.0, 3, 5, 7], 10), np.full(40, 9.0)])
    for around in (around_m, np.zeros((0, 3))):
        fit = fit_planes([np.array([[0, 0], [10, 0], [10, 8], [0, 8.0]])], own_m, PLANES, 0, around)
        assert fit is not None and fit.mesh.is_closed


@pytest.mark.parametrize("per_m2", [12.0, 0.02])
def test_a_point_far_off_costs_as_much_as_one_metre(per_m2: float) -> None:
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    point_m, prices = np.array([[2.0, 5.0, 3.0], [8.0, 5.0, 11.0]]), PLANES.prices.for_density(per_m2)
    cells, stands_m2 = arrange([square], []), np.full(2, 1 / per_m2)
    candidates = np.array([0, 1]), np.array([0])
    plane = np.array([[0.0, 0.0, 3.0]])
    costs = costs_of(cells, plane, point_m, np.zeros(2, int), stands_m2, prices, candidates)
    assert costs.problem.cell_m3 == pytest.approx(1 / per_m2)


def test_a_point_in_a_cell_without_width_does_not_pay_for_a_tower() -> None:
    """A bird above a roof with one point per m2, in a cell of 10 cm: most of what the point stands for is beside it."""
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    strip = [Line((1.0, 0.0), 4.95), Line((1.0, 0.0), 5.05), Line((0.0, 1.0), 4.95), Line((0.0, 1.0), 5.05)]
    cells = arrange([square], strip)
    xy_m = np.stack(np.meshgrid(np.arange(10.0) + 0.4, np.arange(10.0) + 0.4), axis=-1).reshape(-1, 2)
    point_m = np.vstack([np.column_stack([xy_m, np.full(100, 3.0)]), [5.0, 5.0, 11.0]])
    plane, of_cell = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 11.0]]), cells.cells_at(point_m[:, :2])
    candidates = 2 * np.arange(len(cells.area_m2) + 1), np.tile([0, 1], len(cells.area_m2))
    costs = costs_of(cells, plane, point_m, of_cell, np.ones(101), PLANES.prices, candidates)
    assert cells.area_m2.min() == pytest.approx(0.01)
    assert (least_cost(costs) == 0).all()
    assert costs.problem.cell_m3[::2].sum() == pytest.approx(1.0)


def test_points_around_show_how_high_roofs_are_where_few_are_on_the_building() -> None:
    square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    cells, plane = arrange([square], []), np.array([[1.0, 0.0, 3.0]])
    around_m = np.column_stack([np.linspace(-3, 3, 25), np.full(25, -1.0), np.linspace(0, 6, 25)])
    point_m = np.vstack([[1.0, 5.0, 4.0], around_m])
    prices = PLANES.prices._replace(cap_m=99.0)
    of_cell, candidates = np.append(0, np.full(25, -1)), (np.array([0, 1]), np.array([0]))
    costs = costs_of(cells, plane, point_m, of_cell, np.full(26, 100.0), prices, candidates)
    # 13 m high at the far side; the highest point is at 6 m
    expected_m = 13.0 - 6.0 - prices.support_m
    assert costs.problem.cell_m3 == pytest.approx(100 * expected_m)


def test_the_roofs_of_a_row_show_that_of_a_house_with_few_points() -> None:
    rings, plane = gable(6, 9, 4, 0.3)
    off_m = []
    for seed in range(1, 7):
        row_m = sampled(gable(30, 9, 4, 0.3)[0], plane, seed)
        within = shapely.contains_xy(shapely.Polygon(rings[0]), row_m[:, 0], row_m[:, 1])
        few_m, around_m = row_m[within][::90], row_m[~within][::90]
        assert len(few_m) <= 8
        alone, in_row = fit_planes(rings, few_m, PLANES), fit_planes(rings, few_m, PLANES, around_m=around_m)
        assert alone is not None and in_row is not None
        off_m.append([residuals_m(fit, row_m[within]).mean() for fit in (alone, in_row)])
    alone_m, in_row_m = np.array(off_m).T
    assert in_row_m.max() < 0.05 < np.median(alone_m)


@pytest.mark.parametrize("density", [2.5, 10.0, 40.0])
def test_points_with_much_noise_show_the_planes_that_exact_ones_do(density: float) -> None:
    """As those of pictures, or of flights that do not fit each other."""
    rings, plane = gable(30, 20, 4, 0.5)
    point_m = sampled(rings, plane, 4, density)
    noisy_m = point_m + np.random.default_rng(2).normal(0, [0, 0, 0.2], point_m.shape)
    fit = fit_planes(rings, noisy_m, PLANES)
    assert fit is not None and len(np.unique(fit.label)) == 2
    assert fit.mesh.vertex_m[:, 2].max() == pytest.approx(plane[0, 2], abs=0.3)


@pytest.mark.parametrize("density", [1.0, 2.5])
def test_slopes_that_sag_beside_the_directions_of_the_footprint_are_one_plane_each(density: float) -> None:
    rings, _ = gable(24, 10, 4, 0.5)
    _, plane = gable(24, 10, 4, 0.55)
    point_m = sampled(rings, plane, 4, density)
    along_m = point_m[:, :2] @ [np.cos(0.5), np.sin(0.5)]
    point_m[:, 2] -= np.clip((along_m - 2) / 40, 0, None)
    fit = fit_planes(rings, point_m, PLANES)
    assert fit is not None and len(np.unique(fit.label)) == 2


@pytest.mark.parametrize("seed", [2, 6])
def test_small_slopes_in_no_direction_of_the_footprint_are_not_cut_into_level_roofs(seed: int) -> None:
    corner_m = np.array([[-3.0, -3.0], [3.0, -3.0], [3.0, 3.0], [-3.0, 3.0]])
    bearing = 0.17 + np.arange(4) * np.pi / 2
    pyramid = np.column_stack([np.cos(bearing) / 2, np.sin(bearing) / 2, np.full(4, 8.3)])
    fit = fit_planes([corner_m], sampled([corner_m], pyramid, seed, 2.8), PLANES)
    assert fit is not None and len(np.unique(fit.label)) == 4
    assert np.hypot(*fit.plane[fit.label, :2].T).min() > 0.4


def test_scattered_points_show_no_plane() -> None:
    rings, _ = gable(12, 8, 4, 0.0)
    scattered_m = np.random.default_rng(3).uniform([-6, -4, 0], [6, 4, 99], (300, 3))
    assert fit_planes(rings, scattered_m, PLANES) is None


def test_of_very_many_points_an_even_sample_is_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    rings, plane = gable(12, 8, 4, 0.3)
    point_m, num_points = sampled(rings, plane, 4, density=200.0), []

    def counted(some_m: np.ndarray, *others: Any) -> RoofPlanes:
        num_points.append(len(some_m))
        return detect(some_m, *others)

    monkeypatch.setattr("p2wss.fit.planes.fit.detect", counted)
    fit = fit_planes(rings, point_m, PLANES)
    assert fit is not None and residuals_m(fit, point_m).mean() < 0.03
    assert num_points == [int(PLANES.detection.max_per_m2 * 96) + 1] and len(point_m) > 19_000


def test_a_fit_does_not_depend_on_the_order_of_points() -> None:
    rings, plane = gable(12, 8, 4, 0.3)
    point_m = sampled(rings, plane, 4)
    one, other = fit_planes(rings, point_m, PLANES), fit_planes(rings, point_m[::-1], PLANES)
    assert one is not None and other is not None
    assert np.array_equal(one.plane, other.plane)


def test_points_on_a_regular_grid_have_borders() -> None:
    """As heights from pictures have, turned by another CRS, in whole millimetres: GEOS fails to triangulate these."""
    x, y = np.meshgrid(np.arange(12) * 0.3, np.arange(12) * 0.3)
    turn = np.radians(26.5)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    xy_m = np.round(np.column_stack([x.ravel(), y.ravel()]) @ rotation, 3)
    with pytest.raises(shapely.GEOSException):
        shapely.delaunay_triangles(shapely.MultiPoint(xy_m))
    label = (x.ravel() > 1.7).astype(int)
    point_m = np.column_stack([xy_m, label])
    links = lines._links(label, point_m, 0.4)
    side, _ = lines._borders(links, point_m)
    assert links.pair.tolist() == [[0, 1]] and np.bincount(side).tolist() == [12, 12]


def test_no_point_is_alone_in_a_strip() -> None:
    """Of one more than a strip has, the last is far from the others: GEOS refuses a line of one point."""
    xy_m = np.vstack([np.random.default_rng(0).uniform(0, 100, (lines._STRIP, 2)), [(110.0, 50.0)]])
    label = (xy_m[:, 0] > 50).astype(int)
    links = lines._links(label, np.column_stack([xy_m, label]), 1.5)
    assert links.pair.tolist() == [[0, 1]] and len(links.row) > 100


def test_a_step_by_a_corner_where_a_courtyard_touches_the_outline() -> None:
    """The corner is there twice, and no line goes from a place to itself."""
    ring = np.array([[0, 0], [5, 0], [10, 0], [10, 10], [0, 10.0]])
    corner_m = np.vstack([ring, [[5, 0], [4, 3], [6, 3]]])
    parts = lines._through_corners([Line(np.array([0.0, 1.0]), 0.1, -20.0, 20.0)], corner_m, 0.15)
    assert len(parts) == 4 and all(np.isfinite([*part.normal, part.offset_m]).all() for part in parts)


def test_a_plane_that_is_not_worth_its_price_is_no_roof() -> None:
    """A steep one of few points over a square metre, at the prices of little detail: it was an exception."""
    rng, size_m = np.random.default_rng(2), 1.05
    xy_m = rng.uniform(0, size_m, (56, 2))
    point_m = np.column_stack([xy_m, 3 + 3.4 * xy_m[:, 0]])
    point_m[25:, 2] = rng.uniform(3, 12, 31)
    ring = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]) * size_m
    assert fit_planes([ring], point_m, PLANES) is not None
    assert fit_planes([ring], point_m, PLANES.times(2.0)) is None


def test_too_many_places_are_found_before_what_passes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(arrangement, "_passed")
    ring = np.array([[0, 0], [50, 0], [50, 50], [0, 50.0]])
    grid = [Line(normal, x) for normal in np.eye(2) for x in np.linspace(1, 49, 20).tolist()]
    with pytest.raises(arrangement.TooManyPlacesError):
        arrange([ring], grid, 300)


def test_a_step_that_turns_has_a_line_along_each_of_its_parts() -> None:
    """A higher roof with a part that juts out: neither the border of both nor the sides of a rectangle around one of
    them show the lines of that part."""
    xy_m = np.random.default_rng(0).uniform(0, 24, (4000, 2))
    is_high = (xy_m[:, 0] > 15) | ((xy_m[:, 0] > 9) & (np.abs(xy_m[:, 1] - 12) < 3))
    point_m = np.column_stack([xy_m, np.where(is_high, 6.0, 4.0)])
    ring = np.array([[0, 0], [24, 0], [24, 24], [0, 24.0]])
    none = PLANES._replace(drawing=PLANES.drawing._replace(part_links=len(xy_m)))
    for settings, least, most in ((PLANES, 0.0, 0.01), (none, 0.03, 0.2)):
        fit = fit_planes([ring], point_m, settings)
        assert fit is not None
        assert least <= (residuals_m(fit, point_m) > 0.5).mean() <= most


def test_a_short_part_of_a_step_has_a_line() -> None:
    """A low annex with a part 1.7 m wide that reaches into the higher roof."""
    xy_m = np.random.default_rng(2).uniform([0, 0], [24, 16], (3840, 2))
    is_low = (xy_m[:, 1] < 5) | ((xy_m[:, 0] < 1.7) & (xy_m[:, 1] < 9.5))
    point_m = np.column_stack([xy_m, np.where(is_low, 4.0, 9.0)])
    ring = np.array([[0, 0], [24, 0], [24, 16], [0, 16.0]])
    fit = fit_planes([ring], point_m, PLANES)
    assert fit is not None and (residuals_m(fit, point_m) > 0.5).mean() < 0.005


@pytest.mark.parametrize("turn_deg", [4.0, 11.0, 30.0])
def test_a_step_runs_in_its_own_direction(turn_deg: float) -> None:
    """As in old towns, between two level roofs, which have no direction. It is straight: no stairs of lines."""
    xy_m = np.random.default_rng(0).uniform(0, 20, (4000, 2))
    is_high = xy_m[:, 0] > 10 + np.tan(np.radians(turn_deg)) * (xy_m[:, 1] - 10)
    point_m = np.column_stack([xy_m, np.where(is_high, 9.0, 5.0)])
    ring = np.array([[0, 0], [20, 0], [20, 20], [0, 20.0]])
    fit = fit_planes([ring], point_m, PLANES)
    assert fit is not None and (residuals_m(fit, point_m) > 0.5).mean() < 0.01
    assert len(fit.mesh.vertex_m) == 12


def test_sparse_points_of_a_large_building_show_all_its_roofs() -> None:
    """In a corner of each roof, points are scattered: where the search begins there, it goes on elsewhere."""
    rng = np.random.default_rng(0)
    xy_m = rng.uniform(0, 90, (20000, 2))
    roof = (xy_m // 30).astype(int) @ [3, 1]
    is_scattered = rng.uniform(size=len(xy_m)) < 0.3
    height_m = (
        10.0
        + 3 * roof
        + np.where(is_scattered, rng.uniform(-8, 8, len(xy_m)), rng.normal(0, 0.03, len(xy_m)))
    )
    point_m = np.column_stack([xy_m, height_m])
    found = detect(point_m, len(xy_m) / 90**2, [0.0], PLANES.detection)
    seen = found.label[~is_scattered] >= 0
    assert seen.mean() > 0.95
    for k in range(9):
        own = found.label[(roof == k) & ~is_scattered & (found.label >= 0)]
        largest = found.plane[np.bincount(own).argmax()]
        assert heights(largest[None], np.array([[30 * (k // 3) + 15.0, 30 * (k % 3) + 15.0]]))[
            0, 0
        ] == pytest.approx(10 + 3 * k, abs=0.1)
