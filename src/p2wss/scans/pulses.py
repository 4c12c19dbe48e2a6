"""The pulses of one strip: the ray of each, and which of them can reach the scene.

Pulses are numbered from the start of their strip and handled in blocks of :data:`BLOCK_PULSES`. A block is
about 0.1 ms of flight, so one test at its centre shows whether its pulses can reach the box of the scene: two
thirds of a survey are never generated. Within a block the attitude of the platform is constant (it turns by
less than 4e-6 rad in that time, 5 mm on the ground).
"""

from math import cos, floor, pi, sin, tan
from typing import NamedTuple

import numpy as np

from p2wss.scans.randomness import normal, random_bits
from p2wss.skeleton.compiled import entry, inlined, inner

BLOCK_PULSES = 32
CONICAL, PARALLEL, CROSS_FIRE = range(3)


class StripPath(NamedTuple):
    """One flight line and its scanner, in the local frame (x east, y north, z above the scene's median
    ground).

    knots: float64 (k, 12), every ``knot_interval_s``: drift of the platform in x, y, z (m) and the matrix,
    row by row, that turns the scanner's frame into the local one. beam_sigma_rad: standard deviation of the
    direction of the ray that stands for a beam within the beam, per axis. quantile: the table of normal deviates
    (:data:`randomness.NORMAL_QUANTILE`).
    """

    number: int  # of the strip, from 0
    pattern: int
    half_angle_rad: float
    sin_half_angle: float
    cos_half_angle: float
    scan_rate_hz: float
    scan_phase: float  # turns
    crossing_rad: float  # of the scan lines of the two channels of CROSS_FIRE
    pulse_rate_hz: float
    start_x_m: float
    start_y_m: float
    altitude_m: float
    heading_rad: float  # from east, counter-clockwise
    speed_m_per_s: float
    duration_s: float
    knot_interval_s: float
    knots: np.ndarray
    beam_sigma_rad: float
    beam_key: np.uint64
    quantile: np.ndarray

    @property
    def num_blocks(self) -> int:
        return int(self.duration_s * self.pulse_rate_hz / BLOCK_PULSES) + 1


class Box(NamedTuple):
    """A box in the local frame, from below to above every surface: only pulses that pass over it are
    generated."""

    x_min_m: float
    y_min_m: float
    x_max_m: float
    y_max_m: float
    z_min_m: float
    z_max_m: float


class Rays(NamedTuple):
    """Rays of n pulses, in the order of firing.

    origin and direction: float32 (n, 3), from the plane of the box's top on. advance_m: float64 (n,), the distance
    from the aircraft to that plane. pulse: int64 (n,).
    """

    origin: np.ndarray
    direction: np.ndarray
    advance_m: np.ndarray
    pulse: np.ndarray


def empty_rays(room: int) -> Rays:
    """Arrays for the rays of ``room`` pulses, not initialised."""
    vectors = np.empty((2, room, 3), np.float32)
    return Rays(vectors[0], vectors[1], np.empty(room), np.empty(room, np.int64))


@inner
def _platform(path: StripPath, t: float, pose: np.ndarray) -> None:
    """Write drift (3) and rotation matrix (9) of the platform at time ``t`` into ``pose``."""
    position = min(max(t / path.knot_interval_s, 0.0), len(path.knots) - 1.000001)
    k = int(position)
    w = position - k
    for i in range(12):
        pose[i] = path.knots[k, i] + w * (path.knots[k + 1, i] - path.knots[k, i])


@inlined
def _mirror_rad(path: StripPath, turns: float) -> float:
    """Angle of the beam around the cone's axis (CONICAL), else off nadir; ``turns`` is a fraction of one
    turn."""
    if path.pattern == CONICAL:
        return 2 * pi * turns
    return path.half_angle_rad * (2 * turns - 1)


