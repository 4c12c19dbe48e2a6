"""From hits to recorded points: detection of the returns of each pulse, noise, and the tags of the points."""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from p2wss.scans.beams import (
    SUB_BEAMS,
    SubBeams,
    axis_distance,
    next_return,
    return_strength,
    sort_sub_beams,
    to_axis,
    triangle_of,
)
from p2wss.scans.hits import Hits
from p2wss.scans.pulses import Box, StripPath
from p2wss.scans.randomness import normal, random_bits, uniform
from p2wss.scans.surface import CLUTTER_KIND, Surface
from p2wss.skeleton.compiled import entry, inlined
from p2wss.skeleton.types import FaceKind

# what becomes of a pulse
RECORDED, NO_SURFACE, OUTSIDE, LOST = range(4)
OUTCOMES = ("recorded", "no_surface", "outside", "lost")

_WALL = int(FaceKind.WALL)
_PER_RAD = 180 / pi / 0.006  # LAS 1.4, scan angle
_FULL_SCALE = 40_000.0  # intensity of a white surface seen head-on from the planned altitude


class Errors(NamedTuple):
    """How one strip's sensor departs from a perfect one.

    Standard deviations: noise_xy_m and noise_z_m along the axes of the frame, noise_range_m along the ray.
    offset_*_m: shift of the whole strip. base_loss: share of the returns that are not detected on any
    surface. min_intensity: a weaker return is not detected (reflectance * cosine of incidence *
    (reference_range_m / range)^2 * normal speckle around 1). max_returns: of one pulse. separation_m: of two
    returns of one pulse, along the ray. key, loss_key, split_key: of the random draws.
    """

    noise_xy_m: float
    noise_z_m: float
    noise_range_m: float
    offset_x_m: float
    offset_y_m: float
    offset_z_m: float
    base_loss: float
    min_intensity: float
    speckle: float
    reference_range_m: float
    max_returns: int
    separation_m: float
    key: np.uint64
    loss_key: np.uint64
    split_key: np.uint64


class Points(NamedTuple):
    """Recorded points of one or more chunks, one row each.

    xyz_mm int32 (n, 3) in the local frame; intensity uint16; scan_angle int16, units of 0.006 degrees,
    positive to the right of the flight; pulse int64; strip uint16; return_number, num_returns uint8, from 1;
    building int32, -1 for terrain and trees; face int32, -1 for terrain, see :func:`surface.encode_face` and
    :func:`surface.encode_clutter`.
    """

    xyz_mm: np.ndarray
    intensity: np.ndarray
    scan_angle: np.ndarray
    pulse: np.ndarray
    strip: np.ndarray
    return_number: np.ndarray
    num_returns: np.ndarray
    building: np.ndarray
    face: np.ndarray


def empty_points(num_points: int) -> Points:
    """Arrays for ``num_points`` points, not initialised."""
    return Points(
        xyz_mm=np.empty((num_points, 3), np.int32),
        intensity=np.empty(num_points, np.uint16),
        scan_angle=np.empty(num_points, np.int16),
        pulse=np.empty(num_points, np.int64),
        strip=np.empty(num_points, np.uint16),
        return_number=np.empty(num_points, np.uint8),
        num_returns=np.empty(num_points, np.uint8),
        building=np.empty(num_points, np.int32),
        face=np.empty(num_points, np.int32),
    )


def grown(points: Points, num_used: int, room: int) -> Points:
    """A copy of the first ``num_used`` points in arrays with room for ``room`` points."""
    result = empty_points(room)
    for column, old in zip(result, points, strict=True):
        column[:num_used] = old[:num_used]
    return result


