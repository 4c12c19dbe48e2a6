"""Any input gives a checked mesh or a status, in bounded time; real footprints are rarely rejected."""

import multiprocessing
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from feature_tables import clean_footprints, read_footprints
from hypothesis import given, settings
from hypothesis import strategies as st
from places import SHARED
from skeleton_samples import clean, sample_angles, sample_footprints
from skeleton_solids import judged_sound

from p2wss.config import Scenes
from p2wss.data import polygon_arrays
from p2wss.skeleton import Polygons, Status, build

DATA = SHARED / "data"


def hostile_ring(rng):
    kind = rng.integers(0, 10)
    n = int(rng.integers(0, 14))
    ring = rng.normal(size=(n, 2)) * 10.0 ** rng.uniform(-3, 3)  # crosses itself
    if kind == 0 and n:
        ring[rng.integers(n)] = rng.choice([np.nan, np.inf, -np.inf, 1e300])
    elif kind == 1:
        ring = np.repeat(ring, rng.integers(1, 4), 0)  # duplicates
    elif kind == 2:
        ring = np.stack([ring[:, 0], np.zeros(n)], 1)  # collinear
    elif kind == 3:
        ring = np.array([[0, 0], [10, 0], [10, 10], [5, 10], [5, 10 + rng.normal() * 20], [5, 10], [0, 10.0]])
    elif kind == 4:
        ring = np.array([[0, 0], [10, 10], [10, 0], [0, 10.0]]) * rng.uniform(1e-3, 100)  # bow-tie
    elif kind == 5:  # touches itself in a corner
        ring = np.array([[0, 0], [5, 0], [5, 5], [10, 5], [10, 10], [5, 10], [5, 5], [0, 5.0]])
    elif kind == 6:
        m = int(rng.integers(3, 1001))
        t = np.linspace(0, 2 * np.pi, m, endpoint=False)
        ring = (20 + rng.uniform(0, 8, m))[:, None] * np.stack([np.cos(t), np.sin(t)], 1)
    elif kind == 7:
        ring = np.round(rng.uniform(0, 6, (n, 2)))  # many coincidences
    elif kind == 8:
        ring = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]) * 10.0 ** rng.uniform(-3, 3)  # 1e-6 to 1e6 m2
    else:
        w, h = rng.integers(2, 20, 2)
        ring = np.array([[0, 0], [w, 0], [w, h], [0, h]], float)
    return ring + rng.choice([0, 7e6])


def hostile_polygons(seed, num):
    rng = np.random.default_rng(seed)
    polygons = []
    for _ in range(num):
        rings = [hostile_ring(rng) for _ in range(rng.choice([0, 1, 1, 1, 2, 3]))]
        polygons.append(rings)
    return Polygons.from_rings(polygons)


def assert_mesh_or_reason(polygons, rng, sample=10):
    angle = rng.choice(
        [0, 90, 5, 20, 45, 85, rng.uniform(5, 85), 89, np.nan], len(polygons.xy_m), p=[0.12] * 8 + [0.04]
    )
    angle = np.where(
        rng.random(len(angle)) < 0.9, np.where(angle == 89, 30, np.nan_to_num(angle, nan=40)), angle
    )
    eave = rng.choice([5, 0.5, 0, np.nan, 1e4], len(polygons), p=[0.6, 0.2, 0.1, 0.05, 0.05])
    limit = rng.choice([np.inf, 3, 0, -1, np.nan], len(polygons), p=[0.6, 0.2, 0.1, 0.05, 0.05])
    meshes = build(polygons, angle, eave, max_roof_height_m=limit)
    assert all(Status(s).reason for s in meshes.status)
    has_mesh = np.diff(meshes.triangle_offset) > 0
    assert ((meshes.status == 0) == has_mesh).all()
    for k in np.flatnonzero(has_mesh)[:sample]:
        vertex, triangle, _, _ = meshes.mesh(k)
        num_courtyards = polygons.polygon_offset[k + 1] - polygons.polygon_offset[k] - 1
        assert np.isfinite(vertex).all()
        assert len(triangle) == 2 * len(vertex) - 4 + 4 * num_courtyards
        if len(triangle) < 500:
            assert judged_sound(vertex, triangle, num_courtyards) == ""
    return meshes


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_hostile_polygons(seed):
    rng = np.random.default_rng(seed)
    start = time.process_time()
    assert_mesh_or_reason(hostile_polygons(seed, 12), rng)
    assert time.process_time() - start < 30


def test_a_thousand_edges_in_time():
    rng = np.random.default_rng(0)
    t = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    ring = (120 + rng.uniform(0, 25, 1000))[:, None] * np.stack([np.cos(t), np.sin(t)], 1)
    polygons = Polygons.from_rings([[ring]])
    for angle_deg in (40.0, 0.0, 90.0):
        angle = np.where(np.arange(len(polygons.xy_m)) % 3 == 0, angle_deg, 35.0)
        start = time.process_time()
        build(polygons, angle, np.array([5.0]))
        assert time.process_time() - start < 5


FIRST_USE = """
import numpy as np
from p2wss.skeleton import Polygons, build
square = np.array([[0, 0], [10, 0], [10, 10], [0, 10]], float)
polygons = Polygons.from_rings([[square]])
assert build(polygons, np.full(4, 45.0), np.array([5.0])).status.tolist() == [0]
"""


@pytest.mark.slow
def test_parallel_first_use_of_the_cache(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    runs = [subprocess.Popen([sys.executable, "-c", FIRST_USE], env=environment) for _ in range(3)]
    assert [run.wait(timeout=600) for run in runs] == [0, 0, 0]
    assert any(tmp_path.rglob("*.nbi"))
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", FIRST_USE], env=environment, check=True)
    assert time.perf_counter() - start < 15  # from the cache: nothing is compiled again


def _sum_of_vertices(seed):
    polygons = clean(sample_footprints(50, seed))
    return build(polygons, sample_angles(polygons, "iid", seed), np.full(50, 5.0)).vertex_m.sum()


def test_same_result_in_other_processes():
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        in_processes = pool.map(_sum_of_vertices, [1, 2])
    assert in_processes == [_sum_of_vertices(1), _sum_of_vertices(2)]


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason="no real footprints beside the checkout")
@pytest.mark.parametrize(
    "name", ["olemps_bdtopo/BATIMENT.shp", "delft_ahn3/footprints.gpkg", "bresse_ign/footprints.gpkg"]
)
def test_real_footprints(name):
    frame = clean_footprints(read_footprints(DATA / name), Scenes())
    polygons = polygon_arrays.to_polygons(frame.geometry.to_numpy())
    rejected = 0
    for seed in range(10):
        angle = sample_angles(polygons, "realistic", seed)
        rejected += (build(polygons, angle, np.full(len(polygons), 6.0)).status != 0).sum()
    assert rejected <= 0.005 * 10 * len(polygons)
