"""Eaves of one roof at different heights, as compiled code.

The kernel's roofs have one eave height. Below the longer side of a ridge that is not in the middle, the eave is lower;
below the shorter side it is higher, as if that slope began outside the wall. So a slope with a higher eave is that of a
wall moved outwards: the kernel's roof over the moved walls, cut off at the real ones.
"""

from __future__ import annotations

import numpy as np

from p2wss.fit.roof.rounds import make_problem
from p2wss.fit.roof.solve import (
    IMPOSSIBLE,
    MAX_ANGLE_DEG,
    MIN_ANGLE_DEG,
    NOISE_M,
    evaluate_at,
    improve_at,
    load_polygon,
)
from p2wss.fit.roof.starts import HIP_DEG, edge_groups
from p2wss.fit.roof.work import fit_work_at
from p2wss.skeleton.compiled import allocating, entry
from p2wss.skeleton.status import Status

_OK = int(Status.OK)
_NUM_ROUNDS, _START_ROUNDS = 4, 3
# a round that gains less is the last one
_MIN_GAIN_M = 1e-4
# slopes with fewer points, or with points over a narrower strip, keep their eave
_MIN_POINTS, _MIN_EXTENT_M = 8, 1.0
# no slope begins further outside its wall
_MAX_OUTWARD_M = 3.0
# weights of the present height and slope, which keep a step small where the points do not determine them
_KEEP_HEIGHT, _KEEP_SLOPE = 1e-3, 0.5
# sine of the turn below which two walls continue each other
_STRAIGHT = 0.1
_DEGREE = np.pi / 180.0


@entry
def moved_walls(xy_m, ring_offset, outward_m):
    """The vertices (n, 2) of rings whose edges have moved outwards by ``outward_m`` (n,), metres."""
    n = len(xy_m)
    result = np.empty((n, 2))
    for ring in range(len(ring_offset) - 1):
        first, last = ring_offset[ring], ring_offset[ring + 1]
        for i in range(first, last):
            before = i - 1 if i > first else last - 1
            after = i + 1 if i + 1 < last else first
            ax, ay = xy_m[i, 0] - xy_m[before, 0], xy_m[i, 1] - xy_m[before, 1]
            bx, by = xy_m[after, 0] - xy_m[i, 0], xy_m[after, 1] - xy_m[i, 1]
            a, b = np.hypot(ax, ay), np.hypot(bx, by)
            ax, ay, bx, by = ax / a, ay / a, bx / b, by / b
            sine = ax * by - ay * bx
            if abs(sine) < _STRAIGHT:
                further = max(outward_m[before], outward_m[i])
                result[i, 0], result[i, 1] = xy_m[i, 0] + by * further, xy_m[i, 1] - bx * further
            else:
                # along either wall by what the other one has moved
                along_b, along_a = outward_m[before] / sine, outward_m[i] / sine
                result[i, 0] = xy_m[i, 0] - bx * along_b + ax * along_a
                result[i, 1] = xy_m[i, 1] - by * along_b + ay * along_a
    return result


@entry
def fit_eaves(xy_m, ring_offset, x, y, z, angle_deg, eave, top, work_at, settings, prior):
    """(loss, eave, top, angles, outward) of the best roof each of whose slopes has the eave height and the angle that
    suit its points best; the loss is ``IMPOSSIBLE`` if there is none. It is sought from the given roof and from a gable
    roof along either axis: where eaves are at different heights, a roof with level eaves may have hips, or a flat top,
    that are not there.

    eave: of the lowest slope. outward (n,): metres by which slopes begin outside their walls, 0 at gables. Slopes that
    face the same way share both. Arguments as of :func:`p2wss.fit.roof.rounds.tidy_roof`.
    """
    work = fit_work_at(work_at)
    n = len(xy_m)
    direction, axis, _, _ = edge_groups(xy_m, ring_offset)
    best = (IMPOSSIBLE, eave, top, angle_deg.copy(), np.zeros(n))
    for start in range(3):
        start_deg, start_eave, start_top = angle_deg.copy(), eave, top
        if start > 0:
            for e in range(n):
                start_deg[e] = HIP_DEG if axis[e] == start - 1 else 90.0
            problem = make_problem(xy_m, ring_offset, x, y, z, len(z), direction, settings, prior)
            status, _ = load_polygon(xy_m, ring_offset, work)
            if status != _OK:
                continue
            _, start_eave, start_top = improve_at(
                work.code, problem, work.at, start_deg, eave, np.inf, _START_ROUNDS, True, True, IMPOSSIBLE
            )
        roof = _fit_from(
            xy_m, ring_offset, x, y, z, start_deg, start_eave, start_top, direction, work, settings, prior
        )
        if roof[0] < best[0]:
            best = roof
    return best


