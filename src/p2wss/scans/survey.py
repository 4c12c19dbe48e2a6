"""The survey of one scene: sensor, flight lines and errors, drawn from the bounds of the configuration.

The density is an input. Parallel strips of swath W = 2 H tan(half angle) lie S = W (1 - overlap) apart; their
mean density is D = PRF / (v S) for any scan pattern, and the pulse rate follows from it. Because one scene
holds only a strip or two, the pulse rate is set from the time that the beam really spends over the scene.
"""

from dataclasses import dataclass
from math import cos, radians, sin, tan
from typing import Any

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from p2wss.config import Scans
from p2wss.data.seeds import derive_seed, generator
from p2wss.scans.pulses import CONICAL, CROSS_FIRE, PARALLEL, Box, StripPath, time_over
from p2wss.scans.randomness import NORMAL_QUANTILE
from p2wss.scans.returns import Errors

PATTERNS = {"conical": CONICAL, "parallel": PARALLEL, "cross_fire": CROSS_FIRE}
CROSSING_DEG = 14.0  # of each channel of the cross-fire pattern, as in RIEGL's VQ-1560 series
_KNOT_INTERVAL_S = 0.05
_SAMPLE_INTERVAL_S = 1e-4
_TURN_S = 120.0  # between two lines
# how far lines reach beyond the scene, metres: this share of the swath (as half of it is across), this share of the
# differences in height, because the platform pitches, and the drift of the platform
_REACH_SWATH_SHARE, _REACH_HEIGHT_SHARE, _REACH_M = 0.55, 0.1, 20
# correlation time of the drift, and the periods of the attitude, drawn evenly
_DRIFT_TIME_S, _ATTITUDE_PERIOD_S = 20.0, (3, 15)
# the errors that only the preset `hd` has
_ERRORS = (
    "drift_m",
    "attitude_deg",
    "divergence_mrad",
    "noise_xy_m",
    "noise_range_m",
    "strip_offset_xy_m",
    "strip_offset_z_m",
    "base_loss",
    "min_intensity",
    "speckle",
)
# the defaults of the public simulator behind the paper (Marchand et al. 2021, github.com/umrlastig/SurfaceReconEval)
PAPER_ALTITUDE_M = 1000.0
_PAPER = {
    "pattern": "conical",
    "altitude_m": PAPER_ALTITUDE_M,
    "half_angle_deg": 20.0,
    "speed_m_per_s": 60.0,
    "scan_rate_hz": 150.0,
    "overlap": 0.3,
    "heading_deg": 0.0,
    "cross_strip": False,
    "noise_xy_m": 0.13,
    "noise_z_m": 0.05,
}
_PAPER_DENSITY_PER_M2 = 8.0  # section 5.1 of the paper
_HD_DENSITY_PER_M2 = 14.0


@dataclass(frozen=True)
class Strip:
    """One flight line: its path, its errors, and when it starts (GPS seconds of the survey)."""

    path: StripPath
    errors: Errors
    start_s: float


@dataclass(frozen=True)
class Survey:
    """The strips over a scene, and ``parameters``: everything that was drawn at random, ready for JSON."""

    strips: list[Strip]
    parameters: dict[str, Any]


# a flight line: x and y of its start in metres, its direction in radians, and its length in metres
_Line = tuple[float, float, float, float]


