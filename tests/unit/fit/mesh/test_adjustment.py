"""Adjusted planes: nearer to the points, the same faces, walls and vertices, and nothing at all without a gain."""

from __future__ import annotations

import numpy as np
import pytest
from kernel_unions import union

from p2wss.fit.mesh.adjustment import adjusted
from p2wss.fit.mesh.simplification import is_sound
from p2wss.fit.roof.fitter import FittedRoof
from p2wss.mesh import Mesh
from p2wss.mesh.surface import topmost

HOUSE = np.array([[0, 0], [12, 0], [12, 8], [0, 8.0]])
NOISE_M = 0.02


def house(angle_deg: list[float], eave_m: float = 4.0) -> Mesh:
    roof = FittedRoof([HOUSE], np.array(angle_deg, float), eave_m, 0.0)
    return union([roof], 1.0, 50.0)


def heights_m(mesh: Mesh, xy_m: np.ndarray) -> np.ndarray:
    corner_m = np.ascontiguousarray(mesh.vertex_m[mesh.triangle])
    return topmost(corner_m, np.column_stack([xy_m, np.zeros(len(xy_m))]))[1]


def points(height_m, num_points: int = 600) -> np.ndarray:
    """Points over the house at ``height_m(x, y)``."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform([0.05, 0.05], [11.95, 7.95], (num_points, 2)).T
    return np.column_stack([x, y, height_m(x, y) + NOISE_M * rng.standard_normal(num_points)])


def mean_residual_m(mesh: Mesh, point_m: np.ndarray) -> float:
    return float(np.abs(heights_m(mesh, point_m[:, :2]) - point_m[:, 2]).mean())


def leaning_gable(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A gable roof of 40 degrees whose ridge rises by 0.4 m over its length and is not quite parallel to the walls."""
    across = np.abs(y - 4.0 - 0.02 * (x - 6.0))
    return 4.0 + np.tan(np.radians(40)) * (4.0 - across) + 0.4 * (x - 6.0) / 12.0


@pytest.mark.parametrize("angle_deg", [[40, 90, 40, 90], [40, 60, 40, 60], [40, 35, 40, 35]])
def test_the_planes_move_to_the_points_and_nothing_else_changes(angle_deg) -> None:
    mesh = house(angle_deg)
    truth = heights_m(mesh, points(leaning_gable)[:, :2])
    point_m = points(lambda x, y: truth + 0.04 * (x - 6.0) - 0.03 * (y - 4.0))

    result = adjusted(mesh, [HOUSE], point_m)

    assert mean_residual_m(mesh, point_m) > 0.1
    assert mean_residual_m(result, point_m) < 1.5 * NOISE_M
    np.testing.assert_array_equal(result.triangle, mesh.triangle)
    np.testing.assert_array_equal(result.label, mesh.label)
    is_low = mesh.vertex_m[:, 2] < 1.0
    np.testing.assert_array_equal(result.vertex_m[is_low], mesh.vertex_m[is_low])
    assert result.is_closed
    assert is_sound(result)


def test_faces_stay_plane_where_four_of_them_meet() -> None:
    pyramid = np.array([[0, 0], [8, 0], [8, 8], [0, 8.0]])
    mesh = union([FittedRoof([pyramid], np.full(4, 40.0), 4.0, 0.0)], 1.0, 50.0)
    assert len(mesh.vertex_m) == 9
    rng = np.random.default_rng(1)
    xy_m = rng.uniform(0.1, 7.9, (500, 2))
    point_m = np.column_stack([xy_m, heights_m(mesh, xy_m) + 0.05 * (xy_m[:, 0] - 4)])

    result = adjusted(mesh, [pyramid], point_m)

    assert mean_residual_m(result, point_m) < 0.3 * mean_residual_m(mesh, point_m)
    for plane in np.unique(mesh.label):
        corner_m = result.vertex_m[np.unique(mesh.triangle[mesh.label == plane])]
        assert np.linalg.svd(corner_m - corner_m.mean(axis=0))[1][2] < 1e-3


def test_a_leaning_ridge() -> None:
    mesh = house([40, 90, 40, 90])
    point_m = points(leaning_gable)
    result = adjusted(mesh, [HOUSE], point_m)
    assert mean_residual_m(result, point_m) < 1.5 * NOISE_M < 0.5 * mean_residual_m(mesh, point_m)
    ridge_m = result.vertex_m[np.argsort(result.vertex_m[:, 2])[-2:]]
    assert abs(np.ptp(ridge_m[:, 2])) == pytest.approx(0.4, abs=0.05)


def test_a_level_roof_stays_level() -> None:
    mesh = house([0, 0, 0, 0])
    result = adjusted(mesh, [HOUSE], points(lambda x, y: 4.3 + 0.03 * (x - 6.0)))
    top_m = result.vertex_m[result.vertex_m[:, 2] > 1.0, 2]
    assert np.ptp(top_m) == 0.0
    assert top_m[0] == pytest.approx(4.3, abs=0.02)


