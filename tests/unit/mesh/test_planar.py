"""Roofs become planes to the micrometre, and short edges go, without a wall that moves."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawn_towns.planes import mesh_of
from kernel_unions import union
from toy_roofs import bent_ridge

from p2wss import skeleton
from p2wss.fit.parametric import FittedRoof
from p2wss.fit.planes.arrangement import arrange
from p2wss.fit.planes.lines import Line
from p2wss.fit.planes.solid import solid_below
from p2wss.mesh import Mesh, planar
from p2wss.mesh.meeting import _solved, with_meeting_planes
from p2wss.mesh.planar import SHORT_EDGE_M, with_exact_faces
from p2wss.mesh.rules import crosses_itself
from p2wss.mesh.triangulation import triangulated_in_space
from p2wss.skeleton import FaceKind, Polygons

RING = np.array([[0, 0], [12, 0], [12, 8], [0, 8]], float)


def hip() -> Mesh:
    meshes = skeleton.build(Polygons.from_rings([[RING]]), np.full(4, 40.0), np.array([5.0]))
    return Mesh.of_kernel(meshes, 0)


def boxes(step_m: float) -> Mesh:
    """Two level roofs side by side, the second higher by ``step_m``."""
    halves = [RING * [0.5, 1], RING * [0.5, 1] + [6, 0]]
    levels = (5.0, 5.0 + step_m)
    return union([FittedRoof([xy], np.full(4, 90.0), z, 0.0) for xy, z in zip(halves, levels, strict=True)])


def test_the_smaller_of_two_roofs_changes_more_for_a_short_edge() -> None:
    parts = [RING * [5 / 6, 1], RING * [1 / 6, 1] + [10, 0]]
    heights = zip(parts, (5.0, 5.12), strict=True)
    step = union([FittedRoof([xy], np.full(4, 90.0), z, 0.0) for xy, z in heights])
    exact = with_exact_faces(step, 0.2)
    assert len(exact.triangle) < len(step.triangle)
    at_large_m = exact.vertex_m[(exact.vertex_m[:, 2] > 1) & (exact.vertex_m[:, 0] < 1), 2]
    assert at_large_m == pytest.approx(5 + 0.12 / (1 + 5**0.5), abs=1e-3)


def furthest_m(mesh: Mesh) -> float:
    """How far a vertex is from the plane of least squares of its face."""
    result = 0.0
    for surface in mesh.surfaces:
        corner_m = mesh.vertex_m[np.concatenate(surface.rings)]
        corner_m = corner_m - corner_m.mean(axis=0)
        result = max(result, float(np.abs(corner_m @ np.linalg.svd(corner_m)[2][2]).max()))
    return result


def test_faces_are_not_divided_anew_where_they_would_cross_walls() -> None:
    """A corner between two walls that are nearly one is a centimetre above its roof. A triangle between it and its
    neighbours, which has the diagonals of Delaunay, lies on the wall below."""
    xy_m = np.array([(0, 0), (0.012, -1.2e-6), (0.02, 0), (75, 100), (-75, 100)])
    vertex_m = np.vstack(
        [np.column_stack([xy_m, height_m]) for height_m in ([10, 10.01, 10, 10, 10], [0] * 5)]
    )
    roof = np.array([(0, 1, 4), (1, 3, 4), (1, 2, 3)])
    wall = [side for k in range(5) for n in [(k + 1) % 5] for side in ((k, 5 + k, 5 + n), (k, 5 + n, n))]
    kinds = [FaceKind.FLAT] * 3 + [FaceKind.GROUND] * 3 + [FaceKind.WALL] * 10
    mesh = Mesh(
        vertex_m,
        np.array([*roof, *(5 + roof[:, ::-1]), *wall], np.int32),
        np.array(kinds, np.uint8),
        np.array([0] * 3 + [1] * 3 + [2 + k // 2 for k in range(10)], np.int32),
    )
    assert mesh.is_closed and not crosses_itself(mesh.vertex_m, mesh.triangle)
    divided = planar.with_faces_divided(mesh, np.ones(len(vertex_m), bool))
    assert divided is not mesh and crosses_itself(divided.vertex_m, divided.triangle)
    assert planar._without_slivers(mesh) is mesh


def test_bent_roofs_become_planes_and_walls_stay() -> None:
    mesh = hip()
    bent = mesh.vertex_m.copy()
    bent[bent[:, 2] > 1, 2] += np.random.default_rng(0).uniform(-9e-3, 9e-3, (bent[:, 2] > 1).sum())
    exact = with_exact_faces(mesh.moved(bent))
    assert furthest_m(mesh.moved(bent)) > 2e-4 and furthest_m(exact) < 1e-6
    is_corner = bent[:, 2] < 5.1
    assert is_corner.sum() == 8 and (exact.vertex_m[is_corner, :2] == bent[is_corner, :2]).all()
    assert np.abs(exact.vertex_m - bent).max() < 0.02
    assert (exact.vertex_m[bent[:, 2] == 0, 2] == 0).all()


def test_roofs_far_from_each_other_are_as_alone() -> None:
    draw, houses = np.random.default_rng(1), []
    for number in range(40):
        mesh = hip().translated([20.0 * number, 0, 0])
        bent_m = draw.uniform(-9e-3, 9e-3, len(mesh.vertex_m)) * (mesh.vertex_m[:, 2] > 1) * (number != 7)
        houses.append(mesh.moved(mesh.vertex_m + bent_m[:, None] * [0, 0, 1]))
    together = Mesh.joined(houses)
    moved, apart_m = with_meeting_planes(together, np.arange(len(together.vertex_m)))
    assert apart_m.max() < 1e-6
    for house, vertex_m in zip(houses, np.split(moved.vertex_m, len(houses)), strict=True):
        alone, _ = with_meeting_planes(house, np.arange(len(house.vertex_m)))
        assert np.abs(vertex_m - alone.vertex_m).max() < 1e-8
    assert (moved.vertex_m.reshape(40, -1, 3)[7] == houses[7].vertex_m).all()


def test_a_corner_comes_to_where_planes_meet_that_do_not_move() -> None:
    mesh = hip()
    corner = int(np.flatnonzero(mesh.vertex_m[:, 2] == 0)[0])
    is_corner = np.arange(len(mesh.vertex_m)) == corner
    bent = mesh.moved(mesh.vertex_m + 1e-3 * is_corner[:, None] * [0, 0, 1])
    moved, apart_m = with_meeting_planes(bent, np.arange(len(is_corner)))
    assert apart_m.max() < 1e-6 and moved.vertex_m[corner, 2] < 9e-4
    # of a footprint, it stays
    assert with_exact_faces(bent) is bent


@pytest.mark.parametrize("bent_m", [1e10, 1e250])
def test_planes_stay_where_their_changes_are_no_solution(bent_m: float) -> None:
    mesh = hip()
    bent = mesh.vertex_m + np.random.default_rng(0).uniform(-bent_m, bent_m, mesh.vertex_m.shape) * [0, 0, 1]
    moved, apart_m = with_meeting_planes(mesh.moved(bent), np.arange(len(bent)))
    assert (moved.vertex_m == bent).all() and apart_m.max() > 1e-4


@pytest.mark.parametrize(("num", "num_links"), [(1, 0), (2, 1), (30, 25), (150, 400), (301, 300)])
def test_changes_are_those_of_a_dense_solver(num: int, num_links: int) -> None:
    """Of the last ones, the first plane meets all others."""
    draw = np.random.default_rng(num)
    link = draw.integers(num, size=(num_links, 2))
    if num_links == num - 1:
        link = np.column_stack([np.zeros(num_links, int), np.arange(1, num)])
    pair = np.concatenate([link, link[:, ::-1], np.repeat(np.arange(num), 2).reshape(-1, 2)])
    share = draw.uniform(-1, 1, (num_links, 3, 3))
    block = draw.uniform(-1, 1, (num, 3, 3))
    own = block @ block.swapaxes(1, 2) + (20 + num) * np.eye(3)
    share = np.concatenate([share, share.swapaxes(1, 2), own])
    right, matrix = draw.uniform(-1, 1, (num, 3)), np.zeros((num, 3, num, 3))
    np.add.at(matrix, (pair[:, 0], slice(None), pair[:, 1]), share)
    expected = np.linalg.solve(matrix.reshape(3 * num, 3 * num), right.ravel())
    assert _solved(pair, share, right).ravel() == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("mesh", [hip(), Mesh.empty()])
def test_planes_stay_as_they_are_to_the_bit(mesh: Mesh) -> None:
    assert with_exact_faces(mesh) is mesh


def test_walls_bent_within_become_straight() -> None:
    """The step between two roofs ends within two long walls."""
    mesh = boxes(1.0)
    mesh = mesh_of(mesh.vertex_m, mesh.triangle)
    bent = mesh.vertex_m.copy()
    bent[np.isclose(bent[:, 0], 6)] += [2e-4, 5e-4, 0]
    exact = with_exact_faces(mesh.moved(bent))
    assert furthest_m(mesh.moved(bent)) > 1e-4 and furthest_m(exact) < 1e-6
    assert np.abs(exact.vertex_m - mesh.vertex_m).max() == pytest.approx(2e-4, abs=1e-6)
    far = mesh.vertex_m + np.where(np.isclose(mesh.vertex_m[:, :1], 6), [0, 0.08, 0], 0)
    assert with_exact_faces(mesh.moved(far)).vertex_m.tolist() == far.tolist()


def test_roofs_bent_by_more_than_centimetres_stay() -> None:
    mesh = hip()
    bent = mesh.vertex_m.copy()
    bent[int(np.argmax(bent[:, 2]))] += [0, 0, 0.5]
    assert with_exact_faces(mesh.moved(bent)).vertex_m.tolist() == bent.tolist()


def test_short_edges_go_though_planes_elsewhere_do_not_meet() -> None:
    bent_m = hip().vertex_m.copy()
    bent_m[int(np.argmax(bent_m[:, 2]))] += [0, 0, 0.5]
    bent, step = hip().moved(bent_m), boxes(0.03).translated([50, 0, 0])
    exact = with_exact_faces(Mesh.joined([bent, step]))
    assert step.edge_m.min() < SHORT_EDGE_M < exact.edge_m.min()
    assert exact.vertex_m[exact.vertex_m[:, 0] < 20].tolist() == bent_m.tolist()


def test_an_edge_is_tried_with_the_planes_around_it_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside nine others, a step goes as it does alone, and no more is looked at."""
    sizes, attempt = list[int](), planar._without_edge

    def counted(mesh: Mesh, is_near: np.ndarray, *more: Any) -> Mesh | None:
        sizes.append(int(is_near.sum()))
        return attempt(mesh, is_near, *more)

    monkeypatch.setattr(planar, "_without_edge", counted)
    step = boxes(0.02)
    alone = with_exact_faces(step)
    size = max(sizes)
    together = with_exact_faces(Mesh.joined([step.translated([20.0 * k, 0, 0]) for k in range(10)]))
    assert max(sizes) == size
    assert len(together.triangle) == 10 * len(alone.triangle) < 10 * len(step.triangle)
    first = together.vertex_m[together.vertex_m[:, 0] < 15]
    np.testing.assert_array_equal(first[np.lexsort(first.T)], alone.vertex_m[np.lexsort(alone.vertex_m.T)])