def plan(settings: Scans, seed: int, box: Box, area: Box) -> Survey:
    """Draw a survey whose strips cover ``box`` and whose mean density over ``area`` is the density drawn.

    Both boxes are in the local frame; heights are above the scene's median ground. ``seed`` is the scene's:
    the same settings, seed and boxes give the same survey.
    """
    parameters = _parameters(settings, generator(seed, "survey"))
    half_angle, heading = radians(parameters["half_angle_deg"]), radians(90 - parameters["heading_deg"])
    swath_m = 2 * parameters["altitude_m"] * tan(half_angle)
    spacing_m = swath_m * (1 - parameters["overlap"])
    parameters |= {"swath_m": swath_m, "strip_spacing_m": spacing_m}
    lines = _lines(box, heading, swath_m, spacing_m, parameters["strip_phase"])
    if parameters["cross_strip"]:
        lines += _lines(box, heading + np.pi / 2, swath_m, np.inf, 0.5)

    strips, start_s = [], 0.0
    for index, line in enumerate(lines):
        strip = _strip(parameters, seed, index, line, start_s)
        strips.append(strip)
        start_s += strip.path.duration_s + _TURN_S

    seconds = sum(time_over(strip.path, area, _SAMPLE_INTERVAL_S) for strip in strips)
    area_m2 = (area.x_max_m - area.x_min_m) * (area.y_max_m - area.y_min_m)
    parameters["pulse_rate_hz"] = float(parameters["density_per_m2"] * area_m2 / seconds)
    strips = [
        Strip(s.path._replace(pulse_rate_hz=parameters["pulse_rate_hz"]), s.errors, s.start_s) for s in strips
    ]
    parameters["strips"] = [
        {
            "point_source_id": s.path.number + 1,
            "start_xy_m": [s.path.start_x_m, s.path.start_y_m],
            "heading_deg": float(90 - np.degrees(s.path.heading_rad)) % 360,
            "duration_s": s.path.duration_s,
            "gps_start_s": s.start_s,
            "offset_m": [s.errors.offset_x_m, s.errors.offset_y_m, s.errors.offset_z_m],
        }
        for s in strips
    ]
    return Survey(strips, parameters)


def _strip(parameters: dict[str, Any], seed: int, index: int, line: _Line, start_s: float) -> Strip:
    """The strip along a line of :func:`_lines`, with its errors; its pulse rate is 1 Hz and yet to be set."""
    x, y, direction, length_m = line
    half_angle = radians(parameters["half_angle_deg"])
    rng = generator(seed, "strip", index)
    duration_s = length_m / parameters["speed_m_per_s"]
    path = StripPath(
        number=index,
        pattern=PATTERNS[parameters["pattern"]],
        half_angle_rad=half_angle,
        sin_half_angle=sin(half_angle),
        cos_half_angle=cos(half_angle),
        scan_rate_hz=parameters["scan_rate_hz"],
        scan_phase=rng.uniform(),
        crossing_rad=radians(CROSSING_DEG),
        pulse_rate_hz=1.0,
        start_x_m=x,
        start_y_m=y,
        altitude_m=parameters["altitude_m"],
        heading_rad=direction,
        speed_m_per_s=parameters["speed_m_per_s"],
        duration_s=duration_s,
        knot_interval_s=_KNOT_INTERVAL_S,
        knots=_knots(rng, duration_s, direction, parameters["drift_m"], radians(parameters["attitude_deg"])),
        # the 1/e^2 diameter of a Gaussian beam is four standard deviations
        beam_sigma_rad=parameters["divergence_mrad"] * 1e-3 / 4,
        beam_key=np.uint64(derive_seed(seed, "beam", index)),
        quantile=NORMAL_QUANTILE,
    )
    errors = Errors(
        noise_xy_m=parameters["noise_xy_m"],
        noise_z_m=parameters["noise_z_m"],
        noise_range_m=parameters["noise_range_m"],
        offset_x_m=rng.normal(0, parameters["strip_offset_xy_m"]),
        offset_y_m=rng.normal(0, parameters["strip_offset_xy_m"]),
        offset_z_m=rng.normal(0, parameters["strip_offset_z_m"]),
        base_loss=parameters["base_loss"],
        min_intensity=parameters["min_intensity"],
        speckle=parameters["speckle"],
        reference_range_m=parameters["altitude_m"],
        key=np.uint64(derive_seed(seed, "noise", index)),
        loss_key=np.uint64(derive_seed(seed, "loss", index)),
    )
    return Strip(path, errors, start_s)