def test_the_mesh_itself_without_a_gain_and_without_points() -> None:
    mesh = house([40, 90, 40, 90])
    xy_m = points(leaning_gable)[:, :2]
    assert adjusted(mesh, [HOUSE], np.column_stack([xy_m, heights_m(mesh, xy_m)])) is mesh
    assert adjusted(mesh, [HOUSE], np.zeros((0, 3))) is mesh
    assert adjusted(mesh, [HOUSE], np.array([[50.0, 50.0, 3.0]])) is mesh


def test_only_those_vertices_are_held_back_at_which_the_mesh_would_not_be_valid() -> None:
    """The points over the annex turn its roof further than is allowed; the roof of the house moves all the same."""
    annex = np.array([[12, 0], [16, 0], [16, 8], [12, 8.0]])
    shed_deg = np.array([90, 90, 90, 10.0])
    parts = [
        FittedRoof([HOUSE], np.array([40, 90, 40, 90.0]), 6.0, 0.0),
        FittedRoof([annex], shed_deg, 3.0, 0.0),
    ]
    mesh = union(parts, 1.0, 50.0)
    house_m = points(lambda x, y: leaning_gable(x, y) + 2.0)
    xy_m = np.random.default_rng(2).uniform([12.05, 0.05], [15.95, 7.95], (300, 2))
    annex_m = np.column_stack([xy_m, heights_m(mesh, xy_m) + 0.2 * (xy_m[:, 0] - 14.0)])
    outline = np.array([[0, 0], [16, 0], [16, 8], [0, 8.0]])

    result = adjusted(mesh, [outline], np.vstack([house_m, annex_m]))

    assert mean_residual_m(mesh, house_m) > 3 * NOISE_M
    assert mean_residual_m(result, house_m) < 1.5 * NOISE_M
    assert mean_residual_m(result, annex_m) < mean_residual_m(mesh, annex_m)
    is_annex = (mesh.vertex_m[:, 0] > 15.9) & (mesh.vertex_m[:, 2] > 1.0)
    assert np.abs(result.vertex_m[is_annex] - mesh.vertex_m[is_annex]).max() < np.tan(np.radians(8)) * 4.0
    assert is_sound(result)


def test_planes_do_not_follow_a_tree() -> None:
    """The result is that without the points of the tree."""
    mesh = house([40, 90, 40, 90])
    point_m = points(leaning_gable)
    is_tree = point_m[:, 0] > 9.0
    with_tree_m = point_m + np.column_stack([np.zeros((len(point_m), 2)), 2.0 * is_tree])
    result = adjusted(mesh, [HOUSE], with_tree_m)
    assert np.abs(result.vertex_m - mesh.vertex_m).max() > 0.05
    np.testing.assert_allclose(
        result.vertex_m, adjusted(mesh, [HOUSE], point_m[~is_tree]).vertex_m, atol=1e-9
    )


@pytest.mark.parametrize(("step_m", "wall_m"), [(6.25, 6.25), (5.9, 5.9), (6.02, 6.0)])
def test_a_wall_moves_to_the_step(step_m, wall_m) -> None:
    west, east = (np.array([[a, 0], [b, 0], [b, 8], [a, 8.0]]) for a, b in ((0.0, 6.0), (6.0, 12.0)))
    roofs = [FittedRoof([ring], np.zeros(4), z, 0.0) for ring, z in ((west, 5.0), (east, 4.0))]
    mesh = union(roofs, 1.0, 50.0)
    result = adjusted(mesh, [HOUSE], points(lambda x, y: np.where(x < step_m, 5.0, 4.0)))
    is_inner = (result.vertex_m[:, 0] > 1.0) & (result.vertex_m[:, 0] < 11.0)
    assert is_inner.sum() >= 4
    np.testing.assert_allclose(result.vertex_m[is_inner, 0], wall_m, atol=1e-6)
    assert is_sound(result)


@pytest.mark.parametrize("num_edges", [40, 250])
def test_a_round_tower_stays_as_it_is(num_edges) -> None:
    """All of its planes meet at one vertex, for which the equations would take gigabytes."""
    angle = np.linspace(0, 2 * np.pi, num_edges, endpoint=False)
    ring = 20 * np.column_stack([np.cos(angle), np.sin(angle)])
    mesh = union([FittedRoof([ring], np.full(num_edges, 30.0), 5.0, 0.0)], 1.0, 50.0)
    xy_m = np.random.default_rng(0).uniform(-14, 14, (3000, 2))
    point_m = np.column_stack([xy_m, heights_m(mesh, xy_m) + 0.03 * xy_m[:, 0]])
    assert adjusted(mesh, [ring], point_m) is mesh
