"""Eaves of one roof at different heights, as compiled code.

The kernel's roofs have one eave height. Below the longer side of a ridge that is not in the middle, the eave is lower;
below the shorter side it is higher, as if that slope began outside the wall. So a slope with a higher eave is that of a
wall moved outwards: the kernel's roof over the moved walls, cut off at the real ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from p2wss.fit.roof.rounds import make_problem
from p2wss.fit.roof.solve import IMPOSSIBLE, evaluate_at, improve_at, load_polygon
from p2wss.fit.roof.starts import edge_groups
from p2wss.fit.roof.work import Context, FitWork, Polygon, fit_work_at
from p2wss.fit.settings import EAVES, SEARCHING, SOLVING
from p2wss.skeleton.compiled import allocating, entry

# sine of the turn below which two walls continue each other
_STRAIGHT = 0.1
_DEGREE = np.pi / 180.0


class _Task(NamedTuple):
    """A part to fit. points: (3, m). direction: int64 (n,), the same number where edges face the same way."""

    polygon: Polygon
    points: np.ndarray
    direction: np.ndarray
    context: Context


@entry
def moved_walls(polygon: Polygon, outward_m: np.ndarray):
    """The vertices (n, 2) of rings whose edges have moved outwards by ``outward_m`` (n,), metres."""
    xy_m, ring_offset = polygon
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
def fit_eaves(polygon: Polygon, points: np.ndarray, angle_deg: np.ndarray, eave: float, context: Context):
    """(loss, eave, angles, outward) of the best roof each of whose slopes has the eave height and the angle that
    suit its points best; the loss is ``IMPOSSIBLE`` if there is none. It is sought from the given roof and from a gable
    roof along either axis: where eaves are at different heights, a roof with level eaves may have hips that are not
    there.

    eave: of the lowest slope. outward (n,): metres by which slopes begin outside their walls, 0 at gables. Slopes that
    face the same way share both. Arguments as of :func:`p2wss.fit.roof.rounds.tidy_roof`.
    """
    work = fit_work_at(context.work_at)
    n = len(polygon.xy_m)
    direction, axis, _, _ = edge_groups(polygon)
    task = _Task(polygon, points, direction, context)
    best = (IMPOSSIBLE, eave, angle_deg.copy(), np.zeros(n))
    for start in range(3):
        start_deg, start_eave = angle_deg.copy(), eave
        if start > 0:
            for e in range(n):
                start_deg[e] = SEARCHING.hip_deg if axis[e] == start - 1 else 90.0
            problem = make_problem(polygon, points, points.shape[1], direction, context)
            if not load_polygon(polygon, work):
                continue
            _, start_eave = improve_at(
                work.code, problem, work.at, start_deg, np.nan, EAVES.num_start_rounds, True, IMPOSSIBLE
            )
        roof = _fit_from(task, work, start_deg, start_eave)
        if roof[0] < best[0]:
            best = roof
    return best


@allocating
def _fit_from(task: _Task, work: FitWork, angle_deg: np.ndarray, eave: float):
    """As :func:`fit_eaves`, from one roof; the loss is ``IMPOSSIBLE`` if level eaves are as good."""
    n = len(angle_deg)
    best_deg, best_eave, best_outward = angle_deg.copy(), eave, np.zeros(n)
    # the direction in which each slope faces, -1 for gables
    way, num_ways, is_level = np.full(n, -1), 0, False
    for e in range(n):
        is_level = is_level or angle_deg[e] == 0.0
        if 0.0 < angle_deg[e] < 90.0:
            way[e] = task.direction[e]
            is_first = True
            for other in range(e):
                is_first = is_first and way[other] != way[e]
            num_ways += 1 if is_first else 0
    best_loss = IMPOSSIBLE
    if num_ways >= 2 and not is_level:
        best_loss = _loss(task, work, best_deg, eave, best_outward)
    if best_loss >= IMPOSSIBLE:
        return IMPOSSIBLE, best_eave, best_deg, best_outward
    is_better = False
    for _ in range(EAVES.num_rounds):
        new_eave, angle, outward = _solve_planes(task, work, way, best_deg, best_eave, best_outward)
        if outward.max() > EAVES.max_outward_m:
            break
        loss = _loss(task, work, angle, new_eave, outward)
        if loss >= best_loss - EAVES.min_gain_m:
            break
        is_better, best_loss, best_eave, best_deg, best_outward = True, loss, new_eave, angle, outward
    return (best_loss if is_better else IMPOSSIBLE), best_eave, best_deg, best_outward


@allocating
def _loss(task: _Task, work: FitWork, angle_deg: np.ndarray, eave: float, outward_m: np.ndarray):
    """The loss of a roof, ``IMPOSSIBLE`` if an edge would turn over; leaves faces and residuals in ``work``."""
    xy_m, ring_offset = task.polygon
    moved = moved_walls(task.polygon, outward_m)
    for ring in range(len(ring_offset) - 1):
        for i in range(ring_offset[ring], ring_offset[ring + 1]):
            j = i + 1 if i + 1 < ring_offset[ring + 1] else ring_offset[ring]
            along = (moved[j, 0] - moved[i, 0]) * (xy_m[j, 0] - xy_m[i, 0])
            along += (moved[j, 1] - moved[i, 1]) * (xy_m[j, 1] - xy_m[i, 1])
            if along <= 0.0:
                return IMPOSSIBLE
    moved_polygon = Polygon(moved, ring_offset)
    if not load_polygon(moved_polygon, work):
        return IMPOSSIBLE
    problem = make_problem(moved_polygon, task.points, task.points.shape[1], task.direction, task.context)
    return evaluate_at(work.code, problem, work.at, angle_deg, eave)


@allocating
def _solve_planes(
    task: _Task, work: FitWork, way: np.ndarray, angle_deg: np.ndarray, eave: float, outward_m: np.ndarray
):
    """(lowest eave, angles, how far outside its wall each slope begins) after one weighted step of the plane of each
    direction, from the faces and residuals in ``work``."""
    n = len(way)
    height, new_deg, new_outward_m = np.zeros(n), angle_deg.copy(), np.zeros(n)
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
        solved, new_height, new_slope = _plane(task, work, way, first, height[first], slope)
        if solved:
            new_angle = min(max(np.arctan(new_slope) / _DEGREE, SOLVING.min_angle_deg), SOLVING.max_angle_deg)
            for e in range(first, n):
                if way[e] == way[first]:
                    height[e], new_deg[e] = new_height, new_angle
    lowest = np.inf
    for e in range(n):
        if way[e] >= 0:
            lowest = min(lowest, height[e])
    for e in range(n):
        if way[e] >= 0:
            new_outward_m[e] = (height[e] - lowest) / np.tan(new_deg[e] * _DEGREE)
    return lowest, new_deg, new_outward_m


@allocating
def _plane(task: _Task, work: FitWork, way: np.ndarray, first: int, height: float, slope: float):
    """(whether its points determine it, height at the wall, slope) of the roof over the edges that face as ``first``
    does."""
    xy_m, ring_offset = task.polygon
    x, y, z = task.points[0], task.points[1], task.points[2]
    keep_eave, keep_slope, cap_m = SOLVING.keep_eave, SOLVING.keep_slope, task.context.settings.limits.cap_m
    a00, a01, a11, b0, b1 = keep_eave, 0.0, keep_slope, keep_eave * height, keep_slope * slope
    count, nearest, furthest = 0, np.inf, -np.inf
    for k in range(len(z)):
        f = work.face[k]
        residual = abs(work.residual[k])
        if f < 0 or way[f] != way[first] or not residual <= cap_m:
            continue
        j = f + 1
        for ring in range(len(ring_offset) - 1):
            if j == ring_offset[ring + 1]:
                j = ring_offset[ring]
                break
        dx, dy = xy_m[j, 0] - xy_m[f, 0], xy_m[j, 1] - xy_m[f, 1]
        d = ((y[k] - xy_m[f, 1]) * dx - (x[k] - xy_m[f, 0]) * dy) / np.hypot(dx, dy)
        w = work.cosine[f] * work.cosine[f] / max(residual, SOLVING.noise_m)
        a00 += w
        a01 += w * d
        a11 += w * d * d
        b0 += w * z[k]
        b1 += w * d * z[k]
        count += 1
        nearest, furthest = min(nearest, d), max(furthest, d)
    if count < EAVES.min_points or furthest - nearest < EAVES.min_extent_m:
        return False, height, slope
    determinant = a00 * a11 - a01 * a01
    return True, (a11 * b0 - a01 * b1) / determinant, (a00 * b1 - a01 * b0) / determinant