def _parameters(settings: Scans, rng: np.random.Generator) -> dict[str, Any]:
    """One random draw of everything but the strips; an error that a preset lacks is 0."""
    shares = settings.pattern_shares.model_dump()
    weights = np.array(list(shares.values()), float)
    pattern = str(rng.choice(list(shares), p=weights / weights.sum()))
    half_angle = settings.conical_half_angle_deg if pattern == "conical" else settings.line_half_angle_deg
    low, high = settings.density_bounds_per_m2
    target = settings.density_per_m2 or (
        _HD_DENSITY_PER_M2 if settings.preset == "hd" else _PAPER_DENSITY_PER_M2
    )
    density = float(np.clip(target * np.exp(rng.normal(0, settings.density_spread)), low, high))
    parameters: dict[str, Any] = {
        "preset": settings.preset,
        "pattern": pattern,
        "density_per_m2": density,
        "altitude_m": rng.uniform(*settings.altitude_m),
        "half_angle_deg": rng.uniform(*half_angle),
        "speed_m_per_s": rng.uniform(*settings.speed_m_per_s),
        "scan_rate_hz": rng.uniform(*settings.scan_rate_hz),
        "overlap": rng.uniform(*settings.overlap),
        "heading_deg": rng.uniform(0, 360),
        "strip_phase": rng.uniform(),
        "cross_strip": bool(rng.uniform() < settings.cross_strip_share),
        "drift_m": settings.drift_m,
        "attitude_deg": rng.uniform(*settings.attitude_deg),
        "divergence_mrad": rng.uniform(*settings.divergence_mrad),
        "noise_xy_m": rng.uniform(*settings.pointing_noise_m),
        "noise_z_m": 0.0,
        "noise_range_m": rng.uniform(*settings.range_noise_m),
        "strip_offset_xy_m": settings.strip_offset_xy_m,
        "strip_offset_z_m": settings.strip_offset_z_m,
        "base_loss": rng.uniform(*settings.base_loss),
        "min_intensity": settings.min_intensity,
        "speckle": settings.speckle,
    }
    if settings.preset == "hd":
        return parameters
    # `none` is the same flight without errors, `paper` the simulator of the paper with its own errors
    parameters |= dict.fromkeys(_ERRORS, 0.0) | {"density_per_m2": target}
    return parameters | (_PAPER if settings.preset == "paper" else {})


def _lines(box: Box, heading_rad: float, swath_m: float, spacing_m: float, phase: float) -> list[_Line]:
    """Flight lines (x, y of the start, heading, length) whose swaths cover ``box``; every second one is flown
    in the opposite direction.

    An infinite spacing gives one line over the middle.
    """
    forward = np.array([cos(heading_rad), sin(heading_rad)])
    left = np.array([-forward[1], forward[0]])
    corners = np.array([[x, y] for x in (box.x_min_m, box.x_max_m) for y in (box.y_min_m, box.y_max_m)])
    across, along = corners @ left, corners @ forward
    reach = _REACH_SWATH_SHARE * swath_m + _REACH_HEIGHT_SHARE * (box.z_max_m - box.z_min_m) + _REACH_M
    along_min, along_max = along.min() - reach, along.max() + reach
    if np.isinf(spacing_m):
        offsets = np.array([across.mean()])
    else:
        first, last = across.min() - swath_m / 2, across.max() + swath_m / 2
        offsets = np.arange(first + phase * spacing_m, last, spacing_m)
    lines = []
    for index, offset in enumerate(offsets):
        backward = index % 2 == 1
        start = offset * left + (along_max if backward else along_min) * forward
        direction = heading_rad + (np.pi if backward else 0.0)
        lines.append((float(start[0]), float(start[1]), direction, float(along_max - along_min)))
    return lines


def _knots(
    rng: np.random.Generator, duration_s: float, heading_rad: float, drift_m: float, attitude_rad: float
) -> np.ndarray:
    """Drift and rotation along one strip as :class:`pulses.StripPath` has them, float64 (k, 12).

    The drift is an Ornstein-Uhlenbeck process, the attitude a sum of three sinusoids per axis.
    """
    time_s = np.arange(int(duration_s / _KNOT_INTERVAL_S) + 2) * _KNOT_INTERVAL_S
    decay = float(np.exp(-_KNOT_INTERVAL_S / _DRIFT_TIME_S))
    steps = rng.normal(0, drift_m * np.sqrt(1 - decay**2), (len(time_s), 3))
    steps[0] = rng.normal(0, drift_m, 3)
    drift = lfilter([1.0], [1.0, -decay], steps, axis=0)
    amplitude = rng.dirichlet(np.ones(3), 3) * attitude_rad
    period_s, phase = rng.uniform(*_ATTITUDE_PERIOD_S, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
    angle = 2 * np.pi * time_s[:, None, None] / period_s + phase
    yaw_pitch_roll = (amplitude * np.sin(angle)).sum(axis=2)
    yaw_pitch_roll[:, 0] += heading_rad
    matrix = Rotation.from_euler("ZYX", yaw_pitch_roll).as_matrix()
    return np.ascontiguousarray(np.concatenate([drift, matrix.reshape(-1, 9)], axis=1))
