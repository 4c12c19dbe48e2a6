"""From hits to recorded points: what the sensor detects, noise, and the tags of the points.

One ray stands for each beam, drawn within its divergence. The sensor records a range on the axis of the beam.
"""

from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from p2wss.scans.hits import Hits, ray_of
from p2wss.scans.pulses import Box, Rays, StripPath
from p2wss.scans.randomness import normal, random_bits, uniform
from p2wss.scans.surface import TERRAIN_REFLECTANCE, Surface
from p2wss.scans.terrain import Ray
from p2wss.skeleton.compiled import entry, inlined

# what becomes of a pulse
RECORDED, NO_SURFACE, OUTSIDE, LOST = range(4)
OUTCOMES = ("recorded", "no_surface", "outside", "lost")

_PER_RAD = 180 / pi / 0.006  # LAS 1.4, scan angle
_FULL_SCALE = 40_000.0  # intensity of a white surface seen head-on from the planned altitude
# if the surfaces under the beam's axis and under the ray that was cast are further apart than this, the return keeps
# the ray's range, as a mixed point at an edge; elsewhere the footprint of the beam averages out
_SAME_SURFACE_M = 0.25


class Errors(NamedTuple):
    """How one strip's sensor departs from a perfect one.

    Standard deviations: noise_xy_m and noise_z_m along the axes of the frame, noise_range_m along the ray.
    offset_*_m: shift of the whole strip. base_loss: share of the returns that are not detected on any
    surface. min_intensity: a weaker return is not detected (reflectance * cosine of incidence *
    (reference_range_m / range)^2 * normal speckle around 1). key, loss_key: of the random draws.
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
    key: np.uint64
    loss_key: np.uint64


class Points(NamedTuple):
    """Recorded points of one or more chunks, one row each.

    xyz_mm int32 (n, 3) in the local frame; intensity uint16; scan_angle int16, units of 0.006 degrees,
    positive to the right of the flight; pulse int64; strip uint16; building int32, -1 for terrain and trees; face
    int32, -1 for terrain, see :func:`surface.encode_face` and :class:`surface.ClutterKind`.
    """

    xyz_mm: np.ndarray
    intensity: np.ndarray
    scan_angle: np.ndarray
    pulse: np.ndarray
    strip: np.ndarray
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
        building=np.empty(num_points, np.int32),
        face=np.empty(num_points, np.int32),
    )


@entry
def record(
    rays: Rays, hits: Hits, surface: Surface, path: StripPath, errors: Errors, box: Box, points: Points
) -> tuple[int, np.ndarray]:
    """Write the recorded points of one chunk over ``box`` into ``points``, which has room for all rays.

    Returns their number, and how many pulses have each outcome, int64 (4,), see :data:`OUTCOMES`.
    """
    # arrays are taken out of their tuples once: numba counts references each time
    origin, direction, advance_m, pulse = rays
    hit_triangle, hit_m, hit_normal, hit_height = hits
    reflectance_of, loss_of = surface.reflectance, surface.loss
    building_of, face_of = surface.building, surface.face
    xyz_mm, intensity, scan_angle, pulses, strips, buildings, faces = points
    quantile = path.quantile
    heading_x, heading_y = cos(path.heading_rad), sin(path.heading_rad)
    n = 0
    outcome = np.zeros(len(OUTCOMES), np.int64)
    for k in range(len(pulse)):
        t, triangle = hit_m[k], hit_triangle[k]
        if t < 0:
            outcome[NO_SURFACE] += 1
            continue
        ray, number = ray_of(origin, direction, k), np.uint64(pulse[k])
        building, face, loss, reflectance = np.int32(-1), np.int32(-1), errors.base_loss, TERRAIN_REFLECTANCE
        if triangle >= 0:
            building, face = building_of[triangle], face_of[triangle]
            loss = 1 - (1 - loss) * (1 - loss_of[triangle])
            reflectance = np.float64(reflectance_of[triangle])
        plane_normal = hit_normal[k, 0], hit_normal[k, 1], hit_normal[k, 2]
        incidence = abs(plane_normal[0] * ray.dx + plane_normal[1] * ray.dy + plane_normal[2] * ray.dz)
        scale = errors.reference_range_m / (advance_m[k] + t)
        power = reflectance * incidence * scale * scale
        if path.beam_sigma_rad > 0:  # the point is recorded on the beam's axis, not on the ray
            ray = _axis(path, number, ray, advance_m[k], quantile)
            t = _axis_distance(plane_normal, hit_height[k], t, ray)
        if errors.min_intensity > 0 or loss > 0:
            bits = random_bits(errors.loss_key, number)
            power *= 1 + errors.speckle * normal(bits, 0, quantile)
            if power < errors.min_intensity or uniform(bits) < loss:
                outcome[LOST] += 1
                continue
        bits = random_bits(errors.key, number)
        t += errors.noise_range_m * normal(bits, 3, quantile)
        px = ray.x + t * ray.dx + errors.offset_x_m + errors.noise_xy_m * normal(bits, 0, quantile)
        py = ray.y + t * ray.dy + errors.offset_y_m + errors.noise_xy_m * normal(bits, 1, quantile)
        pz = ray.z + t * ray.dz + errors.offset_z_m + errors.noise_z_m * normal(bits, 2, quantile)
        if not (box.x_min_m <= px < box.x_max_m and box.y_min_m <= py < box.y_max_m):
            outcome[OUTSIDE] += 1
            continue
        xyz_mm[n, 0] = np.int32(np.rint(1000 * px))
        xyz_mm[n, 1] = np.int32(np.rint(1000 * py))
        xyz_mm[n, 2] = np.int32(np.rint(1000 * pz))
        intensity[n] = np.uint16(min(max(power, 0.0) * _FULL_SCALE, 65535.0))
        right = heading_y * ray.dx - heading_x * ray.dy
        scan_angle[n] = np.int16(np.rint(_arctan(-right / ray.dz) * _PER_RAD))
        pulses[n], strips[n] = pulse[k], np.uint16(path.number)
        buildings[n], faces[n] = building, face
        outcome[RECORDED] += 1
        n += 1
    return n, outcome


@inlined
def _axis(path: StripPath, pulse: np.uint64, ray: Ray, advance_m: float, quantile: np.ndarray) -> Ray:
    """The axis of a pulse's beam. ``ray`` stands for the beam and starts ``advance_m`` from the aircraft; so does the
    axis."""
    bits = random_bits(path.beam_key, pulse)
    jx = path.beam_sigma_rad * normal(bits, 0, quantile)
    jy = path.beam_sigma_rad * normal(bits, 1, quantile)
    jz = path.beam_sigma_rad * normal(bits, 2, quantile)
    along = jx * ray.dx + jy * ray.dy + jz * ray.dz
    sx, sy, sz = along * ray.dx - jx, along * ray.dy - jy, along * ray.dz - jz
    return Ray(
        ray.x + advance_m * sx, ray.y + advance_m * sy, ray.z + advance_m * sz,
        ray.dx + sx, ray.dy + sy, ray.dz + sz,
    )  # fmt: skip


@inlined
def _axis_distance(normal: tuple[float, float, float], height_m: float, t: float, axis: Ray) -> float:
    """Distance at which the beam's axis meets the plane of the surface that the ray met at distance ``t``; ``t`` itself
    if the two distances differ by :data:`_SAME_SURFACE_M` or more."""
    nx, ny, nz = normal
    slope = nx * axis.dx + ny * axis.dy + nz * axis.dz
    if slope != 0.0:
        axis_t = (height_m - nx * axis.x - ny * axis.y - nz * axis.z) / slope
        if abs(axis_t - t) < _SAME_SURFACE_M:
            return axis_t
    return t


@inlined
def _arctan(x: float) -> float:
    """Arc tangent to 1e-5 (Abramowitz, Stegun 1964, 4.4.49), a tenth of a scan angle's unit."""
    y = 1 / x if abs(x) > 1 else x
    q = y * y
    angle = y * (0.9998660 + q * (-0.3302995 + q * (0.1801410 + q * (-0.0851330 + q * 0.0208351))))
    if abs(x) > 1:
        return (pi / 2 if x > 0 else -pi / 2) - angle
    return angle