def test_a_part_of_a_mesh_is_as_closed_as_before_if_it_fits_into_the_rest() -> None:
    part = hip().part(slice(1, None))
    is_within = ~np.isin(np.arange(len(part.vertex_m)), hip().triangle[0])
    step_m = np.full((len(part.vertex_m), 3), 1e-9)
    assert planar._changes(part.moved(part.vertex_m + step_m * is_within[:, None]), part)[0]
    # its border moves, another triangle is not there, or is there twice
    assert not planar._changes(part.moved(part.vertex_m + step_m * ~is_within[:, None]), part)[0]
    few, twice = (
        replace(part, **changed) for changed in (rows(part, slice(1, None)), rows(part, [*range(15), 14]))
    )
    assert not planar._changes(few, part)[0]
    assert not planar._changes(twice, part)[0]


def rows(mesh: Mesh, of: Any) -> dict[str, np.ndarray]:
    return {name: getattr(mesh, name)[of] for name in ("triangle", "kind", "label")}


def test_a_corner_of_the_footprint_beside_the_line_of_its_wall_keeps_no_short_edge() -> None:
    """Three millimetres, as outlines are rounded, between two pieces of one wall. The low step there goes."""
    corner = [6, 3e-3]
    rings = [[[0, 0], corner, [6, 8], [0, 8]], [corner, [12, 0], [12, 8], [6, 8]]]
    halves = zip(rings, (5.0, 5.04), strict=True)
    mesh = union([FittedRoof([np.array(ring, float)], np.full(4, 90.0), z, 0.0) for ring, z in halves])
    is_front = mesh.planes.normal[mesh.number, 1] < -0.9
    assert len(np.unique(mesh.label[is_front])) == 2
    mesh = replace(mesh, label=np.where(is_front, mesh.label[is_front][0], mesh.label))
    exact = with_exact_faces(mesh)
    assert mesh.edge_m.min() < 0.05 < exact.edge_m.min() and exact.is_closed
    floor_m = exact.vertex_m[exact.vertex_m[:, 2] == 0, :2].tolist()
    assert corner in floor_m


