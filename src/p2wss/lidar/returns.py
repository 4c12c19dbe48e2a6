"""From a hit triangle to a recorded point: exact position, detection, noise, tags.

Embree answers in float32 and, rarely, wrongly (near-parallel rays on thin triangles); so it is only asked
which triangle a ray meets first. The point is computed here in float64 and must lie on that triangle, which
also makes the points equal on machines whose Embree rounds differently.
"""

from __future__ import annotations

from math import atan, cos, sin, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from p2wss.lidar.pulses import Box, StripPath
from p2wss.lidar.randomness import normal, random_bits, uniform
from p2wss.lidar.surface import TERRAIN_REFLECTANCE, Surface
from p2wss.lidar.terrain import first_crossing

# counts of the pulses that were cast, by what became of them
RECORDED, NO_SURFACE, OUTSIDE, LOST = range(4)
OUTCOMES = ("recorded", "no_surface", "outside", "lost")

_ON_TRIANGLE_M = 0.005
# where the surfaces under the beam's axis and under the sub-beam that was cast are further apart than this,
# the echo keeps the sub-beam's range: a mixed point at an edge; elsewhere the footprint averages out
_SAME_SURFACE_M = 0.25
_FULL_SCALE = 40_000.0  # intensity of a white surface seen head-on from the planned altitude


class Errors(NamedTuple):
    """What separates a recorded point from the true one, for one strip.

    Standard deviations: noise_xy_m and noise_z_m in world axes, noise_range_m along the ray. offset_*_m:
    shift of the whole strip. base_loss: share of pulses lost anywhere. min_intensity: echoes below it
    (reflectance * cosine of incidence * (reference_range_m / range)^2 * log-normal speckle) are lost. key:
    of the random draws.
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
    positive to the right of the flight; pulse int64; strip uint16; building int32, -1 for terrain; face
    int32, see :func:`surface.encode_face`, -1 for terrain.
    """

    xyz_mm: np.ndarray
    intensity: np.ndarray
    scan_angle: np.ndarray
    pulse: np.ndarray
    strip: np.ndarray
    building: np.ndarray
    face: np.ndarray


@njit(cache=True, nogil=True)
def record(
    origin: np.ndarray,
    direction: np.ndarray,
    advance_m: np.ndarray,
    pulse: np.ndarray,
    hit: np.ndarray,
    surface: Surface,
    path: StripPath,
    errors: Errors,
    strip: int,
    keep: Box,
    quantile: np.ndarray,
    points: Points,
    outcome: np.ndarray,
) -> int:
    """Write the recorded points of one chunk into ``points`` and return how many there are.

    ``hit`` int32 (n,) is the building's triangle that each ray meets first, or -1. Only points over ``keep``
    are written. ``outcome`` int64 (4,) counts what became of the pulses, see :data:`OUTCOMES`.
    """
    n = 0
    heading_x, heading_y = cos(path.heading_rad), sin(path.heading_rad)
    for k in range(len(hit)):
        ox, oy, oz = np.float64(origin[k, 0]), np.float64(origin[k, 1]), np.float64(origin[k, 2])
        dx, dy, dz = np.float64(direction[k, 0]), np.float64(direction[k, 1]), np.float64(direction[k, 2])
        triangle = hit[k]
        t, nx, ny, nz, height = _on_triangle(surface, triangle, ox, oy, oz, dx, dy, dz)
        if t < 0:
            triangle = -1
        ground_t, east, north = first_crossing(
            surface.terrain, ox, oy, oz, dx, dy, dz, t if t >= 0 else np.inf
        )
        if ground_t >= 0:
            triangle, t = -1, ground_t
            nz = 1 / sqrt(1 + east * east + north * north)
            nx, ny = -east * nz, -north * nz
            height = nx * (ox + t * dx) + ny * (oy + t * dy) + nz * (oz + t * dz)
        if t < 0:
            outcome[NO_SURFACE] += 1
            continue

        number = np.uint64(pulse[k])
        reach = advance_m[k] + t
        incidence = abs(nx * dx + ny * dy + nz * dz)
        if path.beam_sigma_rad > 0:  # the point is recorded on the beam's axis, not on the sub-beam
            bits = random_bits(path.beam_key, number)
            jx = path.beam_sigma_rad * normal(bits, 0, quantile)
            jy = path.beam_sigma_rad * normal(bits, 1, quantile)
            jz = path.beam_sigma_rad * normal(bits, 2, quantile)
            along = jx * dx + jy * dy + jz * dz
            sx, sy, sz = -(jx - along * dx), -(jy - along * dy), -(jz - along * dz)
            ox, oy, oz = ox + advance_m[k] * sx, oy + advance_m[k] * sy, oz + advance_m[k] * sz
            dx, dy, dz = dx + sx, dy + sy, dz + sz
            axis_slope = nx * dx + ny * dy + nz * dz
            if axis_slope != 0.0:
                axis_t = (height - nx * ox - ny * oy - nz * oz) / axis_slope
                if abs(axis_t - t) < _SAME_SURFACE_M:
                    t = axis_t

        building, face = np.int32(-1), np.int32(-1)
        reflectance, loss = TERRAIN_REFLECTANCE, errors.base_loss
        if triangle >= 0:
            building, face = surface.building[triangle], surface.face[triangle]
            reflectance = np.float64(surface.reflectance[triangle])
            if errors.min_intensity > 0:
                loss = 1 - (1 - loss) * (1 - surface.loss[triangle])
        strength = reflectance * incidence * (errors.reference_range_m / reach) ** 2
        if errors.min_intensity > 0 or loss > 0:
            bits = random_bits(errors.loss_key, number)
            strength *= 1 + errors.speckle * normal(bits, 0, quantile)
            if strength < errors.min_intensity or uniform(bits) < loss:
                outcome[LOST] += 1
                continue

        bits = random_bits(errors.key, number)
        t += errors.noise_range_m * normal(bits, 3, quantile)
        px = ox + t * dx + errors.offset_x_m + errors.noise_xy_m * normal(bits, 0, quantile)
        py = oy + t * dy + errors.offset_y_m + errors.noise_xy_m * normal(bits, 1, quantile)
        pz = oz + t * dz + errors.offset_z_m + errors.noise_z_m * normal(bits, 2, quantile)
        if not (keep.x_min_m <= px < keep.x_max_m and keep.y_min_m <= py < keep.y_max_m):
            outcome[OUTSIDE] += 1
            continue
        outcome[RECORDED] += 1
        points.xyz_mm[n, 0] = np.int32(np.rint(1000 * px))
        points.xyz_mm[n, 1] = np.int32(np.rint(1000 * py))
        points.xyz_mm[n, 2] = np.int32(np.rint(1000 * pz))
        points.intensity[n] = np.uint16(min(max(strength, 0.0) * _FULL_SCALE, 65535.0))
        right = heading_y * dx - heading_x * dy
        points.scan_angle[n] = np.int16(np.rint(atan(-right / dz) * 57.29577951308232 / 0.006))
        points.pulse[n] = pulse[k]
        points.strip[n] = np.uint16(strip)
        points.building[n] = building
        points.face[n] = face
        n += 1
    return n


