"""From a hit triangle to recorded points: exact position, echoes, detection, noise, tags.

Embree answers in float32 and, rarely, wrongly (near-parallel rays on thin triangles); so it is only asked
which triangle a ray meets first. The point is computed here in float64 and must lie on that triangle, which
also makes the points equal on machines whose Embree rounds differently.
"""

from __future__ import annotations

from math import cos, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from p2wss.scans.pulses import BLOCK_PULSES, Box, StripPath
from p2wss.scans.randomness import normal, random_bits, uniform
from p2wss.scans.surface import TERRAIN_REFLECTANCE, THING_KIND, Surface
from p2wss.scans.terrain import crossing, frame_of
from p2wss.skeleton.compiled import entry, inlined
from p2wss.skeleton.types import FaceKind

# counts of the pulses that were cast, by what became of them
RECORDED, NO_SURFACE, OUTSIDE, LOST = range(4)
OUTCOMES = ("recorded", "no_surface", "outside", "lost")

_WALL = int(FaceKind.WALL)
SUB_BEAMS = 5  # of a pulse near an edge, where several echoes are wanted
_ON_TRIANGLE_M = 0.005
# where the surfaces under the beam's axis and under the sub-beam that was cast are further apart than this,
# the echo keeps the sub-beam's range: a mixed point at an edge; elsewhere the footprint averages out
_SAME_SURFACE_M = 0.25
_PER_RAD = 180 / pi / 0.006  # LAS 1.4, scan angle
_FULL_SCALE = 40_000.0  # intensity of a white surface seen head-on from the planned altitude


class Errors(NamedTuple):
    """What separates a recorded point from the true one, for one strip.

    Standard deviations: noise_xy_m and noise_z_m in world axes, noise_range_m along the ray. offset_*_m:
    shift of the whole strip. base_loss: share of pulses lost anywhere. min_intensity: echoes below it
    (reflectance * cosine of incidence * (reference_range_m / range)^2 * normal speckle around 1) are lost.
    max_returns: echoes that a pulse may have; separation_m: of two of them. key: of the random draws.
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


class Hits(NamedTuple):
    """What n rays meet first.

    triangle int32 (n,), -1 for the terrain. distance_m float64 (n,) from the ray's origin, -1 if the ray
    meets nothing. normal float64 (n, 3), unit. height_m float64 (n,): distance of the surface's plane from
    the frame's origin along the normal.
    """

    triangle: np.ndarray
    distance_m: np.ndarray
    normal: np.ndarray
    height_m: np.ndarray


class Points(NamedTuple):
    """Recorded points of one or more chunks, one row each.

    xyz_mm int32 (n, 3) in the local frame; intensity uint16; scan_angle int16, units of 0.006 degrees,
    positive to the right of the flight; pulse int64; strip uint16; return_number, num_returns uint8, from 1;
    building int32, -1 for terrain and trees; face int32, see :func:`surface.encode_face`, -1 for terrain.
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


@entry
def locate(origin: np.ndarray, direction: np.ndarray, hit: np.ndarray, surface: Surface, found: Hits) -> None:
    """Fill in ``found``: the exact first hit of each ray on the triangle ``hit`` (int32 (n,), -1 none) or the
    terrain."""
    grid, vertex, triangles = surface.terrain, surface.vertex_m, surface.triangle
    frame, height, blocks, regions = frame_of(grid), grid.height_m, grid.block_range_m, grid.region_range_m
    found_triangle, found_m, found_normal, found_height = found
    for k in range(len(hit)):
        ox, oy, oz = np.float64(origin[k, 0]), np.float64(origin[k, 1]), np.float64(origin[k, 2])
        dx, dy, dz = np.float64(direction[k, 0]), np.float64(direction[k, 1]), np.float64(direction[k, 2])
        triangle = hit[k]
        t, nx, ny, nz, offset = _on_triangle(vertex, triangles, triangle, ox, oy, oz, dx, dy, dz)
        if t < 0:
            triangle = -1
        ground_t, east, north = crossing(
            frame, height, blocks, regions, ox, oy, oz, dx, dy, dz, t if t >= 0 else np.inf
        )
        if ground_t >= 0:
            triangle, t = -1, ground_t
            nz = 1 / sqrt(1 + east * east + north * north)
            nx, ny = -east * nz, -north * nz
            offset = nx * (ox + t * dx) + ny * (oy + t * dy) + nz * (oz + t * dz)
        found_triangle[k], found_m[k], found_height[k] = triangle, t, offset
        found_normal[k, 0], found_normal[k, 1], found_normal[k, 2] = nx, ny, nz