@entry
def record(
    origin: np.ndarray,
    direction: np.ndarray,
    advance_m: np.ndarray,
    pulse: np.ndarray,
    hits: Hits,
    split: np.ndarray,
    sub_direction: np.ndarray,
    sub_advance_m: np.ndarray,
    sub_hits: Hits,
    surface: Surface,
    path: StripPath,
    errors: Errors,
    strip: int,
    box: Box,
    quantile: np.ndarray,
    points: Points,
    outcome: np.ndarray,
) -> int:
    """Write the recorded points of one chunk into ``points``; returns their number.

    ``hits`` are those of the rays, ``sub_hits`` those of the further sub-beams of the rays ``split``, see
    :func:`beams.split_rays`. Only points over ``box`` are written. ``outcome``, int64 (4,), counts what
    becomes of the pulses, see :data:`OUTCOMES`.
    """
    # arrays are taken out of their tuples once: numba counts references each time
    hit_triangle, hit_m, hit_normal, hit_height = hits
    sub_triangle, _, sub_normal, sub_height = sub_hits
    reflectance, loss_of = surface.reflectance, surface.loss
    building_of, face_of = surface.building, surface.face
    xyz_mm, intensity, scan_angle, pulses, strips = points[:5]
    return_numbers, num_returns, buildings, faces = points[5:]
    sigma, reference_m = path.beam_sigma_rad, errors.reference_range_m
    n = 0
    heading_x, heading_y = cos(path.heading_rad), sin(path.heading_rad)
    num_split, next_split = len(split), 0
    # returns of one pulse: distance on the beam's axis, strength, and the triangle that gives the tags
    return_m, strengths = np.empty(SUB_BEAMS), np.empty(SUB_BEAMS)
    return_triangle = np.empty(SUB_BEAMS, np.int32)
    sub_beams = SubBeams(np.empty(SUB_BEAMS), np.empty(SUB_BEAMS), np.empty(SUB_BEAMS, np.int64))
    for k in range(len(pulse)):
        is_split = next_split < num_split and split[next_split] == k
        t = hit_m[k]
        if t < 0:
            outcome[NO_SURFACE] += 1
            continue
        ox, oy, oz = np.float64(origin[k, 0]), np.float64(origin[k, 1]), np.float64(origin[k, 2])
        dx, dy, dz = np.float64(direction[k, 0]), np.float64(direction[k, 1]), np.float64(direction[k, 2])
        number = np.uint64(pulse[k])
        advance = advance_m[k]
        strength = return_strength(
            hit_triangle[k], hit_normal, k, advance + t, dx, dy, dz, reflectance, reference_m
        )
        if sigma > 0:  # the point is recorded on the beam's axis, not on the sub-beam
            sx, sy, sz = to_axis(sigma, path.beam_key, pulse[k], dx, dy, dz, quantile)
            ox, oy, oz = ox + advance * sx, oy + advance * sy, oz + advance * sz
            dx, dy, dz = dx + sx, dy + sy, dz + sz

        num_candidates = 1
        if not is_split:
            return_m[0] = (
                axis_distance(hit_normal, hit_height, k, t, ox, oy, oz, dx, dy, dz) if sigma > 0 else t
            )
            strengths[0], return_triangle[0] = strength, hit_triangle[k]
        else:
            first_row = next_split * (SUB_BEAMS - 1)
            num_sub_beams = sort_sub_beams(
                t,
                strength,
                advance,
                first_row,
                first_row + SUB_BEAMS - 1,
                sub_direction,
                sub_advance_m,
                sub_hits,
                reflectance,
                reference_m,
                sub_beams,
            )
            next_split += 1
            num_candidates, end = 0, 0
            while end < num_sub_beams:
                end, row, middle, total = next_return(
                    end,
                    num_sub_beams,
                    sub_beams,
                    hit_triangle[k],
                    sub_triangle,
                    surface,
                    errors.separation_m,
                )
                if row < 0:
                    return_m[num_candidates] = axis_distance(
                        hit_normal, hit_height, k, middle, ox, oy, oz, dx, dy, dz
                    )
                else:
                    return_m[num_candidates] = axis_distance(
                        sub_normal, sub_height, row, middle, ox, oy, oz, dx, dy, dz
                    )
                return_triangle[num_candidates] = triangle_of(hit_triangle[k], sub_triangle, row)
                strengths[num_candidates] = total
                num_candidates += 1

        num_detected, start = 0, n
        for candidate in range(num_candidates):
            if num_detected == errors.max_returns:
                break
            draw = number + (np.uint64(candidate) << np.uint64(48))
            triangle = return_triangle[candidate]
            building, face, loss = np.int32(-1), np.int32(-1), errors.base_loss
            if triangle >= 0:
                building, face = building_of[triangle], face_of[triangle]
                loss = 1 - (1 - loss) * (1 - loss_of[triangle])
            power = strengths[candidate]
            if errors.min_intensity > 0 or loss > 0:
                bits = random_bits(errors.loss_key, draw)
                power *= 1 + errors.speckle * normal(bits, 0, quantile)
                if power < errors.min_intensity or uniform(bits) < loss:
                    continue
            num_detected += 1
            bits = random_bits(errors.key, draw)
            t = return_m[candidate] + errors.noise_range_m * normal(bits, 3, quantile)
            px = ox + t * dx + errors.offset_x_m + errors.noise_xy_m * normal(bits, 0, quantile)
            py = oy + t * dy + errors.offset_y_m + errors.noise_xy_m * normal(bits, 1, quantile)
            pz = oz + t * dz + errors.offset_z_m + errors.noise_z_m * normal(bits, 2, quantile)
            if not (box.x_min_m <= px < box.x_max_m and box.y_min_m <= py < box.y_max_m):
                continue
            xyz_mm[n, 0] = np.int32(np.rint(1000 * px))
            xyz_mm[n, 1] = np.int32(np.rint(1000 * py))
            xyz_mm[n, 2] = np.int32(np.rint(1000 * pz))
            intensity[n] = np.uint16(min(max(power, 0.0) * _FULL_SCALE, 65535.0))
            right = heading_y * dx - heading_x * dy
            scan_angle[n] = np.int16(np.rint(_arctan(-right / dz) * _PER_RAD))
            pulses[n] = pulse[k]
            strips[n] = np.uint16(strip)
            return_numbers[n] = np.uint8(num_detected)
            buildings[n] = building
            faces[n] = face
            n += 1
        for row in range(start, n):
            num_returns[row] = np.uint8(num_detected)
        outcome[RECORDED if n > start else OUTSIDE if num_detected else LOST] += 1
    return n


