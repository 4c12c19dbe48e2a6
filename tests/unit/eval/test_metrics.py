"""Metrics against brute force, trimesh and analytic values."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from scipy.stats import kstest

from p2wss.eval.metrics import chamfer_distance_m, height_rmse_m, mesh_facts, out_of_plane_m
from p2wss.mesh.surface import distance_to_mesh, sample_surface, topmost
from p2wss.mesh.topology import face_numbers, twins

BOX = trimesh.creation.box((4, 3, 2))


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_chamfer_is_half_the_sum_of_both_means(n: int, m: int, seed: int) -> None:
    draw = np.random.default_rng(seed)
    a, b = draw.normal(size=(n, 3)), draw.normal(size=(m, 3))
    distance = cdist(a, b)
    expected = (distance.min(axis=1).mean() + distance.min(axis=0).mean()) / 2
    assert chamfer_distance_m(a, b) == pytest.approx(expected)


def test_chamfer_of_an_empty_set_is_nan() -> None:
    assert np.isnan(chamfer_distance_m(np.zeros((0, 3)), np.zeros((1, 3))))


@pytest.mark.parametrize("seed", range(5))
def test_distance_to_mesh_is_that_of_dense_samples(seed: int) -> None:
    draw = np.random.default_rng(seed)
    vertex, triangle = draw.normal(size=(9, 3)) * 3, draw.integers(0, 9, (6, 3))
    triangle = triangle[[len(set(t)) == 3 for t in triangle.tolist()]]
    point = draw.normal(size=(40, 3)) * 4
    # a fine grid on every triangle: independent of the package's sampling
    step = np.linspace(0, 1, 150)
    u, v = (g.ravel()[:, None] for g in np.meshgrid(step, step))
    inside = (u + v <= 1).ravel()
    dense = np.concatenate([a + u[inside] * (b - a) + v[inside] * (c - a) for a, b, c in vertex[triangle]])
    oracle = np.array([np.linalg.norm(dense - p, axis=1).min() for p in point])
    exact = distance_to_mesh(point, vertex, triangle)
    assert np.all(exact <= oracle + 1e-9)
    assert np.allclose(exact, oracle, atol=0.05)


def test_distance_to_a_degenerate_triangle_and_without_triangles() -> None:
    line = np.array([[0.0, 0, 0], [2, 0, 0], [1, 0, 0]])
    assert distance_to_mesh(np.array([[1.0, 3, 4]]), line, np.array([[0, 1, 2]]))[0] == pytest.approx(5)
    assert np.isinf(distance_to_mesh(np.zeros((1, 3)), np.zeros((0, 3)), np.zeros((0, 3), int)))[0]


def test_samples_are_uniform_over_the_surface() -> None:
    draw = np.random.default_rng(0)
    sample = sample_surface(BOX.vertices, BOX.faces, 6000, draw)
    assert np.abs(distance_to_mesh(sample, BOX.vertices, BOX.faces)).max() < 1e-9
    on_top = sample[sample[:, 2] > 1 - 1e-9]
    # the top is 12 of 52 square metres: binomial, 4 standard deviations
    assert abs(len(on_top) - 6000 * 12 / 52) < 4 * np.sqrt(6000 * 12 / 52 * 40 / 52)
    assert kstest(on_top[:, 0], "uniform", (-2, 4)).pvalue > 1e-3
    assert kstest(on_top[:, 1], "uniform", (-1.5, 3)).pvalue > 1e-3


def test_areas_and_samples_without_area() -> None:
    flat = np.zeros((3, 3))
    assert sample_surface(flat, np.array([[0, 1, 2]]), 10, np.random.default_rng(0)).shape == (0, 3)


def test_mesh_facts_of_a_box_with_a_hole_and_one_with_a_turned_triangle() -> None:
    assert mesh_facts(BOX.vertices, BOX.faces) == (True, True)
    assert mesh_facts(BOX.vertices, BOX.faces[1:]) == (False, False)
    one_turned = np.vstack([BOX.faces[:1, ::-1], BOX.faces[1:]])
    assert mesh_facts(BOX.vertices, one_turned) == (True, False)
    assert mesh_facts(np.zeros((0, 3)), np.zeros((0, 3), int)) == (False, False)


def test_mesh_facts_weld_vertices_that_are_listed_twice() -> None:
    soup = BOX.vertices[BOX.faces].reshape(-1, 3)
    assert mesh_facts(soup, np.arange(36).reshape(-1, 3)).watertight


def test_two_boxes_that_touch_in_a_vertex_or_an_edge_are_no_manifold() -> None:
    """The boxes that touch in a vertex are closed and oriented; only the fans at their vertices show it."""
    one = trimesh.creation.box((2, 2, 2))
    assert mesh_facts(one.vertices, one.faces).manifold
    for shift, watertight in (((2, 2, 2), True), ((2, 2, 0), False)):
        vertex = np.vstack([one.vertices, one.vertices + shift])
        facts = mesh_facts(vertex, np.vstack([one.faces, one.faces + 8]))
        assert facts.watertight is watertight and not facts.manifold
    apart = np.vstack([one.vertices, one.vertices + 5])
    assert mesh_facts(apart, np.vstack([one.faces, one.faces + 8])).manifold


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_manifold_as_walking_round_every_vertex_finds_it(seed: int) -> None:
    """Independent: the triangles at a vertex are a fan if a walk from one over shared edges meets them all."""
    draw = np.random.default_rng(seed)
    mesh = trimesh.creation.icosahedron()
    # two vertices become one: sometimes a pinch, sometimes edges of four triangles
    a, b = draw.choice(12, 2, replace=False)
    triangle = np.where(mesh.faces == b, a, mesh.faces)
    kept = [t for t in triangle.tolist() if len(set(t)) == 3]
    edges = [tuple(sorted((t[i], t[(i + 1) % 3]))) for t in kept for i in range(3)]
    fans = []
    for v in {v for t in kept for v in t}:
        pending = [set(t) for t in kept if v in t]
        reached = [pending.pop()]
        for t in reached:
            reached += [other for other in pending if len(t & other) == 2]
            pending = [other for other in pending if len(t & other) != 2]
        fans.append(not pending)
    expected = all(edges.count(edge) == 2 for edge in edges) and all(fans)
    assert mesh_facts(mesh.vertices, np.array(kept)).manifold is expected


def test_faces_are_neighbours_with_equal_labels() -> None:
    # the sides of a box have two triangles each; trimesh groups them by their planes
    label = np.round(BOX.face_normals).astype(int) @ [1, 3, 9]
    face = face_numbers(twins(BOX.faces), label)
    assert face.max() == 5
    for facet in BOX.facets:
        assert len(set(face[facet].tolist())) == 1
    apart = np.vstack([BOX.faces, BOX.faces + 8])
    assert face_numbers(twins(apart), np.zeros(24, int)).max() == 1


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.5, 0.5), st.integers(0, 2**32 - 1))
def test_a_bent_square_is_out_of_plane_by_a_quarter_of_what_one_corner_is_lifted(
    lift: float, seed: int
) -> None:
    square = np.array([[0.0, 0, 0], [4, 0, 0], [4, 4, lift], [0, 4, 0]])
    turn = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))[:3, :3]
    deviation = out_of_plane_m(square @ turn.T + 1000, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, int))
    # the best plane halves the error between the two diagonals: each corner is a quarter of the lift off it
    assert deviation[0] == pytest.approx(abs(lift) / 4, rel=0.02, abs=1e-9)


def test_height_over_a_mesh_is_that_of_a_ray_from_above() -> None:
    draw = np.random.default_rng(4)
    mesh = trimesh.util.concatenate(
        [trimesh.creation.icosphere(2, 3.0), trimesh.creation.box((2, 9, 4), np.eye(4))]
    )
    xy = draw.uniform(-4, 4, (300, 2))
    height = topmost(np.array(mesh.triangles), np.column_stack([xy, np.zeros(300)]))[1]
    start = np.column_stack([xy, np.full(300, 50.0)])
    hit, ray, _ = mesh.ray.intersects_location(start, np.tile([0.0, 0, -1], (300, 1)), multiple_hits=True)
    expected = np.full(300, -np.inf)
    for place, i in zip(hit, ray, strict=True):
        expected[i] = max(expected[i], place[2])
    assert 50 < np.isinf(expected).sum() < 250
    assert np.allclose(height, expected, atol=1e-5)
    assert np.isnan(height_rmse_m(np.full((1, 3), 9.0), np.array(mesh.triangles)))
