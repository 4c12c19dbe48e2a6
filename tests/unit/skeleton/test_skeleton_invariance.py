"""Changes of the input that must not change the roof, and changes that must change it in one direction."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skeleton_samples import REGIMES, clean, sample_angles, sample_footprints
from skeleton_solids import volumes

from p2wss.skeleton import Polygons, build

seeds = st.integers(0, 10_000)


def one_building(seed, regime="iid"):
    """A jittered footprint, so that no tie decides, with its angles and its volume."""
    for k in range(seed, seed + 50):
        polygons = clean(sample_footprints(1, k, 0.3))
        rng = np.random.default_rng(k)
        if not len(polygons.xy_m):
            continue
        rings = [[r + rng.normal(0, 0.05, r.shape) for r in polygons.rings(0)]]
        cleaned = clean(Polygons.from_rings(rings))
        angle = sample_angles(cleaned, regime, k)
        meshes = build(cleaned, angle, np.array([5.0]))
        if meshes.status[0] == 0 and meshes.num_ambiguous[0] == 0:
            return cleaned, angle
    raise AssertionError("no unambiguous building")


def volume(polygons, angle):
    meshes = build(polygons, angle, np.full(len(polygons), 5.0))
    assert (meshes.status == 0).all()
    return volumes(meshes)[0]


@settings(max_examples=60, deadline=None)
@given(seeds, st.sampled_from(REGIMES), st.floats(0, 6.28), st.floats(-7e6, 7e6), st.floats(-7e6, 7e6))
def test_rotation_and_translation(seed, regime, turn, east, north):
    polygons, angle = one_building(seed, regime)
    c, s = np.cos(turn), np.sin(turn)
    moved = polygons.xy_m @ np.array([[c, -s], [s, c]]) + [east, north]
    other = volume(Polygons(moved, polygons.ring_offset, polygons.polygon_offset), angle)
    assert other == pytest.approx(volume(polygons, angle), rel=1e-5)


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from(REGIMES), st.floats(0.5, 20))
def test_scale(seed, regime, scale):
    polygons, angle = one_building(seed, regime)
    larger = Polygons(polygons.xy_m * scale, polygons.ring_offset, polygons.polygon_offset)
    box, larger_box = (volume(p, np.full(len(angle), 90.0)) for p in (polygons, larger))
    roof, larger_roof = volume(polygons, angle) - box, volume(larger, angle) - larger_box
    assert larger_roof == pytest.approx(roof * scale**3, rel=1e-5, abs=1e-6 * larger_box)


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from(REGIMES), st.integers(0, 12))
def test_mirror_and_start_vertex(seed, regime, start):
    polygons, angle = one_building(seed, regime)
    expected = volume(polygons, angle)
    parts = np.split(angle, polygons.ring_offset[1:-1])
    rolled = [np.roll(ring, -start, 0) for ring in polygons.rings(0)]
    rolled_angle = np.concatenate([np.roll(part, -start) for part in parts])
    assert volume(Polygons.from_rings([rolled]), rolled_angle) == pytest.approx(expected, rel=1e-6)
    mirrored = [(ring * [-1, 1])[::-1] for ring in polygons.rings(0)]
    mirrored_angle = np.concatenate([np.roll(part[::-1], -1) for part in parts])
    assert volume(Polygons.from_rings([mirrored]), mirrored_angle) == pytest.approx(expected, rel=1e-6)


@settings(max_examples=40, deadline=None)
@given(seeds, st.floats(10, 40), st.floats(1, 30))
def test_one_steeper_angle_for_all_raises_the_roof(seed, angle_deg, more):
    polygons, _ = one_building(seed)
    low, high = (volume(polygons, np.full(len(polygons.xy_m), a)) for a in (angle_deg, angle_deg + more))
    box = volume(polygons, np.full(len(polygons.xy_m), 90.0))
    expected = np.tan(np.radians(angle_deg + more)) / np.tan(np.radians(angle_deg))
    assert (high - box) / (low - box) == pytest.approx(expected, rel=1e-5)


@settings(max_examples=40, deadline=None)
@given(seeds, st.integers(0, 30), st.floats(0.5, 20))
def test_one_steeper_edge_never_lowers_a_convex_roof(seed, which, more):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0, 2 * np.pi, 7))
    cleaned = clean(Polygons.from_rings([[10 * np.stack([np.cos(t), np.sin(t)], 1)]]))
    if not len(cleaned.xy_m):
        return
    angle = rng.uniform(20, 45, len(cleaned.xy_m))
    steeper = angle.copy()
    steeper[which % len(angle)] += more
    assert volume(cleaned, steeper) >= volume(cleaned, angle) - 1e-6