@inlined
def _direction(path: StripPath, cosine: float, sine: float, pulse: int) -> tuple[float, float, float]:
    """Unit direction in the scanner's frame, x forward, y left, z up, of a mirror angle."""
    if path.pattern == CONICAL:
        return path.sin_half_angle * cosine, path.sin_half_angle * sine, -path.cos_half_angle
    if path.pattern == CROSS_FIRE:
        turn = path.crossing_rad if pulse & 1 else -path.crossing_rad
        return -sine * sin(turn), sine * cos(turn), -cosine
    return 0.0, sine, -cosine


@inlined
def _beam(path: StripPath, t: float, pulse: int) -> tuple[float, float, float]:
    """Unit direction in the scanner's frame at time ``t``."""
    turns = t * path.scan_rate_hz + path.scan_phase
    angle = _mirror_rad(path, turns - floor(turns))
    return _direction(path, cos(angle), sin(angle), pulse)


@inlined
def _rotate(p: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        p[3] * x + p[4] * y + p[5] * z,
        p[6] * x + p[7] * y + p[8] * z,
        p[9] * x + p[10] * y + p[11] * z,
    )


@entry
def time_over(path: StripPath, box: Box, interval_s: float) -> float:
    """Seconds during which the beam meets the plane z = 0 inside ``box``, from samples about every
    ``interval_s``."""
    hits = 0
    p = np.empty(12)
    num = int(path.duration_s / interval_s)
    vx, vy = cos(path.heading_rad) * path.speed_m_per_s, sin(path.heading_rad) * path.speed_m_per_s
    for i in range(num):
        jitter = i * 0.6180339887498949  # keeps the samples out of step with the mirror
        t = (i + jitter - floor(jitter)) * interval_s
        _platform(path, t, p)
        x, y, z = _beam(path, t, i)
        x, y, z = _rotate(p, x, y, z)
        s = -(path.altitude_m + p[2]) / z
        x = path.start_x_m + vx * t + p[0] + s * x
        y = path.start_y_m + vy * t + p[1] + s * y
        if box.x_min_m <= x < box.x_max_m and box.y_min_m <= y < box.y_max_m:
            hits += 1
    return hits * interval_s


@entry
def blocks_over(path: StripPath, num_blocks: int, box: Box) -> np.ndarray:
    """Blocks of pulses (int64, ascending) that may pass over ``box``: all that do, and few that do not."""
    result = np.empty(num_blocks, np.int64)
    p = np.empty(12)
    n = 0
    half_s = 0.5 * BLOCK_PULSES / path.pulse_rate_hz
    drop_m = path.altitude_m - box.z_min_m + 20.0
    steepest = path.half_angle_rad + 0.1  # attitude stays within 0.1 rad
    if path.pattern == CONICAL:
        spot_speed = 2 * pi * path.scan_rate_hz * drop_m * tan(steepest)
    else:
        spot_speed = 2.0 * path.half_angle_rad * path.scan_rate_hz * drop_m / cos(steepest) ** 2
    reach = 1.2 * (spot_speed + path.speed_m_per_s) * half_s + 6 * path.beam_sigma_rad * drop_m * 2 + 1.0
    vx, vy = cos(path.heading_rad) * path.speed_m_per_s, sin(path.heading_rad) * path.speed_m_per_s
    for block in range(num_blocks):
        t = (block + 0.5) * BLOCK_PULSES / path.pulse_rate_hz
        if path.pattern != CONICAL:
            first = floor((t - half_s) * path.scan_rate_hz + path.scan_phase)
            if floor((t + half_s) * path.scan_rate_hz + path.scan_phase) != first:  # the mirror jumps back
                result[n] = block
                n += 1
                continue
        _platform(path, t, p)
        px, py, pz = path.start_x_m + vx * t + p[0], path.start_y_m + vy * t + p[1], path.altitude_m + p[2]
        overlaps = False
        for channel in range(2 if path.pattern == CROSS_FIRE else 1):
            x, y, z = _beam(path, t, channel)
            x, y, z = _rotate(p, x, y, z)
            top, bottom = (box.z_max_m - pz) / z, (box.z_min_m - pz) / z
            x0, x1 = px + top * x, px + bottom * x
            y0, y1 = py + top * y, py + bottom * y
            overlaps |= (
                min(x0, x1) - reach <= box.x_max_m
                and max(x0, x1) + reach >= box.x_min_m
                and min(y0, y1) - reach <= box.y_max_m
                and max(y0, y1) + reach >= box.y_min_m
            )
        if overlaps:
            result[n] = block
            n += 1
    return result[:n].copy()


