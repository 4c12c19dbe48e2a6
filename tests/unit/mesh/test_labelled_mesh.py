"""The mesh of a building: what follows from its triangles and labels."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from drawn_towns.planes import mesh_of

from p2wss import skeleton
from p2wss.mesh import Mesh
from p2wss.mesh.topology import border_rings, twins
from p2wss.skeleton import FaceKind, Polygons
from p2wss.skeleton.groups import groups

# a house of 10 m by 8 m with a courtyard, and gables to the left and to the right
RINGS = [
    np.array([[0, 0], [10, 0], [10, 8], [0, 8]], float),
    np.array([[4, 3], [4, 5], [6, 5], [6, 3]], float),
]


def house() -> Mesh:
    meshes = skeleton.build(Polygons.from_rings([RINGS]), np.zeros(8), np.array([5.0]))
    assert meshes.status[0] == 0
    return Mesh.of_kernel(meshes, 0)


def gable() -> Mesh:
    meshes = skeleton.build(Polygons.from_rings([RINGS[:1]]), np.array([45.0, 90, 45, 90]), np.array([5.0]))
    return Mesh.of_kernel(meshes, 0)


def test_measures_of_a_house_with_a_courtyard() -> None:
    mesh = house()
    assert mesh.is_closed and mesh.volume_m3 == pytest.approx((80 - 4) * 5)
    assert mesh.area_m2[mesh.kind == FaceKind.GROUND].sum() == pytest.approx(76)
    assert mesh.edge_m.min() == pytest.approx(2)


def test_every_half_edge_has_the_twin_that_runs_back() -> None:
    mesh = house()
    start = mesh.triangle.ravel()
    end = np.roll(mesh.triangle, -1, axis=1).ravel()
    twin = mesh.twin.ravel()
    assert (twin >= 0).all() and (twin[twin] == np.arange(len(twin))).all()
    assert (start[twin] == end).all() and (end[twin] == start).all()
    open_mesh = mesh.part(mesh.kind != FaceKind.GROUND)
    assert (open_mesh.twin < 0).sum() == 8 and not open_mesh.is_closed


def test_faces_have_their_holes_and_planes_their_areas() -> None:
    mesh = house()
    assert len(mesh.surfaces) == len(mesh.planes.normal) == 10
    assert sorted(len(surface.rings) for surface in mesh.surfaces) == [1] * 8 + [2, 2]
    floor = mesh.planes.kind == FaceKind.GROUND
    assert mesh.planes.normal[floor].tolist() == [[0, 0, -1]] and mesh.planes.area_m2[floor] == pytest.approx(
        76
    )
    assert mesh.planes.is_wall.sum() == 8 and (mesh.planes.normal[:, 2] > 0.99).sum() == 1
    assert (mesh.num_planes_at == 3).all()


def test_walls_and_roofs_over_one_edge_have_labels_of_their_own() -> None:
    mesh = gable()
    assert len(mesh.surfaces) == len(np.unique(mesh.label)) == 7
    found = mesh_of(mesh.vertex_m, mesh.triangle)
    assert np.array_equal(found.kind, mesh.kind) and len(found.surfaces) == 7


def test_moves_keep_faces_and_leave_the_first_mesh_alone() -> None:
    mesh = gable()
    before = mesh.vertex_m.copy()
    moved = mesh.translated([1, 2, 3])
    assert moved.vertex_m == pytest.approx(before + np.array([1, 2, 3]))
    assert moved.volume_m3 == pytest.approx(mesh.volume_m3) and np.array_equal(moved.face, mesh.face)
    assert np.array_equal(mesh.vertex_m, before)


def test_a_pickled_mesh_is_its_four_arrays_and_its_faces() -> None:
    mesh = gable()
    plain = pickle.dumps(mesh)
    assert mesh.is_closed and mesh.edge_m.any() and pickle.dumps(mesh) == plain
    assert mesh.surfaces and "surfaces" in vars(pickle.loads(pickle.dumps(mesh)))
    back = pickle.loads(plain)
    assert np.array_equal(back.vertex_m, mesh.vertex_m) and back.volume_m3 == mesh.volume_m3


def test_the_same_mesh_for_trimesh() -> None:
    solid = gable().to_trimesh()
    assert solid.is_volume and solid.volume == pytest.approx(gable().volume_m3)
    assert set(solid.face_attributes) == {"kind", "label"}


def test_a_mesh_inside_out_has_a_negative_volume() -> None:
    mesh = gable()
    assert replace(mesh, triangle=mesh.triangle[:, ::-1]).volume_m3 == pytest.approx(-mesh.volume_m3)


def test_borders_run_as_their_triangles_do() -> None:
    square = np.array([[0, 1, 2], [0, 2, 3], [5, 4, 6]])
    rings = border_rings(square, np.zeros(3, int), twins(square))
    assert rings == [(0, [0, 1, 2, 3]), (0, [5, 4, 6])]
    rings = border_rings(square, np.array([0, 1, 2]), twins(square))
    assert rings == [(0, [0, 1, 2]), (1, [0, 2, 3]), (2, [5, 4, 6])]


def test_groups_are_numbered_by_their_first_members() -> None:
    assert groups(5, np.array([[4, 1], [2, 3]])).tolist() == [0, 1, 2, 2, 1]
    assert groups(2, np.zeros((0, 2), int)).tolist() == [0, 1]