@entry
def near_edges(
    origin: np.ndarray,
    direction: np.ndarray,
    pulse: np.ndarray,
    found: Hits,
    surface: Surface,
    separation_m: float,
) -> np.ndarray:
    """Pulses that may have several echoes, int64 ascending.

    Those on a surface of :attr:`Surface.porous`, and those from whose plane the point of the next or the
    previous pulse is further than half of ``separation_m``. Only pulses of one block are compared: blocks
    are never cut, so the choice does not depend on the chunk.
    """
    chosen = np.empty(len(pulse), np.int64)
    n = 0
    for k in range(len(pulse)):
        if found.distance_m[k] < 0:
            continue
        triangle = found.triangle[k]
        wanted = triangle >= 0 and surface.porous[triangle]
        for other in (k - 1, k + 1):
            if (
                not wanted
                and 0 <= other < len(pulse)
                and pulse[other] // BLOCK_PULSES == pulse[k] // BLOCK_PULSES
                and found.distance_m[other] >= 0
            ):
                away_m = -found.height_m[k]
                for axis in range(3):
                    at = origin[other, axis] + found.distance_m[other] * direction[other, axis]
                    away_m += found.normal[k, axis] * at
                wanted = abs(away_m) > 0.5 * separation_m
        if wanted:
            chosen[n] = k
            n += 1
    return chosen[:n].copy()


@entry
def split(
    origin: np.ndarray,
    direction: np.ndarray,
    advance_m: np.ndarray,
    pulse: np.ndarray,
    chosen: np.ndarray,
    path: StripPath,
    key: np.uint64,
    quantile: np.ndarray,
    sub_origin: np.ndarray,
    sub_direction: np.ndarray,
    sub_advance_m: np.ndarray,
) -> None:
    """More sub-beams of the ``chosen`` rays: rays c * (SUB_BEAMS - 1) and following are those of ray
    ``chosen[c]``."""
    row = 0
    for k in chosen:
        top = np.float64(origin[k, 2])
        dx, dy, dz = np.float64(direction[k, 0]), np.float64(direction[k, 1]), np.float64(direction[k, 2])
        sx, sy, sz = _to_axis(path.beam_sigma_rad, path.beam_key, pulse[k], dx, dy, dz, quantile)
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
def _to_axis(
    sigma: float, key: np.uint64, pulse: int, dx: float, dy: float, dz: float, quantile: np.ndarray
) -> tuple[float, float, float]:
    """What, added to the direction of a pulse's first sub-beam, gives the axis of its beam."""
    bits = random_bits(key, np.uint64(pulse))
    jx = sigma * normal(bits, 0, quantile)
    jy = sigma * normal(bits, 1, quantile)
    jz = sigma * normal(bits, 2, quantile)
    along = jx * dx + jy * dy + jz * dz
    return along * dx - jx, along * dy - jy, along * dz - jz


@inlined
def _strength(
    triangle: int,
    normal: np.ndarray,
    k: int,
    reach: float,
    dx: float, dy: float, dz: float,
    reflectance_of: np.ndarray,
    reference_range_m: float,
) -> float:  # fmt: skip
    """Of the echo of a whole beam: reflectance * cosine of incidence * (reference range / range)^2."""
    reflectance = np.float64(reflectance_of[triangle]) if triangle >= 0 else TERRAIN_REFLECTANCE
    incidence = abs(normal[k, 0] * dx + normal[k, 1] * dy + normal[k, 2] * dz)
    scale = reference_range_m / reach
    return reflectance * incidence * scale * scale


