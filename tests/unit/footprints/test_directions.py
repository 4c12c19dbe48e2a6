"""Cleaning makes nearly parallel edges parallel, so that a millimetre does not decide the shape of a roof."""

import sys

import numpy as np
import pytest
from places import ROOT

from p2wss.skeleton import Polygons, Status, build

sys.path.insert(0, str(ROOT / "tests" / "unit" / "skeleton"))
from skeleton_samples import clean, edge_source, sample_angles, sample_footprints
from skeleton_solids import volumes

STEP = np.array([[0, 0], [10, 0], [10, 7], [5, 7], [5, 6], [0, 6]], float)


def directions(ring):
    along = np.roll(ring, -1, 0) - ring
    return along / np.hypot(*along.T)[:, None]


def aligned(ring, raw):
    """The ring from the vertex that is nearest to the first raw one."""
    return np.roll(ring, -np.hypot(*(ring - raw[0]).T).argmin(), axis=0)


def test_nearly_parallel_edges_become_parallel_and_hardly_move():
    rng = np.random.default_rng(0)
    for _ in range(50):
        raw = STEP + rng.uniform(-0.01, 0.01, STEP.shape)
        cleaned = aligned(clean(Polygons.from_rings([[raw]])).rings(0)[0], raw)
        x, y = directions(cleaned).T
        assert np.abs(np.outer(x, y) - np.outer(y, x))[::2, ::2].max() < 1e-12
        assert np.hypot(*(cleaned - raw).T).max() < 0.05


def test_no_corner_moves_too_far():
    wedge = np.array([[0, 0], [40, 0], [40, 11], [0, 10]], float)  # 1.4 degrees, a metre
    moved = aligned(clean(Polygons.from_rings([[wedge]])).xy_m, wedge) - wedge
    assert np.abs(moved).max() < 1e-12


def test_collinear_edges_share_a_line():
    shape = [[0, 0], [20, 0], [20, 8], [14, 8], [14, 5], [6, 5], [6, 8.01], [0, 8.01]]
    raw = np.array(shape, float)
    xy = aligned(clean(Polygons.from_rings([[raw]])).xy_m, raw)
    assert np.ptp(xy[[2, 3, 6, 7], 1]) < 1e-12 and 8 < xy[2, 1] < 8.01
    unchanged = clean(Polygons.from_rings([[raw]]), parallel_deg=0.0)
    np.testing.assert_array_equal(aligned(unchanged.xy_m, raw), raw)


def test_cleaning_twice_changes_little():
    once = clean(sample_footprints(500, 4, 0.2))
    twice = clean(once)
    same = np.diff(twice.vertex_offset) == np.diff(once.vertex_offset)
    assert same.mean() > 0.995
    moved = np.concatenate(
        [
            np.hypot(*(aligned(b, a) - a).T)
            for k in np.flatnonzero(same)
            for a, b in zip(once.rings(k), twice.rings(k), strict=True)
        ]
    )
    # an edge that was too far from its group may have come nearer with its neighbours
    assert moved.max() < 0.05 and np.mean(moved > 1e-8) < 0.1


@pytest.mark.parametrize("shift", [0.0, 7e6])
def test_a_millimetre_does_not_decide(shift):
    raw = clean(sample_footprints(1000, 6), parallel_deg=0.0)
    angle = sample_angles(raw, "many-90", 7)
    jitter = np.random.default_rng(8).normal(0, 1e-3, raw.xy_m.shape)
    share = {}
    for parallel_deg in (0.0, 2.5):
        volume = []
        for xy in (raw.xy_m, raw.xy_m + jitter):
            moved = Polygons(xy + shift, raw.ring_offset, raw.polygon_offset)
            cleaned = clean(moved, parallel_deg=parallel_deg)
            meshes = build(cleaned, angle[edge_source(moved, cleaned)], np.full(len(raw), 5.0))
            # coordinates of 7e6 m are rounded to a nanometre, which breaks a tie now and then
            assert (meshes.status != Status.OK).mean() <= (0.005 if shift else 0.0)
            volume.append(volumes(meshes))
        share[parallel_deg] = np.mean(np.abs(volume[1] / volume[0] - 1) > 0.02)
    assert share[2.5] <= 0.003 < 0.01 < share[0.0]
