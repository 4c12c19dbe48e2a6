"""What the product writes is valid by independent tests, on random outlines below one roof and below planes."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import random_solids
from places import ROOT, SHARED

from p2wss.data import reasons
from p2wss.data.building import Reconstruction
from p2wss.mesh.planar import with_exact_faces
from p2wss.mesh.repair import surfaces_to_write

sys.path.insert(0, str(ROOT / "tests" / "unit" / "skeleton"))
from skeleton_samples import clean, sample_footprints

NUM = 36


@pytest.fixture(scope="module")
def outlines() -> list[random_solids.Rings]:
    polygons = clean(sample_footprints(NUM, 5, court_share=0.15))
    return [[np.asarray(ring) for ring in polygons.rings(i)] for i in range(len(polygons))]


@pytest.mark.parametrize("regime", random_solids.REGIMES)
def test_roofs(outlines: list[random_solids.Rings], regime: str) -> None:
    buildings: list[Reconstruction | None] = []
    for i, rings in enumerate(outlines):
        angle_deg = random_solids.angles(rings, regime, f"{regime} {i}", i)
        buildings.append(random_solids.reconstruction(f"{regime} {i}", rings, 4.0, angle_deg))
    solids = [building for building in buildings if building is not None]
    assert len(solids) >= 0.9 * NUM
    for _, after, codes in random_solids.validated(solids):
        assert after.has_mesh and after.status == reasons.OK and codes == []


@pytest.mark.parametrize("is_hard", [False, True])
def test_planes(outlines: list[random_solids.Rings], is_hard: bool) -> None:
    solids = [
        random_solids.with_planes(f"planes {i}", rings, i, 1 + i % 6, is_hard)
        for i, rings in enumerate(outlines)
    ]
    # cells of one plane that touch at a corner only have no closed solid
    assert sum(building is not None for building in solids) >= 0.5 * NUM
    for _, after, codes in random_solids.validated([building for building in solids if building is not None]):
        assert after.has_mesh and codes == []


def test_a_roof_without_width_leaves_the_solid_closed() -> None:
    """Its corners are on one line, once a millimetre of it is gone: walls then keep the vertices within their edges."""
    corner = np.array([[0.0, 0.0], [14.0, 0.0], [14.0, 6.0], [9.0, 6.0], [9.0, 11.0], [0.0, 11.0]])
    mesh = random_solids.below_planes("a", [corner], 24, 4, True)
    assert mesh is not None and mesh.is_closed and (mesh.num_planes_at == 2).any()


def test_short_edges_go_only_where_no_faces_cross_then() -> None:
    square = np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 7.0], [0.0, 7.0]])
    num_shorter = 0
    for i in (47, 79, 87, 88, 99, 170, 177, 181, 233):
        mesh = random_solids.below_planes(f"p {i}", [square], i, 3 + i % 6, True)
        assert mesh is not None
        exact = with_exact_faces(mesh, 0.2)
        num_shorter += len(exact.triangle) < len(mesh.triangle)
        assert surfaces_to_write(exact, (0.0, 0.0, 0.0))[1] == []
    assert num_shorter >= 2


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.exists(), reason="no shared data")
def test_the_benchmark_meets_its_bars() -> None:
    """1,000 of the 20,000 solids on real outlines."""
    command = [sys.executable, ROOT / "benchmarks" / "validity.py", "--num", "1000"]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
