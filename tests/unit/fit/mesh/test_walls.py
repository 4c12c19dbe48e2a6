"""Outer walls of meshes stand on the edges of the footprint, whatever unions and rotations did to them."""

from __future__ import annotations

import numpy as np
import pytest
from kernel_unions import union

from p2wss import skeleton
from p2wss.fit.mesh.walls import with_exact_walls
from p2wss.fit.roof.fitter import FittedRoof
from p2wss.mesh import Mesh
from p2wss.skeleton import Polygons

TURN = np.radians(31.7)
ROTATION = np.array([[np.cos(TURN), np.sin(TURN)], [-np.sin(TURN), np.cos(TURN)]])
# an L with a courtyard, at no round coordinates
EXTERIOR = np.array([[0, 0], [20, 0], [20, 12], [9, 12], [9, 18], [0, 18]]) @ ROTATION + 0.123456789
COURTYARD = np.array([[4, 4], [4, 8], [14, 8], [14, 4]]) @ ROTATION + 0.123456789


def solid(angle_deg: float) -> Mesh:
    meshes = skeleton.build(
        Polygons.from_rings([[EXTERIOR, COURTYARD]]), np.full(10, angle_deg), np.array([6.0])
    )
    assert meshes.status[0] == skeleton.Status.OK
    return Mesh.of_kernel(meshes, 0)


def test_corners_are_those_of_the_footprint_to_the_bit() -> None:
    mesh = solid(40)
    vertex_m = mesh.vertex_m
    noise = np.random.default_rng(0).uniform(-1e-11, 1e-11, vertex_m.shape)
    exact = with_exact_walls(mesh.moved(vertex_m + noise), [EXTERIOR, COURTYARD]).vertex_m
    corners = {tuple(corner) for ring in (EXTERIOR, COURTYARD) for corner in ring.tolist()}
    assert corners <= {tuple(xy) for xy in exact[:, :2].tolist()}
    assert np.abs(exact - vertex_m).max() < 1e-9


@pytest.mark.parametrize("corner", range(10))
def test_a_vertex_that_left_its_walls_comes_back_and_stays_on_its_roofs(corner: int) -> None:
    """The upper end of the walls at a corner has moved by 2 cm on its roofs, as the removal of slivers does."""
    mesh = solid(40)
    vertex_m = mesh.vertex_m
    place = np.concatenate([EXTERIOR, COURTYARD])[corner]
    at = np.hypot(*(vertex_m[:, :2] - place).T) < 1e-6
    top = int(np.flatnonzero(at & (vertex_m[:, 2] > 1))[0])
    moved = vertex_m.copy()
    moved[top, :2] += 0.02 * np.array([np.cos(1.0), np.sin(1.0)])
    exact = with_exact_walls(mesh.moved(moved), [EXTERIOR, COURTYARD]).vertex_m
    assert exact[top, :2].tolist() == place.tolist()
    assert exact[top, 2] == pytest.approx(vertex_m[top, 2], abs=0.02)
    others = np.arange(len(exact)) != top
    assert np.abs(exact - vertex_m)[others].max() < 1e-9


def test_the_wall_of_a_step_near_an_edge_stays() -> None:
    """Two parts of different heights, the higher one set back by 2.5 cm from the long wall of the lower one."""
    low = np.array([[0, 0], [10, 0], [10, 8], [0, 8]], float)
    high = np.array([[2, 0.025], [6, 0.025], [6, 6], [2, 6]])
    parts = [FittedRoof([ring], np.zeros(4), height, 0.0) for ring, height in ((low, 4.0), (high, 7.0))]
    mesh = union(parts, 1.0, 12.0)
    exact = with_exact_walls(mesh, [low]).vertex_m
    assert np.array_equal(exact, mesh.vertex_m)
    assert (np.abs(exact[:, 1] - 0.025) < 1e-9).sum() >= 4


def test_a_building_of_parts_keeps_its_corners() -> None:
    """The union is made in a rotated frame; afterwards the corners are exactly those of the footprint again."""
    ring = np.array([[0, 0], [16, 0], [16, 9], [0, 9]]) @ ROTATION + 0.123456789
    turned = ring @ ROTATION.T
    middle = turned[:, 0].mean()
    sides = (
        np.array([turned[0], [middle, turned[1, 1]], [middle, turned[2, 1]], turned[3]]),
        np.array([[middle, turned[0, 1]], turned[1], turned[2], [middle, turned[3, 1]]]),
    )
    parts = [
        FittedRoof([side], np.array([40.0, 90, 40, 90]), height, 0.0)
        for side, height in zip(sides, (5.0, 7.0), strict=True)
    ]
    mesh = union(parts, 1.0, 12.0)
    vertex_m = np.column_stack([mesh.vertex_m[:, :2] @ ROTATION, mesh.vertex_m[:, 2]])
    exact = with_exact_walls(mesh.moved(vertex_m), [ring]).vertex_m
    corners = set(map(tuple, ring.tolist()))
    assert corners <= {tuple(xy) for xy in exact[:, :2].tolist()}
    assert not corners <= {tuple(xy) for xy in vertex_m[:, :2].tolist()}
    assert np.abs(exact - vertex_m).max() < 1e-9
