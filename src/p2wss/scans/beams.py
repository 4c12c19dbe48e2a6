"""The width of a beam: sub-beams within its divergence, and the returns that they give together.

One sub-beam of each pulse is cast; a pulse near an edge is split into :data:`SUB_BEAMS`. The sensor records a
range on the axis of the beam, whichever sub-beam returned.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from p2wss.scans.hits import Hits
from p2wss.scans.pulses import BLOCK_PULSES, StripPath
from p2wss.scans.randomness import normal, random_bits
from p2wss.scans.surface import TERRAIN_REFLECTANCE, Surface
from p2wss.skeleton.compiled import entry, inlined, inner

SUB_BEAMS = 5  # of a pulse near an edge, where several returns are wanted
# where the surfaces under the beam's axis and under the sub-beam that was cast are further apart than this,
# the return keeps the sub-beam's range: a mixed point at an edge; elsewhere the footprint averages out
_SAME_SURFACE_M = 0.25


class SubBeams(NamedTuple):
    """Sub-beams of one pulse, in the order of their ranges; room for :data:`SUB_BEAMS` of them.

    distance_m: float64, from the ray's origin. strength: float64, see :func:`return_strength`. row: int64,
    row among all sub-beams, -1 for the ray itself.
    """

    distance_m: np.ndarray
    strength: np.ndarray
    row: np.ndarray


def empty_sub_beams(num_rays: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arrays for the further sub-beams of ``num_rays`` split rays: origin, direction, advance_m."""
    room = num_rays * (SUB_BEAMS - 1)
    return np.empty((room, 3), np.float32), np.empty((room, 3), np.float32), np.empty(room)


@entry
def rays_to_split(
    origin: np.ndarray,
    direction: np.ndarray,
    pulse: np.ndarray,
    hits: Hits,
    surface: Surface,
    separation_m: float,
) -> np.ndarray:
    """Indices of the rays that may give several returns, int64 ascending.

    Those on a porous triangle (see :class:`surface.Surface`), and those from whose plane the point of the
    next or the previous pulse is further than half of ``separation_m``. Only pulses of one block are
    compared: a block is never divided among chunks, so the result does not depend on the chunks.
    """
    split = np.empty(len(pulse), np.int64)
    n = 0
    for k in range(len(pulse)):
        if hits.distance_m[k] < 0:
            continue
        triangle = hits.triangle[k]
        at_edge = triangle >= 0 and surface.porous[triangle]
        for other in (k - 1, k + 1):
            if (
                not at_edge
                and 0 <= other < len(pulse)
                and pulse[other] // BLOCK_PULSES == pulse[k] // BLOCK_PULSES
                and hits.distance_m[other] >= 0
            ):
                away_m = -hits.height_m[k]
                for axis in range(3):
                    at = origin[other, axis] + hits.distance_m[other] * direction[other, axis]
                    away_m += hits.normal[k, axis] * at
                at_edge = abs(away_m) > 0.5 * separation_m
        if at_edge:
            split[n] = k
            n += 1
    return split[:n].copy()


@entry
def split_rays(
    origin: np.ndarray,
    direction: np.ndarray,
    advance_m: np.ndarray,
    pulse: np.ndarray,
    split: np.ndarray,
    path: StripPath,
    key: np.uint64,
    quantile: np.ndarray,
    sub_origin: np.ndarray,
    sub_direction: np.ndarray,
    sub_advance_m: np.ndarray,
) -> None:
    """Fill in the further sub-beams of the rays ``split``: those of ray ``split[s]`` begin at row
    ``s * (SUB_BEAMS - 1)``."""
    row = 0
    for k in split:
        top = np.float64(origin[k, 2])
        dx, dy, dz = np.float64(direction[k, 0]), np.float64(direction[k, 1]), np.float64(direction[k, 2])
        sx, sy, sz = to_axis(path.beam_sigma_rad, path.beam_key, pulse[k], dx, dy, dz, quantile)
        px = np.float64(origin[k, 0]) - advance_m[k] * dx
        py = np.float64(origin[k, 1]) - advance_m[k] * dy
        pz = top - advance_m[k] * dz
        for sub in range(SUB_BEAMS - 1):
            bits = random_bits(key, np.uint64(pulse[k] * SUB_BEAMS + sub))
            x = dx + sx + path.beam_sigma_rad * normal(bits, 0, quantile)
            y = dy + sy + path.beam_sigma_rad * normal(bits, 1, quantile)
            z = dz + sz + path.beam_sigma_rad * normal(bits, 2, quantile)
            length = 1 / sqrt(x * x + y * y + z * z)
            x, y, z = x * length, y * length, z * length
            advance = (top - pz) / z
            sub_origin[row, 0], sub_origin[row, 1], sub_origin[row, 2] = (
                px + advance * x,
                py + advance * y,
                top,
            )
            sub_direction[row, 0], sub_direction[row, 1], sub_direction[row, 2] = x, y, z
            sub_advance_m[row] = advance
            row += 1