@entry
def record(
    origin: np.ndarray,
    direction: np.ndarray,
    advance_m: np.ndarray,
    pulse: np.ndarray,
    found: Hits,
    chosen: np.ndarray,
    sub_direction: np.ndarray,
    sub_advance_m: np.ndarray,
    sub_found: Hits,
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

    ``found`` are the hits of the rays, ``sub_found`` those of the sub-beams of the ``chosen`` ones, see
    :func:`split`. Only points over ``keep`` are written. ``outcome`` int64 (4,) counts what became of the
    pulses, see :data:`OUTCOMES`.
    """
    # arrays are taken out of their tuples once: numba counts references each time
    hit_triangle, hit_m, hit_normal, hit_height = found
    sub_triangle, sub_hit_m, sub_normal, sub_height = sub_found
    reflectance, loss_of, porous = surface.reflectance, surface.loss, surface.porous
    building_of, face_of = surface.building, surface.face
    xyz_mm, intensity, scan_angle, pulses, strips = points[:5]
    return_number, num_returns, buildings, faces = points[5:]
    sigma, reference_m = path.beam_sigma_rad, errors.reference_range_m
    n = 0
    heading_x, heading_y = cos(path.heading_rad), sin(path.heading_rad)
    num_chosen, next_chosen = len(chosen), 0
    # echoes of one pulse: distance on the beam's axis, strength, and the hit that gives the tags
    echo_m, echo_strength = np.empty(SUB_BEAMS), np.empty(SUB_BEAMS)
    echo_triangle = np.empty(SUB_BEAMS, np.int32)
    # sub-beams of one pulse in the order of their ranges
    sub_m, sub_strength, sub_row = np.empty(SUB_BEAMS), np.empty(SUB_BEAMS), np.empty(SUB_BEAMS, np.int64)
    for k in range(len(pulse)):
        is_split = next_chosen < num_chosen and chosen[next_chosen] == k
        t = hit_m[k]
        if t < 0:
            outcome[NO_SURFACE] += 1
            continue
        ox, oy, oz = np.float64(origin[k, 0]), np.float64(origin[k, 1]), np.float64(origin[k, 2])
        dx, dy, dz = np.float64(direction[k, 0]), np.float64(direction[k, 1]), np.float64(direction[k, 2])
        number = np.uint64(pulse[k])
        advance = advance_m[k]
        strength = _strength(
            hit_triangle[k], hit_normal, k, advance + t, dx, dy, dz, reflectance, reference_m
        )
        if sigma > 0:  # the point is recorded on the beam's axis, not on the sub-beam
            sx, sy, sz = _to_axis(sigma, path.beam_key, pulse[k], dx, dy, dz, quantile)
            ox, oy, oz = ox + advance * sx, oy + advance * sy, oz + advance * sz
            dx, dy, dz = dx + sx, dy + sy, dz + sz

        num_echoes = 1
        if not is_split:
            echo_m[0] = (
                _axis_distance(hit_normal, hit_height, k, t, ox, oy, oz, dx, dy, dz) if sigma > 0 else t
            )
            echo_strength[0], echo_triangle[0] = strength, hit_triangle[k]
        else:
            sub_m[0], sub_strength[0], sub_row[0] = t, strength / SUB_BEAMS, -1
            num_sub = 1
            for sub in range(next_chosen * (SUB_BEAMS - 1), (next_chosen + 1) * (SUB_BEAMS - 1)):
                if sub_hit_m[sub] < 0:
                    continue
                reach = sub_advance_m[sub] + sub_hit_m[sub]
                x, y, z = sub_direction[sub, 0], sub_direction[sub, 1], sub_direction[sub, 2]
                share = (
                    _strength(sub_triangle[sub], sub_normal, sub, reach, x, y, z, reflectance, reference_m)
                    / SUB_BEAMS
                )
                place = num_sub
                while place > 0 and sub_m[place - 1] > reach - advance:
                    sub_m[place], sub_strength[place] = sub_m[place - 1], sub_strength[place - 1]
                    sub_row[place] = sub_row[place - 1]
                    place -= 1
                sub_m[place], sub_strength[place], sub_row[place] = reach - advance, share, sub
                num_sub += 1
            next_chosen += 1
            num_echoes, first = 0, 0
            while first < num_sub:
                # an echo is a run of sub-beams without a gap that the sensor could resolve; a face that
                # the beam meets at a slant gives one long echo
                total, mean, best, end = 0.0, 0.0, first, first
                while end < num_sub and (
                    end == first
                    or sub_m[end] - sub_m[end - 1] < errors.separation_m
                    or _same_face(
                        building_of,
                        face_of,
                        porous,
                        _triangle(hit_triangle, sub_triangle, k, sub_row[end]),
                        _triangle(hit_triangle, sub_triangle, k, sub_row[end - 1]),
                    )
                ):
                    total += sub_strength[end]
                    mean += sub_strength[end] * sub_m[end]
                    if sub_strength[end] > sub_strength[best]:
                        best = end
                    end += 1
                middle = mean / total if total > 0 else sub_m[best]
                row = sub_row[best]
                if row < 0:
                    echo_m[num_echoes] = _axis_distance(
                        hit_normal, hit_height, k, middle, ox, oy, oz, dx, dy, dz
                    )
                else:
                    echo_m[num_echoes] = _axis_distance(
                        sub_normal, sub_height, row, middle, ox, oy, oz, dx, dy, dz
                    )
                echo_triangle[num_echoes] = _triangle(hit_triangle, sub_triangle, k, row)
                echo_strength[num_echoes] = total
                num_echoes += 1
                first = end

        detected, start = 0, n
        for echo in range(num_echoes):
            if detected == errors.max_returns:
                break
            draw = number + (np.uint64(echo) << np.uint64(48))
            triangle = echo_triangle[echo]
            building, face, loss = np.int32(-1), np.int32(-1), errors.base_loss
            if triangle >= 0:
                building, face = building_of[triangle], face_of[triangle]
                loss = 1 - (1 - loss) * (1 - loss_of[triangle])
            power = echo_strength[echo]
            if errors.min_intensity > 0 or loss > 0:
                bits = random_bits(errors.loss_key, draw)
                power *= 1 + errors.speckle * normal(bits, 0, quantile)
                if power < errors.min_intensity or uniform(bits) < loss:
                    continue
            detected += 1
            bits = random_bits(errors.key, draw)
            t = echo_m[echo] + errors.noise_range_m * normal(bits, 3, quantile)
            px = ox + t * dx + errors.offset_x_m + errors.noise_xy_m * normal(bits, 0, quantile)
            py = oy + t * dy + errors.offset_y_m + errors.noise_xy_m * normal(bits, 1, quantile)
            pz = oz + t * dz + errors.offset_z_m + errors.noise_z_m * normal(bits, 2, quantile)
            if not (keep.x_min_m <= px < keep.x_max_m and keep.y_min_m <= py < keep.y_max_m):
                continue
            xyz_mm[n, 0] = np.int32(np.rint(1000 * px))
            xyz_mm[n, 1] = np.int32(np.rint(1000 * py))
            xyz_mm[n, 2] = np.int32(np.rint(1000 * pz))
            intensity[n] = np.uint16(min(max(power, 0.0) * _FULL_SCALE, 65535.0))
            right = heading_y * dx - heading_x * dy
            scan_angle[n] = np.int16(np.rint(_arctan(-right / dz) * _PER_RAD))
            pulses[n] = pulse[k]
            strips[n] = np.uint16(strip)
            return_number[n] = np.uint8(detected)
            buildings[n] = building
            faces[n] = face
            n += 1
        for row in range(start, n):
            num_returns[row] = np.uint8(detected)
        outcome[RECORDED if n > start else OUTSIDE if detected else LOST] += 1
    return n


@entry
def count_points(points: Points, low_mm: np.ndarray, high_mm: np.ndarray) -> np.ndarray:
    """Numbers of points, int64 (7,): ground, walls, roofs, trees, what else is on buildings; between
    ``low_mm`` and ``high_mm`` (2,) in x and y, and of these the first returns."""
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
        elif kind == THING_KIND:
            result[4] += 1
        else:
            result[2] += 1
        x, y = xyz[i, 0], xyz[i, 1]
        if low_mm[0] <= x < high_mm[0] and low_mm[1] <= y < high_mm[1]:
            result[5] += 1
            result[6] += number[i] == 1
    return result


@inlined
def _arctan(x: float) -> float:
    """Arc tangent to 1e-5 (Abramowitz, Stegun 1964, 4.4.49), a tenth of a scan angle's unit."""
    y = 1 / x if abs(x) > 1 else x
    q = y * y
    angle = y * (0.9998660 + q * (-0.3302995 + q * (0.1801410 + q * (-0.0851330 + q * 0.0208351))))
    if abs(x) > 1:
        return (pi / 2 if x > 0 else -pi / 2) - angle
    return angle


@inlined
def _triangle(hit_triangle: np.ndarray, sub_triangle: np.ndarray, k: int, row: int) -> int:
    """Triangle of sub-beam ``row``, or of ray ``k`` itself for -1."""
    return hit_triangle[k] if row < 0 else sub_triangle[row]


@inlined
def _same_face(building_of: np.ndarray, face_of: np.ndarray, porous: np.ndarray, a: int, b: int) -> bool:
    """Whether two triangles (-1: the terrain) are of one face; leaves are each their own."""
    if a == b or a < 0 or b < 0:
        return a == b
    together = building_of[a] == building_of[b] and face_of[a] == face_of[b]
    return together and not porous[a]


@inlined
def _axis_distance(
    normal: np.ndarray,
    height_m: np.ndarray,
    k: int,
    t: float,
    ox: float, oy: float, oz: float,
    dx: float, dy: float, dz: float,
) -> float:  # fmt: skip
    """Where the beam's axis meets the surface that a sub-beam met at ``t``; ``t`` where that is another
    place."""
    nx, ny, nz = normal[k, 0], normal[k, 1], normal[k, 2]
    slope = nx * dx + ny * dy + nz * dz
    if slope != 0.0:
        axis_t = (height_m[k] - nx * ox - ny * oy - nz * oz) / slope
        if abs(axis_t - t) < _SAME_SURFACE_M:
            return axis_t
    return t


@inlined
def _on_triangle(
    vertex: np.ndarray,
    triangles: np.ndarray,
    triangle: int,
    ox: float, oy: float, oz: float,
    dx: float, dy: float, dz: float,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Distance to a building's triangle, its unit normal and its plane's distance from the origin.

    The distance is -1 if there is no triangle, or if the ray passes it by: then Embree was wrong.
    """
    if triangle < 0:
        return -1.0, 0.0, 0.0, 0.0, 0.0
    i0, i1, i2 = triangles[triangle, 0], triangles[triangle, 1], triangles[triangle, 2]
    ax, ay, az = vertex[i0, 0], vertex[i0, 1], vertex[i0, 2]
    bx, by, bz = vertex[i1, 0], vertex[i1, 1], vertex[i1, 2]
    cx, cy, cz = vertex[i2, 0], vertex[i2, 1], vertex[i2, 2]
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    per_length = 1 / sqrt(max(nx * nx + ny * ny + nz * nz, 1e-300))
    slope = nx * dx + ny * dy + nz * dz
    if slope == 0.0:
        return -1.0, 0.0, 0.0, 0.0, 0.0
    t = (nx * (ax - ox) + ny * (ay - oy) + nz * (az - oz)) / slope
    px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
    nx, ny, nz = nx * per_length, ny * per_length, nz * per_length
    if not (
        _inside_edge(ax, ay, az, ux, uy, uz, nx, ny, nz, px, py, pz)
        and _inside_edge(bx, by, bz, cx - bx, cy - by, cz - bz, nx, ny, nz, px, py, pz)
        and _inside_edge(cx, cy, cz, -vx, -vy, -vz, nx, ny, nz, px, py, pz)
    ):
        return -1.0, 0.0, 0.0, 0.0, 0.0
    return t, nx, ny, nz, nx * ax + ny * ay + nz * az


@inlined
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