@allocating
def _fit_from(xy_m, ring_offset, x, y, z, angle_deg, eave, top, direction, work, settings, prior):
    """As :func:`fit_eaves`, from one roof; the loss is ``IMPOSSIBLE`` if level eaves are as good."""
    n = len(xy_m)
    best_deg, best_eave, best_top, best_outward = angle_deg.copy(), eave, top, np.zeros(n)
    # the direction in which each slope faces, -1 for gables
    way, num_ways, is_level = np.full(n, -1), 0, False
    for e in range(n):
        is_level = is_level or angle_deg[e] == 0.0
        if 0.0 < angle_deg[e] < 90.0:
            way[e] = direction[e]
            is_first = True
            for other in range(e):
                is_first = is_first and way[other] != way[e]
            num_ways += 1 if is_first else 0
    best_loss = IMPOSSIBLE
    if num_ways >= 2 and not is_level:
        best_loss = _loss(
            xy_m, ring_offset, x, y, z, best_deg, eave, top, best_outward, direction, work, settings, prior
        )
    if best_loss >= IMPOSSIBLE:
        return IMPOSSIBLE, best_eave, best_top, best_deg, best_outward
    is_better = False
    angle, outward = np.empty(n), np.empty(n)
    for _ in range(_NUM_ROUNDS):
        new_eave, furthest_m = _solve_planes(
            xy_m, ring_offset, x, y, z, way, best_deg, best_eave, best_outward, work, settings, angle, outward
        )
        if furthest_m > _MAX_OUTWARD_M:
            break
        new_top = best_eave + best_top - new_eave
        loss = _loss(
            xy_m, ring_offset, x, y, z, angle, new_eave, new_top, outward, direction, work, settings, prior
        )
        if loss >= best_loss - _MIN_GAIN_M:
            break
        is_better, best_loss, best_eave, best_top = True, loss, new_eave, new_top
        for e in range(n):
            best_deg[e], best_outward[e] = angle[e], outward[e]
    return (best_loss if is_better else IMPOSSIBLE), best_eave, best_top, best_deg, best_outward


@allocating
def _loss(xy_m, ring_offset, x, y, z, angle_deg, eave, top, outward_m, direction, work, settings, prior):
    """The loss of a roof, ``IMPOSSIBLE`` if an edge would turn over; leaves faces and residuals in ``work``."""
    moved = moved_walls(xy_m, ring_offset, outward_m)
    for ring in range(len(ring_offset) - 1):
        for i in range(ring_offset[ring], ring_offset[ring + 1]):
            j = i + 1 if i + 1 < ring_offset[ring + 1] else ring_offset[ring]
            along = (moved[j, 0] - moved[i, 0]) * (xy_m[j, 0] - xy_m[i, 0])
            along += (moved[j, 1] - moved[i, 1]) * (xy_m[j, 1] - xy_m[i, 1])
            if along <= 0.0:
                return IMPOSSIBLE
    status, _ = load_polygon(moved, ring_offset, work)
    if status != _OK:
        return IMPOSSIBLE
    problem = make_problem(moved, ring_offset, x, y, z, len(z), direction, settings, prior)
    return evaluate_at(work.code, problem, work.at, angle_deg, eave, top)


@allocating
def _solve_planes(
    xy_m, ring_offset, x, y, z, way, angle_deg, eave, outward_m, work, settings, new_deg, new_outward_m
):  # fmt: skip
    """(lowest eave, furthest that a slope begins outside its wall) after one weighted step of the plane of each
    direction, from the faces and residuals in ``work``. Writes angles and how far outside each slope begins."""
    n = len(xy_m)
    height = np.zeros(n)
    for e in range(n):
        new_deg[e] = angle_deg[e]
    for first in range(n):
        is_first = way[first] >= 0
        for e in range(first):
            is_first = is_first and way[e] != way[first]
        if not is_first:
            continue
        slope = np.tan(angle_deg[first] * _DEGREE)
        for e in range(first, n):
            if way[e] == way[first]:
                height[e] = eave + outward_m[e] * np.tan(angle_deg[e] * _DEGREE)
        solved, new_height, new_slope = _plane(
            xy_m, ring_offset, x, y, z, way, first, height[first], slope, work, settings
        )
        if solved:
            for e in range(first, n):
                if way[e] == way[first]:
                    height[e] = new_height
                    new_deg[e] = min(max(np.arctan(new_slope) / _DEGREE, MIN_ANGLE_DEG), MAX_ANGLE_DEG)
    lowest, furthest_m = np.inf, 0.0
    for e in range(n):
        if way[e] >= 0:
            lowest = min(lowest, height[e])
    for e in range(n):
        new_outward_m[e] = (height[e] - lowest) / np.tan(new_deg[e] * _DEGREE) if way[e] >= 0 else 0.0
        furthest_m = max(furthest_m, new_outward_m[e])
    return lowest, furthest_m


@allocating
def _plane(xy_m, ring_offset, x, y, z, way, first, height, slope, work, settings):
    """(whether its points determine it, height at the wall, slope) of the roof over the edges that face as ``first``
    does."""
    a00, a01, a11, b0, b1 = _KEEP_HEIGHT, 0.0, _KEEP_SLOPE, _KEEP_HEIGHT * height, _KEEP_SLOPE * slope
    count, nearest, furthest = 0, np.inf, -np.inf
    for k in range(len(z)):
        f = work.face[k]
        residual = abs(work.residual[k])
        if f < 0 or way[f] != way[first] or not residual <= settings.cap_m:
            continue
        j = f + 1
        for ring in range(len(ring_offset) - 1):
            if j == ring_offset[ring + 1]:
                j = ring_offset[ring]
                break
        dx, dy = xy_m[j, 0] - xy_m[f, 0], xy_m[j, 1] - xy_m[f, 1]
        d = ((y[k] - xy_m[f, 1]) * dx - (x[k] - xy_m[f, 0]) * dy) / np.hypot(dx, dy)
        w = work.cosine[f] * work.cosine[f] / max(residual, NOISE_M)
        a00 += w
        a01 += w * d
        a11 += w * d * d
        b0 += w * z[k]
        b1 += w * d * z[k]
        count += 1
        nearest, furthest = min(nearest, d), max(furthest, d)
    if count < _MIN_POINTS or furthest - nearest < _MIN_EXTENT_M:
        return False, height, slope
    determinant = a00 * a11 - a01 * a01
    return True, (a11 * b0 - a01 * b1) / determinant, (a00 * b1 - a01 * b0) / determinant
