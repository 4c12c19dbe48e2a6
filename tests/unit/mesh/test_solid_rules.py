"""The rules of solids: each broken one is found, and found by the independent tests too; repairs mend what they can."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
import solid_rules

from p2wss import skeleton
from p2wss.mesh import Mesh
from p2wss.mesh.faces import Surface
from p2wss.mesh.planar import with_exact_faces
from p2wss.mesh.repair import SCALE_M, stored, surfaces_to_write
from p2wss.mesh.rules import MEANINGS, VAL3DITY, Breach, breaches
from p2wss.skeleton.types import FaceKind, Polygons

Shell = list[list[list[int]]]
# the corners of a box, below then above, and its faces seen from outside
BOX = [(x, y, z) for z in (0, 4) for x, y in ((0, 0), (6, 0), (6, 5), (0, 5))]
FACES: Shell = [
    [[0, 3, 2, 1]],
    [[4, 5, 6, 7]],
    [[0, 1, 5, 4]],
    [[1, 2, 6, 5]],
    [[2, 3, 7, 6]],
    [[3, 0, 4, 7]],
]


def check(vertex: list[tuple[float, ...]], shell: Shell) -> set[int]:
    """The codes that our rules give, which must be those of the independent tests."""
    grid = np.round(np.array(vertex, float) / SCALE_M).astype(np.int64)
    surfaces = [Surface(FaceKind.WALL, -1, [np.array(ring) for ring in rings]) for rings in shell]
    ours = {breach.code for breach in breaches(grid * SCALE_M, surfaces, VAL3DITY)}
    theirs = set(solid_rules.codes([tuple(map(int, place)) for place in grid], shell, SCALE_M))
    assert ours == theirs
    assert ours <= set(MEANINGS)
    return ours


def with_notch(*notch: tuple[float, float]) -> tuple[list[tuple[float, ...]], Shell]:
    """The box with more vertices in its front side, below and above."""
    vertex: list[tuple[float, ...]] = [*BOX]
    below = [len(vertex) + 2 * i for i in range(len(notch))]
    for x, y in notch:
        vertex += [(x, y, 0), (x, y, 4)]
    above = [b + 1 for b in below]
    path, top = [0, *below, 1], [4, *above, 5]
    walls = [[[path[i], path[i + 1], top[i + 1], top[i]]] for i in range(len(path) - 1)]
    shell = [[[0, 3, 2, 1, *below[::-1]]], [[4, *above, 5, 6, 7]], *walls, *FACES[3:]]
    return vertex, shell


def test_a_box_breaks_no_rule() -> None:
    assert check(BOX, FACES) == set()


def test_a_notch_breaks_no_rule() -> None:
    assert check(*with_notch((2, 0), (3, 1), (4, 0))) == set()


def test_101_a_ring_of_two_vertices() -> None:
    assert check(BOX, [*FACES, [[0, 1]]]) == {101}


@pytest.mark.parametrize(("gap_m", "expected"), [(0.0008, {102}), (0.0012, set())])
def test_102_vertices_nearer_than_a_millimetre(gap_m: float, expected: set[int]) -> None:
    assert check(*with_notch((2, 0), (2 + gap_m, 0), (3, 0.5))) == expected


def test_104_a_ring_that_crosses_itself() -> None:
    assert 104 in check(*with_notch((4, 1), (4, -1), (1, 1)))


def test_104_a_ring_that_visits_a_vertex_twice() -> None:
    top = [[4, 5, 6, 7, 4, 8, 9]]
    assert 104 in check([*BOX, (2, 1, 4), (1, 2, 4)], [*FACES[:1], top, *FACES[2:]])


@pytest.mark.parametrize(
    ("hole", "code"),
    [
        ([(2, 2), (4, 2), (4, 3)], 208),
        ([(2, 2), (7, 3), (4, 2)], 201),
        ([(7, 2), (8, 3), (8, 2)], 206),
    ],
)
def test_20x_holes_of_a_face(hole: list[tuple[float, float]], code: int) -> None:
    vertex = [*BOX, *((x, y, 4) for x, y in hole)]
    assert check(vertex, [FACES[0], [FACES[1][0], [8, 9, 10]], *FACES[2:]]) == {code}


def test_207_holes_in_each_other() -> None:
    holes = [[(1, 1), (1, 4), (5, 4), (5, 1)], [(2, 2), (2, 3), (4, 3), (4, 2)]]
    vertex = [*BOX, *((x, y, 4) for hole in holes for x, y in hole)]
    top = [FACES[1][0], [8, 9, 10, 11], [12, 13, 14, 15]]
    assert check(vertex, [FACES[0], top, *FACES[2:]]) == {207}


def test_205_a_hole_that_divides_a_face() -> None:
    assert check([*BOX, (3, 2, 4)], [FACES[0], [FACES[1][0], [4, 6, 8]], *FACES[2:]]) == {205}


def test_holes_that_touch_the_outside_in_the_same_vertex_divide_nothing() -> None:
    holes = [(1, 0.5), (1, 1), (0.5, 1), (2, 0.5), (2, 0.7)]
    vertex = [*BOX, *((x, y, 4) for x, y in holes)]
    top = [FACES[1][0], [4, 9, 8], [4, 12, 11]]
    # both holes are open, but touch nothing else
    assert check(vertex, [FACES[0], top, *FACES[2:]]) == {302}


def test_the_folds_of_a_large_face_take_memory_by_its_triangles() -> None:
    """Of 5,000, all angles between two of them are 200 MB."""
    turn = np.linspace(0, 2 * np.pi, 5000, endpoint=False)
    vertex_m = 100 * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    tracemalloc.start()
    assert breaches(vertex_m, [Surface(0, 0, [np.arange(5000)])]) == [Breach(301)]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6


@pytest.mark.parametrize(("lift_m", "expected"), [(0.05, {203}), (0.03, set())])
def test_203_a_vertex_off_the_plane(lift_m: float, expected: set[int]) -> None:
    vertex = [*BOX[:6], (6, 5, 4 + lift_m), BOX[7]]
    assert check(vertex, FACES) == expected


def test_204_a_fold_within_the_tolerance_of_the_plane() -> None:
    # a step of 9 mm across 10 mm of the top
    vertex, shell = with_notch((3, 0), (3.01, 0))
    back = len(vertex)
    vertex += [(3.01, 5, 0), (3.01, 5, 4), (3, 5, 0), (3, 5, 4)]
    vertex = [(x, y, z + 0.009 if z == 4 and x > 3.005 else z) for x, y, z in vertex]
    below, above = [back, back + 2], [back + 1, back + 3]
    shell[0] = [[0, 3, below[1], below[0], 2, 1, 10, 8]]
    shell[1] = [[4, 9, 11, 5, 6, above[0], above[1], 7]]
    walls = [[2, below[0], above[0], 6], [below[0], below[1], above[1], above[0]], [below[1], 3, 7, above[1]]]
    shell = [*shell[:5], shell[5], *([wall] for wall in walls), shell[7]]
    assert check(vertex, shell) == {204}


def test_301_and_302_open_shells() -> None:
    assert check(BOX, FACES[:3]) == {301}
    assert check(BOX, FACES[:5]) == {302}


def test_303_an_edge_of_four_faces() -> None:
    other = [(x + 6, y + 5, z) for x, y, z in BOX]
    place = {2: 0, 6: 4}
    number = {v: next((a for a, b in place.items() if b == v), v + 8) for v in range(8)}
    shell = FACES + [[[number[v] for v in ring] for ring in rings] for rings in FACES]
    assert check([*BOX, *other], shell) == {303}


def test_303_a_vertex_of_two_fans() -> None:
    other = [(x + 6, y + 5, z + 4) for x, y, z in BOX]
    number = {v: 6 if v == 0 else v + 8 for v in range(8)}
    shell = FACES + [[[number[v] for v in ring] for ring in rings] for rings in FACES]
    assert check([*BOX, *other], shell) == {303}


def test_305_two_boxes() -> None:
    shell = FACES + [[[v + 8 for v in ring] for ring in rings] for rings in FACES]
    assert check([*BOX, *((x + 9, y, z) for x, y, z in BOX)], shell) == {305}


def test_306_a_spike_through_the_opposite_wall() -> None:
    # the notch goes through the back of the box above its floor: only walls cross
    vertex, shell = with_notch((2, 0), (3, 6), (4, 0))
    assert check(vertex, shell) == {104}
    apex = len(BOX)
    roof: Shell = [[[4, 5, apex]], [[5, 6, apex]], [[6, 7, apex]], [[7, 4, apex]]]
    assert check([*BOX, (3, 2, 6)], [FACES[0], *roof, *FACES[2:]]) == set()
    assert check([*BOX, (3, 2, -1)], [FACES[0], *roof, *FACES[2:]]) == {306}
    assert check([*BOX, (3, 2, 0)], [FACES[0], *roof, *FACES[2:]]) == {306}


def test_307_a_face_turned_round() -> None:
    assert check(BOX, [*FACES[:5], [FACES[5][0][::-1]]]) == {307}


def test_405_a_box_inside_out() -> None:
    assert check(BOX, [[rings[0][::-1]] for rings in FACES]) == {405}


def roofs() -> list[Mesh]:
    rings = [[np.array([[0, 0], [16, 0], [16, 6], [7, 6], [7, 13], [0, 13.0]])]] * 4
    angle = np.array([[30, 90, 30, 30, 90, 30], [0.0] * 6, [45] * 6, [20, 60, 35, 25, 5, 85]])
    meshes = skeleton.build(Polygons.from_rings(rings), angle.ravel(), np.full(4, 5.0))
    assert not meshes.status.any()
    return [Mesh.of_kernel(meshes, i) for i in range(4)]


def independent_codes(mesh: Mesh) -> list[int]:
    grid, surfaces = stored(mesh.vertex_m, surfaces_to_write(mesh)[0])
    shell = [[[int(v) for v in ring] for ring in surface.rings] for surface in surfaces]
    return solid_rules.codes([tuple(map(int, place)) for place in grid], shell, SCALE_M)


def test_roofs_of_the_kernel_are_left_alone() -> None:
    for mesh in roofs():
        assert not surfaces_to_write(mesh)[1] and independent_codes(mesh) == []


def with_split_edge(mesh: Mesh, share: float, move: Callable[[np.ndarray], np.ndarray]) -> Mesh:
    """The mesh with a further vertex on the edge from corner 0 to corner 1 of its first triangle."""
    a, b, c = map(int, mesh.triangle[0])
    new = len(mesh.vertex_m)
    beside = next(t for t in range(1, len(mesh.triangle)) if {a, b} <= set(mesh.triangle[t].tolist()))
    (d,) = set(mesh.triangle[beside].tolist()) - {a, b}
    place = move(mesh.vertex_m[a] + share * (mesh.vertex_m[b] - mesh.vertex_m[a]))
    triangle = np.delete(mesh.triangle, [0, beside], axis=0)
    triangle = np.vstack([triangle, [[a, new, c], [new, b, c], [b, new, d], [new, a, d]]])
    labels = [0, 0, beside, beside]
    return Mesh(
        np.vstack([mesh.vertex_m, place]),
        triangle.astype(np.int32),
        np.r_[np.delete(mesh.kind, [0, beside]), mesh.kind[labels]],
        np.r_[np.delete(mesh.label, [0, beside]), mesh.label[labels]],
    )


def test_vertices_within_a_millimetre_are_merged() -> None:
    for mesh in roofs():
        length_m = float(np.linalg.norm(np.subtract(*mesh.vertex_m[mesh.triangle[0, :2]])))
        near = with_split_edge(mesh, 5e-4 / length_m, lambda place: place)
        assert surfaces_to_write(near)[1]
        better = with_exact_faces(near)
        assert independent_codes(better) == []
        assert len(better.triangle) == len(mesh.triangle)


def test_a_face_that_is_not_planar_becomes_triangles() -> None:
    for mesh in roofs():
        bent = with_split_edge(mesh, 0.5, lambda place: place + 0.02)
        whole = bent.surfaces
        surfaces, found = surfaces_to_write(bent)
        assert not found and independent_codes(bent) == []
        assert len(surfaces) > len(whole) and len({s.face for s in surfaces}) == len(whole)


@pytest.mark.parametrize(("off_m", "num_faces"), [(0.0, 6), (0.0002, 6), (0.001, 7)])
def test_a_face_that_is_off_by_more_than_rounding_is_written_as_triangles(
    off_m: float, num_faces: int
) -> None:
    """A corner that is off by so much is off the plane of least squares by a quarter of that."""
    meshes = skeleton.build(
        Polygons.from_rings([[np.array(BOX[:4], float)[:, :2]]]), np.zeros(4), np.array([4.0])
    )
    box = Mesh.of_kernel(meshes, 0)
    vertex_m = box.vertex_m.copy()
    vertex_m[vertex_m[:, 2].argmax(), 2] += off_m
    surfaces, broken = surfaces_to_write(box.moved(vertex_m))
    assert len(surfaces) == num_faces and not broken


def test_a_solid_inside_out_breaks_the_rule_of_the_shell() -> None:
    mesh = roofs()[1]
    turned = mesh.moved(mesh.vertex_m * [1, 1, -1])
    assert {breach.code for breach in surfaces_to_write(turned)[1]} == {405}


def test_a_hole_that_touches_the_outside_is_a_ring_of_its_own() -> None:
    """A box stands on a flat roof, one corner of it on the roof's edge."""
    low = [(0, 0), (6, 0), (6, 5), (0, 5)]
    box = [(3, 0), (4, 1), (3, 2), (2, 1)]
    xyz = [(x, y, 0) for x, y in [*low, (3, 0)]] + [(x, y, 4) for x, y in [*low, *box]]
    xyz += [(x, y, 5) for x, y in box]
    # 0-3 ground, 4 ground below the touching corner, 5-8 eaves, 9-12 foot of the box, 13-16 its top
    faces: list[tuple[int, int, list[tuple[int, int, int]]]] = [
        (FaceKind.GROUND, 0, [(0, 3, 4), (3, 2, 4), (2, 1, 4)]),
        (FaceKind.WALL, 1, [(0, 4, 9), (0, 9, 5)]),
        (FaceKind.WALL, 2, [(4, 1, 6), (4, 6, 9)]),
        (FaceKind.WALL, 3, [(1, 2, 7), (1, 7, 6)]),
        (FaceKind.WALL, 4, [(2, 3, 8), (2, 8, 7)]),
        (FaceKind.WALL, 5, [(3, 0, 5), (3, 5, 8)]),
        (FaceKind.FLAT, 6, [(5, 9, 12), (5, 12, 8), (12, 11, 8), (11, 7, 8), (11, 10, 7), (10, 6, 7), (9, 6, 10)]),
        (FaceKind.FLAT, 7, [(13, 14, 15), (13, 15, 16)]),
        *(
            (FaceKind.WALL, 8 + k, [(9 + k, 9 + (k + 1) % 4, 13 + (k + 1) % 4), (9 + k, 13 + (k + 1) % 4, 13 + k)])
            for k in range(4)
        ),
    ]  # fmt: skip
    mesh = Mesh(
        np.array(xyz, float),
        np.array([t for _, _, triangles in faces for t in triangles], np.int32),
        np.array([kind for kind, _, triangles in faces for _ in triangles]),
        np.array([edge for _, edge, triangles in faces for _ in triangles]),
    )
    roof = next(s for s in mesh.surfaces if s.label == 6)
    assert [sorted(ring.tolist()) for ring in roof.rings] == [[5, 6, 7, 8, 9], [9, 10, 11, 12]]
    assert not surfaces_to_write(mesh)[1] and independent_codes(mesh) == []