@pytest.mark.parametrize(("step_m", "stays"), [(0.02, False), (0.04, False), (0.08, True)])
def test_a_low_step_between_level_roofs_goes_and_they_stay_level(step_m: float, stays: bool) -> None:
    mesh = boxes(step_m)
    exact = with_exact_faces(mesh)
    assert exact.is_closed and exact.volume_m3 == pytest.approx(mesh.volume_m3, rel=1e-3)
    assert (exact.edge_m.min() > SHORT_EDGE_M) and furthest_m(exact) < 1e-5
    roof_z_m = exact.corner_m[exact.kind == FaceKind.FLAT, :, 2]
    assert len(set(np.round(roof_z_m, 3).ravel())) == (2 if stays else 1)
    wall = exact.doubled_m2[exact.kind == FaceKind.WALL]
    assert np.abs(wall[:, 2]).max() == 0.0


@pytest.mark.parametrize("step_m", [-0.15, 0.1, 0.15])
def test_high_roofs_in_opposite_corners_stay_apart(step_m: float) -> None:
    """Quarters of a square, high and low in turn: without the short edge in the middle, four walls would share an
    upright edge."""
    square = np.array([[-5.0, -5.0], [5.0, -5.0], [5.0, 5.0], [-5.0, 5.0]])
    across, up = np.array([0.0, 1.0]), np.array([1.0, 0.0])
    cells = arrange([square], [Line(across, 0.0), Line(up, 0.0, 0, 9), Line(up, step_m, -9, 0)])
    x, y = cells.middle_m.T
    plane = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 6.0]])
    mesh = solid_below(cells, np.where(y < 0, x < step_m, x > 0).astype(int), plane, square)
    assert mesh is not None and mesh.is_closed
    assert with_exact_faces(mesh, 0.2).is_closed