@entry
def generate(path: StripPath, blocks: np.ndarray, box: Box, rays: Rays) -> int:
    """Fill in the pulses of ``blocks`` that pass over ``box``, in the order of firing; returns their number.

    Each is advanced in float64 to the plane of the box's top and only then rounded to float32, so that Embree
    sees short rays (rounding below 0.04 mm at 1 km). ``rays`` has room for ``len(blocks) * BLOCK_PULSES``.
    """
    origin, direction, advance_m, pulse = rays
    quantile = path.quantile
    n = 0
    p = np.empty(12)
    vx, vy = cos(path.heading_rad) * path.speed_m_per_s, sin(path.heading_rad) * path.speed_m_per_s
    period_s = 1 / path.pulse_rate_hz
    turn = period_s * path.scan_rate_hz
    # within a block the mirror's sine and cosine follow from those of the pulse before
    step_rad = 2 * pi * turn if path.pattern == CONICAL else 2 * path.half_angle_rad * turn
    step_cos, step_sin = cos(step_rad), sin(step_rad)
    for block in blocks:
        _platform(path, (block + 0.5) * BLOCK_PULSES / path.pulse_rate_hz, p)
        pz = path.altitude_m + p[2]
        turns, cosine, sine = 2.0, 0.0, 0.0  # of no pulse yet
        for i in range(block * BLOCK_PULSES, (block + 1) * BLOCK_PULSES):
            t = i * period_s
            turns += turn
            if turns >= 1:
                turns = t * path.scan_rate_hz + path.scan_phase
                turns -= floor(turns)
                angle = _mirror_rad(path, turns)
                cosine, sine = cos(angle), sin(angle)
            else:
                cosine, sine = cosine * step_cos - sine * step_sin, sine * step_cos + cosine * step_sin
            x, y, z = _direction(path, cosine, sine, i)
            x, y, z = _rotate(p, x, y, z)
            if path.beam_sigma_rad > 0:
                bits = random_bits(path.beam_key, np.uint64(i))
                x += path.beam_sigma_rad * normal(bits, 0, quantile)
                y += path.beam_sigma_rad * normal(bits, 1, quantile)
                z += path.beam_sigma_rad * normal(bits, 2, quantile)
                length = 1.5 - 0.5 * (x * x + y * y + z * z)  # 1 / sqrt to 1e-6, for beams below 4 mrad
                x, y, z = x * length, y * length, z * length
            px, py = path.start_x_m + vx * t + p[0], path.start_y_m + vy * t + p[1]
            per_z = 1 / z
            top, bottom = (box.z_max_m - pz) * per_z, (box.z_min_m - pz) * per_z
            x0, x1 = px + top * x, px + bottom * x
            y0, y1 = py + top * y, py + bottom * y
            if (
                min(x0, x1) <= box.x_max_m
                and max(x0, x1) >= box.x_min_m
                and min(y0, y1) <= box.y_max_m
                and max(y0, y1) >= box.y_min_m
            ):
                origin[n, 0], origin[n, 1], origin[n, 2] = x0, y0, box.z_max_m
                direction[n, 0], direction[n, 1], direction[n, 2] = x, y, z
                advance_m[n] = top
                pulse[n] = i
                n += 1
    return n
