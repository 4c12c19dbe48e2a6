"""A known roof, where points are few: its planes and lines, and the search that begins with it."""

from __future__ import annotations

import numpy as np
import pytest
from cell_costs import all_costs

from p2wss.fit.mesh.parametric import kernel_mesh
from p2wss.fit.planes.detection import heights
from p2wss.fit.planes.fit import fit_planes
from p2wss.fit.planes.known import known_lines, known_planes
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