@inlined
def _arctan(x: float) -> float:
    """Arc tangent to 1e-5 (Abramowitz, Stegun 1964, 4.4.49), a tenth of a scan angle's unit."""
    y = 1 / x if abs(x) > 1 else x
    q = y * y
    angle = y * (0.9998660 + q * (-0.3302995 + q * (0.1801410 + q * (-0.0851330 + q * 0.0208351))))
    if abs(x) > 1:
        return (pi / 2 if x > 0 else -pi / 2) - angle
    return angle


class PointCounts(NamedTuple):
    """Numbers of points by what they lie on, of the points in a rectangle, and of the first returns there."""

    ground: int
    walls: int
    roofs: int
    trees: int
    other_clutter: int
    in_rectangle: int
    first_in_rectangle: int


def count_points(points: Points, low_mm: np.ndarray, high_mm: np.ndarray) -> PointCounts:
    """Count the points. The rectangle is from ``low_mm`` to ``high_mm``, each (2,), which is excluded."""
    return PointCounts(*_counts(points, low_mm, high_mm).tolist())


@entry
def _counts(points: Points, low_mm: np.ndarray, high_mm: np.ndarray) -> np.ndarray:
    """The numbers of :class:`PointCounts`, int64 (7,)."""
    result = np.zeros(7, np.int64)
    xyz, building, face, number = points.xyz_mm, points.building, points.face, points.return_number
    for i in range(len(face)):
        kind = face[i] & 3
        if face[i] < 0:
            result[0] += 1
        elif building[i] < 0:
            result[3] += 1
        elif kind == _WALL:
            result[1] += 1
        elif kind == CLUTTER_KIND:
            result[4] += 1
        else:
            result[2] += 1
        x, y = xyz[i, 0], xyz[i, 1]
        if low_mm[0] <= x < high_mm[0] and low_mm[1] <= y < high_mm[1]:
            result[5] += 1
            result[6] += number[i] == 1
    return result
