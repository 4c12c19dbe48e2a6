"""Pulses: the geometry of each pattern, and culling that loses nothing."""

import numpy as np
import pytest

from p2wss.config import Scans
from p2wss.scans.pulses import BLOCK_PULSES, Box, blocks_over, empty_rays, generate
from p2wss.scans.survey import PATTERNS, plan

BOX = Box(-60.0, -60.0, 60.0, 60.0, -20.0, 30.0)


def survey(pattern, **changes):
    shares = {name: float(name == pattern) for name in PATTERNS}
    settings = Scans(
        pattern_shares=shares, altitude_m=(400, 500), density_per_m2=5, density_spread=0, **changes
    )
    return plan(settings, 7, BOX, BOX)


def rays(path, blocks, box):
    room = len(blocks) * BLOCK_PULSES
    result = empty_rays(room)
    n = generate(path, blocks, box, result)
    return [column[:n] for column in result]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_culling_loses_no_pulse(pattern):
    for strip in survey(pattern, scan_rate_hz=(40, 250)).strips:
        path = strip.path
        blocks = blocks_over(path, path.num_blocks, BOX)
        everything = rays(path, np.arange(path.num_blocks), BOX)
        culled = rays(path, blocks, BOX)
        for a, b in zip(everything, culled, strict=True):
            np.testing.assert_array_equal(a, b)
        assert len(blocks) < 0.9 * path.num_blocks


@pytest.mark.parametrize("pattern", PATTERNS)
def test_beams_of_a_steady_flight(pattern):
    calm = {"drift_m": 0, "attitude_deg": (0, 0), "divergence_mrad": (0, 0)}
    path = survey(pattern, **calm).strips[0].path
    wide = Box(-1e4, -1e4, 1e4, 1e4, -20.0, 30.0)
    blocks = np.arange(min(path.num_blocks, 500))
    origin, direction, advance_m, pulse = rays(path, blocks, wide)
    np.testing.assert_array_equal(pulse, np.arange(len(blocks) * BLOCK_PULSES))
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, atol=1e-6)
    np.testing.assert_array_equal(origin[:, 2], np.float32(30))
    # back along the ray to the aircraft, which flies straight at constant speed and height
    time_s = pulse / path.pulse_rate_hz
    aircraft = origin - advance_m[:, None] * direction
    ahead = np.array([np.cos(path.heading_rad), np.sin(path.heading_rad)])
    expected = np.array([path.start_x_m, path.start_y_m]) + np.outer(path.speed_m_per_s * time_s, ahead)
    np.testing.assert_allclose(aircraft[:, :2], expected, atol=1e-3)
    np.testing.assert_allclose(aircraft[:, 2], path.altitude_m, atol=1e-3)
    off_nadir = np.arctan2(np.hypot(direction[:, 0], direction[:, 1]), -direction[:, 2]).astype(float)
    forward = direction[:, :2] @ ahead
    if pattern == "conical":
        np.testing.assert_allclose(off_nadir, path.half_angle_rad, atol=1e-5)
        assert forward.min() < -0.9 * np.sin(path.half_angle_rad)
    else:
        assert 0.99 < off_nadir.max() / path.half_angle_rad < 1.0001
        crossing = np.radians(14) if pattern == "cross_fire" else 0
        np.testing.assert_allclose(np.abs(forward), np.sin(off_nadir) * np.sin(crossing), atol=1e-5)


def test_rounding_of_rays_is_below_a_twentieth_of_a_millimetre():
    path = survey("parallel").strips[0].path
    blocks = blocks_over(path, path.num_blocks, BOX)
    origin, direction, _, _ = rays(path, blocks, BOX)
    # where float32 rays meet z = 0, against the same rays from the aircraft in float64
    ground = origin[:, :2] - (origin[:, 2] / direction[:, 2])[:, None] * direction[:, :2]
    exact = (
        origin[:, :2].astype(float)
        - (origin[:, 2] / direction[:, 2].astype(float))[:, None] * direction[:, :2]
    )
    assert np.abs(ground - exact).max() < 5e-5