@inlined
def to_axis(
    sigma: float, key: np.uint64, pulse: int, dx: float, dy: float, dz: float, quantile: np.ndarray
) -> tuple[float, float, float]:
    """What to add to the direction of a pulse's first sub-beam to get the axis of its beam."""
    bits = random_bits(key, np.uint64(pulse))
    jx = sigma * normal(bits, 0, quantile)
    jy = sigma * normal(bits, 1, quantile)
    jz = sigma * normal(bits, 2, quantile)
    along = jx * dx + jy * dy + jz * dz
    return along * dx - jx, along * dy - jy, along * dz - jz


@inlined
def return_strength(
    triangle: int,
    normal: np.ndarray,
    k: int,
    range_m: float,
    dx: float, dy: float, dz: float,
    reflectance_of: np.ndarray,
    reference_range_m: float,
) -> float:  # fmt: skip
    """Strength of the return of a whole beam: reflectance * cosine of incidence *
    (reference range / range)^2."""
    reflectance = np.float64(reflectance_of[triangle]) if triangle >= 0 else TERRAIN_REFLECTANCE
    incidence = abs(normal[k, 0] * dx + normal[k, 1] * dy + normal[k, 2] * dz)
    scale = reference_range_m / range_m
    return reflectance * incidence * scale * scale


@inlined
def axis_distance(
    normal: np.ndarray,
    height_m: np.ndarray,
    k: int,
    t: float,
    ox: float, oy: float, oz: float,
    dx: float, dy: float, dz: float,
) -> float:  # fmt: skip
    """Where the beam's axis meets the plane that a sub-beam met at ``t``, or ``t`` where the two are
    further apart than :data:`_SAME_SURFACE_M`."""
    nx, ny, nz = normal[k, 0], normal[k, 1], normal[k, 2]
    slope = nx * dx + ny * dy + nz * dz
    if slope != 0.0:
        axis_t = (height_m[k] - nx * ox - ny * oy - nz * oz) / slope
        if abs(axis_t - t) < _SAME_SURFACE_M:
            return axis_t
    return t


@inner
def sort_sub_beams(
    ray_m: float,
    ray_strength: float,
    advance_m: float,
    first_row: int,
    last_row: int,
    sub_direction: np.ndarray,
    sub_advance_m: np.ndarray,
    sub_hits: Hits,
    reflectance: np.ndarray,
    reference_range_m: float,
    result: SubBeams,
) -> int:
    """Write the sub-beams of a split pulse that hit something into ``result``; returns their number.

    The ray itself hits at ``ray_m`` with the strength of a whole beam; its further sub-beams are the rows
    from ``first_row`` to ``last_row``, which is excluded. Each has an equal share of the energy.
    """
    distance_m, strength, row = result
    distance_m[0], strength[0], row[0] = ray_m, ray_strength / SUB_BEAMS, -1
    n = 1
    for sub in range(first_row, last_row):
        if sub_hits.distance_m[sub] < 0:
            continue
        range_m = sub_advance_m[sub] + sub_hits.distance_m[sub]
        x, y, z = sub_direction[sub, 0], sub_direction[sub, 1], sub_direction[sub, 2]
        share = (
            return_strength(
                sub_hits.triangle[sub], sub_hits.normal, sub, range_m, x, y, z, reflectance, reference_range_m
            )
            / SUB_BEAMS
        )
        place = n
        while place > 0 and distance_m[place - 1] > range_m - advance_m:
            distance_m[place], strength[place] = distance_m[place - 1], strength[place - 1]
            row[place] = row[place - 1]
            place -= 1
        distance_m[place], strength[place], row[place] = range_m - advance_m, share, sub
        n += 1
    return n


@inner
def next_return(
    first: int,
    num_sub_beams: int,
    sub_beams: SubBeams,
    ray_triangle: int,
    sub_triangle: np.ndarray,
    surface: Surface,
    separation_m: float,
) -> tuple[int, int, float, float]:
    """The sub-beams from ``first`` on that the sensor cannot tell apart: one return.

    These are a run without a gap of ``separation_m``; a face that the beam meets at a slant gives one long
    return. Returns (end of the run, row of the strongest sub-beam, mean distance, strength).
    """
    distance_m, strength, row = sub_beams
    total, mean, best, end = 0.0, 0.0, first, first
    while end < num_sub_beams and (
        end == first
        or distance_m[end] - distance_m[end - 1] < separation_m
        or _same_face(
            surface,
            triangle_of(ray_triangle, sub_triangle, row[end]),
            triangle_of(ray_triangle, sub_triangle, row[end - 1]),
        )
    ):
        total += strength[end]
        mean += strength[end] * distance_m[end]
        if strength[end] > strength[best]:
            best = end
        end += 1
    return end, row[best], mean / total if total > 0 else distance_m[best], total


@inlined
def triangle_of(ray_triangle: int, sub_triangle: np.ndarray, row: int) -> int:
    """Triangle that sub-beam ``row`` hit, or ``ray_triangle`` for -1, the ray itself."""
    return ray_triangle if row < 0 else sub_triangle[row]


@inlined
def _same_face(surface: Surface, a: int, b: int) -> bool:
    """Whether two triangles (-1: the terrain) belong to one face; every leaf is a face of its own."""
    if a == b or a < 0 or b < 0:
        return a == b
    same = surface.building[a] == surface.building[b] and surface.face[a] == surface.face[b]
    return same and not surface.porous[a]