@njit(cache=True, nogil=True, inline="always")
def _on_triangle(
    surface: Surface, triangle: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, float, float, float, float]:
    """Distance to a building's triangle, its unit normal and its plane's distance from the origin.

    The distance is -1 if there is no triangle, or if the ray passes it by: then Embree was wrong.
    """
    if triangle < 0:
        return -1.0, 0.0, 0.0, 0.0, 0.0
    vertex = surface.vertex_m
    i0, i1, i2 = surface.triangle[triangle, 0], surface.triangle[triangle, 1], surface.triangle[triangle, 2]
    ax, ay, az = vertex[i0, 0], vertex[i0, 1], vertex[i0, 2]
    bx, by, bz = vertex[i1, 0], vertex[i1, 1], vertex[i1, 2]
    cx, cy, cz = vertex[i2, 0], vertex[i2, 1], vertex[i2, 2]
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = sqrt(nx * nx + ny * ny + nz * nz)
    slope = nx * dx + ny * dy + nz * dz
    if slope == 0.0:
        return -1.0, 0.0, 0.0, 0.0, 0.0
    t = (nx * (ax - ox) + ny * (ay - oy) + nz * (az - oz)) / slope
    px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
    nx, ny, nz = nx / length, ny / length, nz / length
    if not (
        _inside_edge(ax, ay, az, ux, uy, uz, nx, ny, nz, px, py, pz)
        and _inside_edge(bx, by, bz, cx - bx, cy - by, cz - bz, nx, ny, nz, px, py, pz)
        and _inside_edge(cx, cy, cz, -vx, -vy, -vz, nx, ny, nz, px, py, pz)
    ):
        return -1.0, 0.0, 0.0, 0.0, 0.0
    return t, nx, ny, nz, nx * ax + ny * ay + nz * az


@njit(cache=True, nogil=True, inline="always")
def _inside_edge(
    ax: float, ay: float, az: float,
    ex: float, ey: float, ez: float,
    nx: float, ny: float, nz: float,
    px: float, py: float, pz: float,
) -> bool:  # fmt: skip
    """True if p is on the inner side of the edge from a along e, or within :data:`_ON_TRIANGLE_M` of it."""
    qx, qy, qz = px - ax, py - ay, pz - az
    side = nx * (ey * qz - ez * qy) + ny * (ez * qx - ex * qz) + nz * (ex * qy - ey * qx)
    return side >= 0 or side * side <= _ON_TRIANGLE_M**2 * (ex * ex + ey * ey + ez * ez)
