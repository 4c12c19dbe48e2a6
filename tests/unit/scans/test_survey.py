"""Surveys: parameters stay in their bounds, the scene is covered, and the density is the one required."""

import json

import numpy as np
import pytest

from p2wss.config import Scans
from p2wss.scans.caster import cast
from p2wss.scans.pulses import Box
from p2wss.scans.surface import Surface
from p2wss.scans.survey import PATTERNS, plan
from p2wss.scans.terrain import local_grid

AREA = Box(-100.0, -100.0, 100.0, 100.0, -1.0, 1.0)


def flat_surface(half_m=130, height_m=0.0):
    height = np.full((2 * half_m, 2 * half_m), height_m, np.float32)
    none = np.zeros(0, np.int32)
    return Surface(
        local_grid(height, -half_m, half_m, 1.0, np.zeros(3)),
        np.zeros((0, 3)),
        np.zeros((0, 3), np.int32),
        none,
        none,
        none.astype(np.float32),
        none.astype(np.float32),
    )


def only(pattern):
    return {name: float(name == pattern) for name in PATTERNS}


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_density_is_the_one_required_and_the_whole_area_is_covered(pattern, seed):
    settings = Scans(preset="none", density_per_m2=6, pattern_shares=only(pattern))
    survey = plan(settings, seed, AREA, AREA)
    points, counts = cast(flat_surface(), survey.strips, AREA)
    assert len(points.pulse) / 200**2 == pytest.approx(6, rel=0.05)
    assert counts["lost"] == counts["no_surface"] == 0
    cells, _, _ = np.histogram2d(
        points.xyz_mm[:, 0] / 1000, points.xyz_mm[:, 1] / 1000, 20, [[-100, 100]] * 2
    )
    assert cells.min() > 0  # no cell of 10 m without a point


def test_the_preset_paper_is_the_simulator_of_the_paper():
    survey = plan(Scans(preset="paper"), 3, AREA, AREA)
    parameters = survey.parameters
    assert (parameters["pattern"], parameters["altitude_m"], parameters["half_angle_deg"]) == (
        "conical",
        1000,
        20,
    )
    assert (parameters["noise_xy_m"], parameters["noise_z_m"]) == (0.13, 0.05)
    for strip in survey.strips:
        assert strip.path.beam_sigma_rad == 0 and strip.errors.base_loss == 0
        assert strip.errors.offset_z_m == 0
    points, _ = cast(flat_surface(), survey.strips, AREA)
    assert len(points.pulse) / 200**2 == pytest.approx(8, rel=0.05)


def test_parameters_of_hd_vary_within_their_bounds():
    settings = Scans()
    patterns, headings = set(), []
    for seed in range(40):
        parameters = plan(settings, seed, AREA, AREA).parameters
        json.dumps(parameters)
        patterns.add(parameters["pattern"])
        headings.append(parameters["heading_deg"])
        for name in ("altitude_m", "speed_m_per_s", "scan_rate_hz", "overlap", "attitude_deg", "base_loss"):
            low, high = getattr(settings, name)
            assert low <= parameters[name] <= high
        assert 5 <= parameters["density_per_m2"] <= 30
        assert parameters["strip_spacing_m"] == pytest.approx(
            parameters["swath_m"] * (1 - parameters["overlap"])
        )
    assert patterns == {"conical", "parallel", "cross_fire"}
    assert np.ptp(headings) > 300


def test_a_seed_decides_everything():
    first, same, other = (plan(Scans(), seed, AREA, AREA) for seed in (5, 5, 6))
    assert first.parameters == same.parameters != other.parameters
    assert first.strips[0].errors == same.strips[0].errors