def test_a_ridge_of_little_slope_slides_along_its_roofs_for_a_low_step() -> None:
    """Its ends move by 13 cm in plan, but neither roof by more than 1 cm."""
    cells = arrange([RING], [Line(np.array([0.0, 1.0]), 4.0), Line(np.array([1.0, 0.0]), 6.0)])
    x, y = cells.middle_m.T
    plane = np.array([[0, 0.02, 4.92], [0, -0.02, 5.08], [0, 0.07, 4.95]])
    mesh = solid_below(cells, np.where(x > 6, 2, y > 4), plane, RING)
    exact = with_exact_faces(mesh)
    assert mesh.edge_m.min() == pytest.approx(0.03) and exact.edge_m.min() > 0.5
    assert exact.is_closed and furthest_m(exact) < 1e-6
    assert exact.vertex_m[:, 2].sum() == pytest.approx(
        np.unique(mesh.vertex_m, axis=0)[:, 2].sum() - 4.935, abs=0.02
    )
    assert np.ptp(exact.vertex_m[np.abs(exact.vertex_m[:, 1] - 4) < 1, 1]) > 0.1


def test_an_edge_that_could_not_go_is_tried_again_after_others_went(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first attempt at one of the steps between two houses fails."""
    attempt, refused = planar._without_edge, list[Mesh]()

    def refuses_once(mesh: Mesh, *more: Any) -> Mesh | None:
        if not refused:
            refused.append(mesh)
            return None
        return attempt(mesh, *more)

    mesh = gables(5.0, 5.08)
    expected = with_exact_faces(mesh, 0.2)
    monkeypatch.setattr(planar, "_without_edge", refuses_once)
    exact = with_exact_faces(mesh, 0.2)
    assert refused and mesh.edge_m.min() < 0.1 and exact.edge_m.min() > 2
    assert len(exact.triangle) == len(expected.triangle)


def test_a_notch_of_the_footprint_stays() -> None:
    """An edge of 3 cm between two walls: moving an end would turn a wall."""
    ring = np.array([[0, 0], [12, 0], [12, 4], [12.03, 4], [12.03, 8], [0, 8]])
    meshes = skeleton.build(Polygons.from_rings([[ring]]), np.full(6, 90.0), np.array([5.0]))
    mesh = Mesh.of_kernel(meshes, 0)
    exact = with_exact_faces(mesh)
    assert exact.vertex_m.tolist() == mesh.vertex_m.tolist() and exact.edge_m.min() == pytest.approx(0.03)


def test_faces_with_slivers_are_divided_anew() -> None:
    """A corner of a level roof 15 cm beside the line between its neighbours, cut off by a triangle."""
    ring = np.array([[0, 0], [12, 0], [12, 8], [6, 8.15], [0, 8]])
    meshes = skeleton.build(Polygons.from_rings([[ring]]), np.full(5, 90.0), np.array([5.0]))
    mesh = Mesh.of_kernel(meshes, 0)
    (top,) = (surface for surface in mesh.surfaces if surface.kind == FaceKind.FLAT)
    corners = np.asarray(top.rings[0])
    corners = np.roll(corners, -int(mesh.vertex_m[corners, 0].argmin()))
    if mesh.vertex_m[corners[0], 1] < 8:
        corners = np.roll(corners, 1)
    triangle = mesh.triangle.copy()
    triangle[mesh.face == top.face] = [[corners[0], corners[k], corners[k + 1]] for k in (1, 2, 3)]
    cut = Mesh(mesh.vertex_m, triangle, mesh.kind, mesh.label)
    exact = with_exact_faces(cut)
    assert cut.is_closed and cut.area_m2.min() < 1 < exact.area_m2.min() and exact.is_closed
    assert exact.vertex_m.tolist() == mesh.vertex_m.tolist()
    assert exact.volume_m3 == pytest.approx(mesh.volume_m3) and len(exact.triangle) == len(triangle)
    assert np.bincount(exact.kind, exact.area_m2) == pytest.approx(np.bincount(mesh.kind, mesh.area_m2))


def gables(first_m: float, second_m: float) -> Mesh:
    """Two houses of one pitch side by side, with eaves at these heights."""
    boxes = [RING * [0.5, 1], RING * [0.5, 1] + [6, 0]]
    angle_deg = np.array([40.0, 90.0, 40.0, 90.0])
    return union(
        [FittedRoof([xy], angle_deg, z, 0.0) for xy, z in zip(boxes, (first_m, second_m), strict=True)]
    )


def test_slopes_that_are_a_little_apart_meet_in_the_middle() -> None:
    mesh = gables(5.0, 5.08)
    exact = with_exact_faces(mesh, 0.2)
    assert len(exact.triangle) < len(mesh.triangle) and exact.is_closed and furthest_m(exact) < 1e-6
    assert exact.edge_m.min() > 2 and exact.volume_m3 == pytest.approx(mesh.volume_m3, rel=1e-3)
    eaves_m = exact.vertex_m[np.isin(exact.vertex_m[:, 1], (0, 8)) & (exact.vertex_m[:, 2] > 1)]
    assert len(eaves_m) == 6 and eaves_m[:, 2] == pytest.approx(5 + eaves_m[:, 0] / 12 * 0.08, abs=1e-3)
    assert with_exact_faces(gables(5.0, 5.3), 0.2).edge_m.min() > 0.29


def test_a_wall_between_roofs_moves_to_the_corner_beside_it_and_the_footprint_stays() -> None:
    west = np.array([[0, 0], [6, 0], [6, 8], [0, 8.0]])
    east = np.array([[6, 0], [10, 0], [10, 5], [6.1, 5], [6.1, 8], [6, 8.0]])
    levels = ((west, 6.0), (east, 4.0))
    mesh = union([FittedRoof([xy], np.full(len(xy), 90.0), z, 0.0) for xy, z in levels])
    exact = with_exact_faces(mesh, 0.2)
    assert len(exact.triangle) < len(mesh.triangle) and exact.is_closed and furthest_m(exact) < 1e-6
    floor = [
        sorted(map(tuple, each.vertex_m[each.vertex_m[:, 2] < 0.1, :2].round(9).tolist()))
        for each in (mesh, exact)
    ]
    assert floor[0] == floor[1]
    inner = (exact.vertex_m[:, 1] < 4) & (np.abs(exact.vertex_m[:, 0] - 5) < 4)
    assert exact.vertex_m[inner, 0] == pytest.approx(6.1, abs=1e-6)


def test_a_wall_between_two_corners_turns_and_stays_upright() -> None:
    """It may not shift, as it would leave the corner where it is."""
    ring = np.array([[0, 0], [6, 0], [7, -3], [12, -3], [12, 8], [6.01, 8], [5, 11], [0, 11.0]])
    step = Line(np.array([1.0, 0.0]), 6.0)
    plane = np.array([[0, 0, 5.0], [0, 0, 8.0]])
    cells = arrange([ring], [step])
    mesh = solid_below(cells, (cells.middle_m[:, 0] > 6).astype(int), plane, ring)
    exact = with_exact_faces(mesh)
    assert mesh.edge_m.min() < 0.04 and exact.edge_m.min() > 2.5
    assert exact.is_closed and furthest_m(exact) < 1e-6
    assert np.abs(exact.planes.normal[exact.planes.is_wall, 2]).max() < 1e-9
    walls = exact.doubled_m2[exact.kind == FaceKind.WALL]
    assert np.abs(walls[:, 2]).max() < 1e-6 * np.abs(walls).max()


def test_a_step_beside_a_ridge_goes_with_its_walls() -> None:
    mesh = bent_ridge(RING)
    exact = with_exact_faces(mesh)
    assert mesh.is_closed and exact.is_closed and furthest_m(exact) < 1e-6
    assert exact.edge_m.min() > 3 and exact.volume_m3 == pytest.approx(mesh.volume_m3, rel=1e-3)
    at_ridge = exact.vertex_m[:, 2] > 6
    assert np.ptp(exact.vertex_m[at_ridge], axis=0)[[0, 2]] == pytest.approx([0, 0], abs=0.04)


@pytest.mark.parametrize("kind", [FaceKind.ROOF, FaceKind.WALL])
def test_a_plane_without_area_is_no_reason_to_fail(kind: FaceKind) -> None:
    """Beside a ridge there is a triangle without area, 5 cm of whose side are a short edge."""
    house = gables(5.0, 5.0)
    vertex_m, is_top = house.vertex_m, house.vertex_m[:, 2] > 6
    at_ridge = is_top[house.triangle].sum(axis=1) == 2
    row = int(np.flatnonzero(at_ridge & (house.kind == FaceKind.ROOF))[0])
    corners = house.triangle[row].tolist()
    turn = next(k for k in range(3) if not is_top[corners[k]])
    foot, start, end = corners[turn:] + corners[:turn]
    between = len(vertex_m)
    along_m = vertex_m[end] - vertex_m[start]
    rows = [[foot, start, between], [foot, between, end], [start, end, between]]
    mesh = Mesh(
        np.vstack([vertex_m, vertex_m[start] + 0.05 * along_m / np.linalg.norm(along_m)]),
        np.vstack([np.delete(house.triangle, row, axis=0), rows]).astype(np.int32),
        np.append(np.delete(house.kind, row), [FaceKind.ROOF, FaceKind.ROOF, kind]).astype(np.uint8),
        np.append(np.delete(house.label, row), [*2 * [house.label[row]], 99]).astype(np.int32),
    )
    assert mesh.is_closed and mesh.planes.area_m2.min() == 0 and np.isfinite(mesh.planes.normal).all()
    exact = with_exact_faces(mesh, 0.2)
    assert exact.is_closed and np.isfinite(exact.vertex_m).all()
    assert exact.volume_m3 == pytest.approx(mesh.volume_m3, rel=0.01)


def test_a_face_without_area_has_no_triangles() -> None:
    point_m = np.array([[0.0, 0.0, 5.0], [4.0, 0.0, 5.0], [4.0, 3.0, 5.0], [2.0, 0.0, 5.0]])
    triangle, face = triangulated_in_space(
        point_m, [[[0, 3, 1]], [[0, 1, 2]]], np.array([[0, 0, 0.0], [0, 0, 1]])
    )
    assert face.tolist() == [1] and sorted(triangle[0].tolist()) == [0, 1, 2]


def test_a_thin_wall_across_a_roof_leaves_the_mesh_closed() -> None:
    """Its two faces are in one place once its short edges are gone."""
    across = np.array([1.0, 0.0])
    cells = arrange([RING], [Line(across, 6.0), Line(across, 6.15)])
    plane = np.array([[0.1, 0, 3], [0, 0, 20], [-0.1, 0, 3.8]])
    x = cells.middle_m[:, 0]
    mesh = solid_below(cells, (x > 6).astype(int) + (x > 6.15), plane, RING)
    assert mesh is not None and with_exact_faces(mesh, 0.2).is_closed


def test_a_triangle_without_area_gives_its_corner_to_the_face_across() -> None:
    """The roof on one side of a ridge has a vertex within it that the roof on the other side has not."""
    mesh = hip()
    at_ridge = (mesh.vertex_m[mesh.triangle, 2] > 5.1).sum(axis=1) == 2
    t = int(at_ridge.argmax())
    start, end, apex = np.roll(mesh.triangle[t], -int(mesh.edge_m[t].argmin()))
    middle = len(mesh.vertex_m)
    triangle = np.vstack([mesh.triangle, [[start, middle, apex], [middle, end, apex]]])
    triangle[t] = start, end, middle
    like = np.append(np.arange(len(mesh.triangle)), [t, t])
    vertex_m = np.vstack([mesh.vertex_m, mesh.vertex_m[[start, end]].mean(axis=0)])
    exact = with_exact_faces(Mesh(vertex_m, triangle.astype(np.int32), mesh.kind[like], mesh.label[like]))
    assert at_ridge.sum() == 2 and exact.is_closed
    assert exact.area_m2.min() > 1.0 and len(exact.triangle) == len(mesh.triangle) + 2
