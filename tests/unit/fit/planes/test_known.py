"""A known roof, where points are few: its planes and lines, and the search that begins with it."""

from __future__ import annotations

import numpy as np
import pytest
from cell_costs import all_costs
from toy_roofs import sample

from p2wss.fit.parametric import kernel_mesh
from p2wss.fit.planes.detection import height_over, heights
from p2wss.fit.planes.fit import PlanesFit, fit_planes
from p2wss.fit.planes.known import between_lines, known_lines, known_planes, mapped_planes, num_on
from p2wss.fit.planes.labelling import least_cost
from p2wss.fit.planes.lines import ends_of
from p2wss.fit.settings import Planes
from p2wss.mesh import Mesh

PLANES = Planes()
RECTANGLE = np.array([[0.0, 0.0], [12.0, 0.0], [12.0, 8.0], [0.0, 8.0]])


def roof(*angle_deg: float, eave_height_m: float = 4.0) -> Mesh:
    mesh = kernel_mesh([RECTANGLE], np.array(angle_deg), eave_height_m, 99.0)
    assert mesh is not None
    return mesh


def test_a_hip_roof_has_four_planes_and_five_lines() -> None:
    mesh = roof(45, 45, 45, 45)
    # one in the middle of each slope, a metre from its eave, and the roof there
    place_m = np.array([[6.0, 1.0], [11.0, 4.0], [6.0, 7.0], [1.0, 4.0]])
    plane = known_planes(mesh)
    assert len(plane) == 4
    assert heights(plane, place_m).min(axis=1) == pytest.approx(5.0)
    end_m = ends_of(known_lines(mesh))
    length_m = np.linalg.norm(end_m[:, 1] - end_m[:, 0], axis=1)
    assert np.sort(length_m) == pytest.approx([4.0] + [np.hypot(4, 4)] * 4, abs=0.05)
    # they reach the corners and the ends of the ridge
    for corner_m in [*RECTANGLE, (4.0, 4.0), (8.0, 4.0)]:
        assert np.linalg.norm(end_m.reshape(-1, 2) - corner_m, axis=1).min() < 0.02


def test_a_level_roof_has_one_plane_and_no_lines() -> None:
    assert known_planes(roof(0, 0, 0, 0)) == pytest.approx(np.array([[0.0, 0.0, 4.0]]))
    assert known_lines(roof(0, 0, 0, 0)) == []


def test_few_points_on_a_known_roof_give_that_roof_and_what_else_they_show() -> None:
    mesh = roof(20, 20, 20, 20)
    # three on each slope
    south, west = (
        np.array([[3.0, 1.0], [6.0, 2.5], [9.0, 1.0]]),
        np.array([[1.0, 3.0], [2.5, 4.0], [1.0, 5.0]]),
    )
    xy_m = np.vstack([south, west, [12.0, 8.0] - south, [12.0, 8.0] - west])
    few_m = np.column_stack([xy_m, heights(known_planes(mesh), xy_m).min(axis=1)])
    found, alone = (fit_planes([RECTANGLE], few_m, PLANES, known=each) for each in (mesh, None))
    assert found is not None and alone is not None
    assert found.mesh.volume_m3 == pytest.approx(mesh.volume_m3, rel=1e-3)
    assert abs(alone.mesh.volume_m3 / mesh.volume_m3 - 1) > 0.01
    # a tower that the known roof does not have
    tower_m = np.array([[x, y, 11.0] for x in (9.0, 10.0, 11.0) for y in (1.0, 3.0, 5.0, 7.0)])
    both = fit_planes([RECTANGLE], np.vstack([few_m[xy_m[:, 0] < 8], tower_m]), PLANES, known=mesh)
    assert both is not None
    height_m = both.mesh.vertex_m[:, 2]
    assert height_m.max() == pytest.approx(11.0) and np.abs(height_m - 4.0).min() < 0.01


def test_the_search_begins_with_the_known_planes() -> None:
    """Two cells, which each plane covers at the same cost."""
    cell_m3, pair = np.array([[1.0, 2.0, 1.0, 2.0], [1.0, 2.0, 1.0, 2.0]]), np.array([[0, 1]])
    costs = all_costs(cell_m3, pair, np.ones(1), PLANES.prices)
    assert least_cost(costs).tolist() == [0, 0]
    assert least_cost(costs, 2).tolist() == [2, 2]
    assert least_cost(costs, 1).tolist() == [0, 0]


GRID_M = np.stack(np.meshgrid(np.arange(0.5, 12), np.arange(0.5, 8)), -1).reshape(-1, 2)


def error_m(fit: PlanesFit | None, mesh: Mesh) -> float:
    """How far a fit is from a convex roof, on average."""
    assert fit is not None
    height_m = height_over(fit.plane, fit.label[fit.cells.cells_at(GRID_M)], GRID_M)
    return float(np.abs(height_m - heights(known_planes(mesh), GRID_M).min(axis=1)).mean())


