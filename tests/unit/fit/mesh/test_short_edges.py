"""Short edges vanish where the points do not need them; walls on the footprint stay where they are."""

from __future__ import annotations

import numpy as np
import pytest
from kernel_unions import union

from p2wss.fit.mesh.short_edges import without_short_edges
from p2wss.fit.mesh.simplification import is_sound
from p2wss.fit.roof.fitter import FittedRoof
from p2wss.mesh import Mesh
from p2wss.skeleton import FaceKind

WEST = np.array([[0, 0], [6, 0], [6, 8], [0, 8.0]])
EAST = np.array([[6, 0], [10, 0], [10, 8], [6, 8.0]])
BOTH = np.array([[0, 0], [10, 0], [10, 8], [0, 8.0]])
NOTCHED = np.array([[0, 0], [10, 0], [10, 5], [6.1, 5], [6.1, 8], [0, 8.0]])


def house(*parts: tuple[np.ndarray, list[float], float]) -> Mesh:
    roofs = [FittedRoof([ring], np.array(angle_deg, float), z, 0.0) for ring, angle_deg, z in parts]
    return union(roofs, 1.0, 12.0)


def level_points(*levels: tuple[np.ndarray, float]) -> np.ndarray:
    """Four points per m² over rectangles at given heights."""
    rows = []
    for ring, z_m in levels:
        low, high = ring.min(axis=0), ring.max(axis=0)
        num = int(4 * np.prod(high - low))
        rows.append(
            np.column_stack([np.random.default_rng(0).uniform(low, high, (num, 2)), np.full(num, z_m)])
        )
    return np.vstack(rows)


def volume_m3(mesh: Mesh) -> float:
    corner = mesh.vertex_m[mesh.triangle]
    return float(np.einsum("ti,ti->t", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() / 6)


def test_a_step_of_centimetres_vanishes() -> None:
    mesh = house((WEST, [0] * 4, 5.0), (EAST, [0] * 4, 5.06))
    assert len(mesh.triangle) > 12
    flat = without_short_edges(mesh, [BOTH], level_points((WEST, 5.0), (EAST, 5.06)), 50.0)
    assert len(flat.triangle) == 12 and flat.is_closed and is_sound(flat)
    # each roof shifts by less the more points it has: 4 / 10 and 6 / 10 of the step
    assert flat.vertex_m[:, 2].max() == pytest.approx(5.024, abs=0.002)
    assert volume_m3(flat) == pytest.approx(volume_m3(mesh), rel=1e-3)


def test_steps_that_the_points_pay_for_stay() -> None:
    points = level_points((WEST, 5.0), (EAST, 5.06))
    mesh = house((WEST, [0] * 4, 5.0), (EAST, [0] * 4, 5.06))
    assert without_short_edges(mesh, [BOTH], points, 0.5) is mesh
    high = house((WEST, [0] * 4, 5.0), (EAST, [0] * 4, 5.5))
    assert without_short_edges(high, [BOTH], points, 1e6) is high


def test_equal_slopes_become_one_plane() -> None:
    mesh = house((WEST, [40, 90, 40, 90], 5.0), (EAST, [40, 90, 40, 90], 5.1))
    slope = np.tan(np.radians(40))
    points = level_points((BOTH, 5.05))
    points[:, 2] += slope * np.minimum(points[:, 1], 8 - points[:, 1])
    flat = without_short_edges(mesh, [BOTH], points, 50.0)
    # one gable roof
    assert len(flat.triangle) == 16 and is_sound(flat)
    assert flat.vertex_m[:, 2].max() == pytest.approx(5.05 + 4 * slope, abs=0.03)


def test_a_cut_beside_a_corner_moves_to_it_and_the_footprint_stays() -> None:
    west = np.array([[0, 0], [6, 0], [6, 8], [0, 8.0]])
    east = np.array([[6, 0], [10, 0], [10, 5], [6.1, 5], [6.1, 8], [6, 8.0]])
    mesh = house((west, [0] * 4, 6.0), (east, [0] * 6, 4.0))
    points = level_points((WEST, 6.0), (np.array([[6, 0], [10, 5]]), 4.0))
    flat = without_short_edges(mesh, [NOTCHED], points, 150.0)
    assert len(flat.triangle) < len(mesh.triangle) and flat.is_closed
    on_floor = flat.vertex_m[flat.vertex_m[:, 2] < 0.1, :2]
    assert sorted(map(tuple, on_floor.round(9).tolist())) == sorted(map(tuple, NOTCHED.tolist()))
    is_step = (np.abs(flat.vertex_m[:, 0] - 6.1) < 1e-6) & (flat.vertex_m[:, 1] < 1e-6)
    assert is_step.sum() == 2


def test_without_points_over_the_roofs_edges_stay() -> None:
    mesh = house((WEST, [0] * 4, 5.0), (EAST, [0] * 4, 5.06))
    assert without_short_edges(mesh, [BOTH], np.array([[-50.0, -50.0, 5.0]]), 0.5) is mesh


@pytest.mark.parametrize("kind", [FaceKind.ROOF, FaceKind.WALL])
def test_a_plane_without_area_is_no_reason_to_fail(kind) -> None:
    """Beside a ridge there is a triangle without area, 5 cm of whose side are a short edge."""
    house_mesh = house((BOTH, [40, 90, 40, 90], 5.0))
    vertex_m, is_top = house_mesh.vertex_m, house_mesh.vertex_m[:, 2] > 6
    at_ridge = is_top[house_mesh.triangle].sum(axis=1) == 2
    row = int(np.flatnonzero(at_ridge & (house_mesh.kind == FaceKind.ROOF))[0])
    corners = house_mesh.triangle[row].tolist()
    turn = next(k for k in range(3) if not is_top[corners[k]])
    foot, start, end = corners[turn:] + corners[:turn]
    between = len(vertex_m)
    along_m = vertex_m[end] - vertex_m[start]
    rows = [[foot, start, between], [foot, between, end], [start, end, between]]
    mesh = Mesh(
        np.vstack([vertex_m, vertex_m[start] + 0.05 * along_m / np.linalg.norm(along_m)]),
        np.vstack([np.delete(house_mesh.triangle, row, axis=0), rows]).astype(np.int32),
        np.append(np.delete(house_mesh.kind, row), [FaceKind.ROOF, FaceKind.ROOF, kind]).astype(np.uint8),
        np.append(np.delete(house_mesh.label, row), [*2 * [house_mesh.label[row]], 99]).astype(np.int32),
    )
    assert mesh.is_closed and mesh.planes.area_m2.min() == 0 and np.isfinite(mesh.planes.normal).all()
    points = level_points((BOTH, 5.05))
    points[:, 2] += np.tan(np.radians(38)) * np.minimum(points[:, 1], 8 - points[:, 1])
    result = without_short_edges(mesh, [BOTH], points, 50.0)
    assert result.is_closed and np.isfinite(result.vertex_m).all()
    assert volume_m3(result) == pytest.approx(volume_m3(mesh), rel=0.05)
