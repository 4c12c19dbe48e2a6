"""What the product writes is valid by independent tests, on random outlines below one roof and below planes."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter

import numpy as np
import pytest
import random_solids
from places import ROOT, SHARED

from p2wss.data import reasons
from p2wss.data.building import Reconstruction

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
    found = Counter(building is not None and building.num_parts > 1 for building in solids)
    # cells of one plane that touch at a corner only have no closed solid
    assert found[True] >= 0.5 * NUM
    for _, after, codes in random_solids.validated([building for building in solids if building is not None]):
        assert after.has_mesh and codes == []


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.exists(), reason="no shared data")
def test_the_benchmark_meets_its_bars() -> None:
    """1,000 of the 20,000 solids on real outlines."""
    command = [sys.executable, ROOT / "benchmarks" / "validity.py", "--num", "1000"]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
