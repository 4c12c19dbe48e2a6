"""Metrics against brute force, trimesh and analytic values."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from scipy.stats import kstest

from p2wss.metrics.absolute_error import absolute_error, vertex_error
from p2wss.metrics.chamfer import chamfer_distance_m
from p2wss.metrics.mesh_facts import mesh_facts
from p2wss.metrics.summary import summarize
from p2wss.metrics.surface import distance_to_mesh, sample_surface, triangle_areas

BOX = trimesh.creation.box((4, 3, 2))


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_chamfer_is_half_the_sum_of_both_means(n: int, m: int, seed: int) -> None:
    draw = np.random.default_rng(seed)
    a, b = draw.normal(size=(n, 3)), draw.normal(size=(m, 3))
    distance = cdist(a, b)
    expected = (distance.min(axis=1).mean() + distance.min(axis=0).mean()) / 2
    assert chamfer_distance_m(a, b) == pytest.approx(expected)


def test_chamfer_of_nothing_is_unknown() -> None:
    assert np.isnan(chamfer_distance_m(np.zeros((0, 3)), np.zeros((1, 3))))


@pytest.mark.parametrize("seed", range(5))
def test_distance_to_mesh_is_that_of_dense_samples(seed: int) -> None:
    draw = np.random.default_rng(seed)
    vertex, triangle = draw.normal(size=(9, 3)) * 3, draw.integers(0, 9, (6, 3))
    triangle = triangle[[len(set(t)) == 3 for t in triangle.tolist()]]
    point = draw.normal(size=(40, 3)) * 4
    # every triangle on its own fine grid: no sampling of this package
    step = np.linspace(0, 1, 150)
    u, v = (g.ravel()[:, None] for g in np.meshgrid(step, step))
    inside = (u + v <= 1).ravel()
    dense = np.concatenate([a + u[inside] * (b - a) + v[inside] * (c - a) for a, b, c in vertex[triangle]])
    oracle = np.array([np.linalg.norm(dense - p, axis=1).min() for p in point])
    exact = distance_to_mesh(point, vertex, triangle)
    assert np.all(exact <= oracle + 1e-9)
    assert np.allclose(exact, oracle, atol=0.05)


def test_distance_to_degenerate_triangle_and_to_nothing() -> None:
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
    assert triangle_areas(BOX.vertices, BOX.faces) == pytest.approx(BOX.area_faces)
    flat = np.zeros((3, 3))
    assert sample_surface(flat, np.array([[0, 1, 2]]), 10, np.random.default_rng(0)).shape == (0, 3)


def test_mesh_facts_of_a_box_its_inside_out_and_a_box_with_a_hole() -> None:
    facts = mesh_facts(BOX.vertices, BOX.faces)
    assert (facts.num_triangles, facts.watertight, facts.oriented, facts.num_bodies) == (12, True, True, 1)
    assert facts.volume_m3 == pytest.approx(24)
    assert mesh_facts(BOX.vertices, BOX.faces[:, ::-1]).volume_m3 == pytest.approx(-24)
    assert not mesh_facts(BOX.vertices, BOX.faces[1:]).watertight
    one_turned = np.vstack([BOX.faces[:1, ::-1], BOX.faces[1:]])
    assert not mesh_facts(BOX.vertices, one_turned).oriented
    assert mesh_facts(np.zeros((0, 3)), np.zeros((0, 3), int)).num_triangles == 0


def test_mesh_facts_weld_vertices_that_are_listed_twice() -> None:
    soup = BOX.vertices[BOX.faces].reshape(-1, 3)
    assert mesh_facts(soup, np.arange(36).reshape(-1, 3)).watertight


def test_absolute_errors() -> None:
    error = absolute_error(np.array([1.0, np.nan, 5.0]), np.array([2.0, 7.0, 2.0]))
    assert (error.mean, error.std, error.count) == (2, 1, 2)
    assert vertex_error(np.array([[0.0, 0], [1, 1]]), np.array([[3.0, 4], [1, 1]])).mean == 2.5
    assert np.isnan(absolute_error(np.zeros(0), np.zeros(0)).mean)
    with pytest.raises(ValueError, match="predicted"):
        absolute_error(np.zeros(2), np.zeros(3))


def test_summary_is_that_of_numpy_and_its_interval_covers() -> None:
    draw = np.random.default_rng(1)
    sample = draw.exponential(2.0, 200)
    summary = summarize(np.append(sample, np.nan), np.random.default_rng(2), 400)
    assert summary.count == 200
    assert (summary.q1, summary.median, summary.q3) == tuple(np.percentile(sample, [25, 50, 75]))
    assert summary.std == pytest.approx(sample.std())
    # the bootstrap's width is near that of the normal approximation
    width = 2 * 1.96 * sample.std() / np.sqrt(200)
    assert summary.low < summary.mean < summary.high
    assert summary.high - summary.low == pytest.approx(width, rel=0.25)
    assert summarize(np.array([np.nan]), draw).count == 0