@pytest.mark.parametrize("seed", [0, 3, 5])
def test_lines_of_a_map_show_what_few_points_do_not(seed: int) -> None:
    """20 points on a hip roof, off by a decimetre, and its ridge and hips, of whose ends none meets another; the search
    begins with a lower roof."""
    mesh = roof(40, 40, 40, 40)
    point_m = sample([RECTANGLE], [40] * 4, 4.0, 20, 0.1, seed=seed)
    end_m = ends_of(known_lines(mesh))
    end_m = 0.95 * end_m + 0.05 * end_m.mean(axis=1, keepdims=True)
    low = roof(20, 20, 20, 20, eave_height_m=5.0)
    alone, found = (
        fit_planes([RECTANGLE], point_m, PLANES, known=low, line_m=each) for each in (None, end_m)
    )
    assert error_m(alone, mesh) > 0.2 and error_m(found, mesh) < 0.1
    assert alone is not None and alone.num_lines_used == 0
    assert found is not None and found.num_lines_used >= 4


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_line_of_a_map_that_points_contradict_is_not_used(seed: int) -> None:
    """A ridge 2 m beside the true one, hips of a roof 1.5 m beside, and a line across a slope; the search begins with a
    lower roof. Without it, as where points are many, lines of a map are no candidates."""
    mesh = roof(40, 40, 40, 40)
    point_m = sample([RECTANGLE], [40] * 4, 4.0, 90, 0.1, seed=seed)
    low = roof(20, 20, 20, 20, eave_height_m=5.0)
    alone = fit_planes([RECTANGLE], point_m, PLANES, known=low)
    assert alone is not None
    for end_m in (
        np.array([[[2.0, 2.0], [10.0, 2.0]]]),
        ends_of(known_lines(mesh)) + np.array([0.0, 1.5]),
        np.array([[[6.0, 0.5], [6.0, 3.5]]]),
    ):
        found = fit_planes([RECTANGLE], point_m, PLANES, known=low, line_m=end_m)
        assert found is not None and found.num_lines_used == 0
        assert error_m(found, mesh) == pytest.approx(error_m(alone, mesh), abs=1e-3)


def test_planes_between_the_lines_of_a_map_meet_there() -> None:
    """Of an exact hip roof, two of whose slopes have a single point."""
    mesh = roof(40, 40, 40, 40)
    xy_m = np.array([(3.0, 1.0), (6.0, 2.0), (9.0, 1.5), (11.0, 4.0), (6.0, 7.0)])
    point_m = np.column_stack([xy_m, heights(known_planes(mesh), xy_m).min(axis=1)])
    cells = between_lines([RECTANGLE], ends_of(known_lines(mesh)), PLANES.drawing, PLANES.limits)
    assert cells is not None
    plane = mapped_planes(cells, point_m, np.full(len(point_m), 2.0), PLANES.limits)
    assert len(plane) == 4
    is_inner = (cells.pair >= 0).all(axis=1)
    for one, other, ends in zip(*cells.pair[is_inner].T, cells.xy_m[cells.side[is_inner]], strict=True):
        assert np.ptp(heights(plane[[one, other]], ends), axis=1).max() < 1e-4


def test_a_step_that_points_show_remains_at_a_line() -> None:
    """A low half, shown by four points, beside a high one: planes do not bend to meet."""
    end_m = np.array([[[5.0, 0.5], [5.0, 7.5]]])
    cells = between_lines([RECTANGLE], end_m, PLANES.drawing, PLANES.limits)
    assert cells is not None
    xy_m = np.array([(x, y) for x in (1.0, 4.0, 6.0, 11.0) for y in (1.0, 7.0)])
    point_m = np.column_stack([xy_m, np.where(xy_m[:, 0] < 5, 3.0, 6.0)])
    plane = mapped_planes(cells, point_m, np.full(8, 12.0), PLANES.limits)
    assert plane[np.argsort(plane[:, 2])] == pytest.approx(np.array([[0, 0, 3.0], [0, 0, 6.0]]), abs=0.05)


def test_of_lines_that_cross_in_too_many_places_the_longest_count() -> None:
    rng = np.random.default_rng(0)
    end_m = rng.uniform((0, 0), (12, 8), (150, 2, 2))
    cells = between_lines([RECTANGLE], end_m, PLANES.drawing, PLANES.limits)
    assert cells is not None and len(cells.xy_m) <= PLANES.limits.num_mapped_places
    num = len(cells.lines) - cells.num_edges
    assert 10 < num < 150
    longest_m = np.sort(np.hypot(*(end_m[:, 1] - end_m[:, 0]).T))[-num:]
    length_m = [
        line.high_m - line.low_m - 2 * PLANES.drawing.mapped_gap_m for line in cells.lines[cells.num_edges :]
    ]
    assert np.sort(length_m) == pytest.approx(longest_m)
    assert between_lines([RECTANGLE], end_m[:0], PLANES.drawing, PLANES.limits) is None


def test_a_line_is_used_where_edges_of_the_roof_are_along_half_of_it() -> None:
    line_m = np.array([[[0.0, 0.0], [10.0, 0.0]], [[0.0, 3.0], [0.0, 9.0]]])
    edge_m = np.array([[[4.0, 0.05], [1.0, 0.0]], [[7.0, -0.05], [12.0, 0.0]], [[0.0, 0.0], [0.0, 5.9]]])
    assert [num_on(line_m, edge_m[:n], 0.1) for n in (1, 2, 3)] == [0, 1, 1]
    assert num_on(line_m[:0], edge_m, 0.1) == 0 and num_on(line_m, edge_m[:0], 0.1) == 0
