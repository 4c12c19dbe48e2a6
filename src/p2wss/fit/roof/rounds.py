"""Fits one roof to its points, as compiled code: search, last rounds, whole degrees."""

from __future__ import annotations

import numpy as np

from p2wss.fit.roof.envelope import inward_distances
from p2wss.fit.roof.search import is_tried, search_at, set_excess
from p2wss.fit.roof.solve import IMPOSSIBLE, evaluate_at, improve_at, load_polygon
from p2wss.fit.roof.starts import edge_groups, start_angles
from p2wss.fit.roof.work import Context, FitWork, Polygon, Problem, fit_work_at
from p2wss.fit.settings import SEARCHING, USUAL_SLOPE_DEG
from p2wss.skeleton.compiled import ZERO, allocating, entry, inner


@allocating
def every_kth_point(points: np.ndarray, max_count: int):
    """At most ``max_count`` of the points (3, m), evenly spaced."""
    m = points.shape[1]
    if m <= max_count:
        return points
    result = np.empty((3, max_count))
    for i in range(max_count):
        k = int((i + 0.5) * m / max_count)
        result[0, i], result[1, i], result[2, i] = points[0, k], points[1, k], points[2, k]
    return result


@allocating
def make_problem(
    polygon: Polygon, points: np.ndarray, max_points: int, direction: np.ndarray, context: Context
):
    """The problem of a polygon and at most ``max_points`` of its points (3, m), evenly spaced. direction: of
    :func:`p2wss.fit.roof.starts.edge_groups`."""
    xy_m, limits = polygon.xy_m, context.settings.limits
    chosen = every_kth_point(points, max_points)
    local_x, local_y = chosen[0] - xy_m[0, 0], chosen[1] - xy_m[0, 1]
    num_directions = 0
    for e in range(len(direction)):
        num_directions = max(num_directions, direction[e] + 1)
    return Problem(
        len(xy_m),
        len(polygon.ring_offset) - 1,
        local_x,
        local_y,
        chosen[2] - 0.0,
        direction,
        num_directions,
        limits.cap_m,
        limits.max_roof_height_m,
        context.prior,
        inward_distances(polygon, local_x, local_y),
    )


@entry
def fit_roof(polygon: Polygon, points: np.ndarray, guesses: np.ndarray, context: Context):
    """(loss, eave, angles) of the best roof over a polygon; the loss is ``IMPOSSIBLE`` if the kernel refuses it.

    points: (3, m), in even order; the search takes a sample of them and the last rounds take all. guesses:
    (num_guesses, n), degrees.
    """
    work, effort = fit_work_at(context.work_at), context.settings.effort
    n = len(polygon.xy_m)
    max_rounds = effort.max_rounds
    if n > SEARCHING.many_edges:
        max_rounds = 1 if n <= SEARCHING.too_many_edges else 0
    direction, axis, _, _ = edge_groups(polygon)
    sample = make_problem(polygon, points, effort.num_search_points, direction, context)
    rows = start_angles(direction, axis, guesses)
    if not load_polygon(polygon, work):
        return IMPOSSIBLE, 0.0, rows[0]
    tolerance = _class_gain_m(context, len(sample.z))
    loss, eave, row = search_at(work.code, sample, work.at, effort, rows, max_rounds, tolerance)
    angle_deg = rows[row].copy()
    if loss < IMPOSSIBLE and points.shape[1] > len(sample.z):
        full = make_problem(polygon, points, points.shape[1], direction, context)
        loss, eave = improve_at(
            work.code, full, work.at, angle_deg, eave, SEARCHING.num_full, True, IMPOSSIBLE
        )
    return loss, eave, angle_deg


@inner
def _class_gain_m(context: Context, num_points: int):
    """What another class of an edge has to gain with so many points."""
    return context.settings.limits.class_gain_m * max(1.0, SEARCHING.full_num_points / num_points)


@entry
def roof_loss(polygon: Polygon, points: np.ndarray, angle_deg: np.ndarray, eave: float, context: Context):
    """Loss of a roof on points (3, m)."""
    work = fit_work_at(context.work_at)
    direction, _, _, _ = edge_groups(polygon)
    problem = make_problem(polygon, points, points.shape[1], direction, context)
    if not load_polygon(polygon, work):
        return IMPOSSIBLE
    loss, _ = improve_at(work.code, problem, work.at, angle_deg, eave, 0, True, IMPOSSIBLE)
    return loss


@inner
def _flip_gables(
    problem: Problem,
    work: FitWork,
    angle_deg: np.ndarray,
    trial: np.ndarray,
    loss: float,
    eave: float,
    tolerance: float,
):
    """Turns single slopes into gables and single gables into slopes where that lowers the loss, as all points may show
    what the sample of the search did not. ``angle_deg`` is changed in place. Returns (loss, eave)."""
    n = problem.num_edges
    evaluate_at(work.code, problem, work.at, angle_deg, eave)
    total, other = set_excess(problem, work)
    num_tried = ZERO
    for unit in range(n):
        if total < tolerance or angle_deg[unit] == 0.0:
            continue
        if not is_tried(problem, work, unit, other, tolerance, num_tried):
            continue
        num_tried += 1
        slope = USUAL_SLOPE_DEG
        for e in range(n):
            trial[e] = angle_deg[e]
            if problem.direction[e] == problem.direction[unit] and 0.0 < angle_deg[e] < 90.0:
                slope = angle_deg[e]
        trial[unit] = slope if angle_deg[unit] == 90.0 else 90.0
        new_loss, new_eave = improve_at(
            work.code,
            problem,
            work.at,
            trial,
            eave,
            SEARCHING.num_next,
            True,
            loss + SEARCHING.give_up_last_m,
        )
        if new_loss < loss - tolerance:
            loss, eave = new_loss, new_eave
            for e in range(n):
                angle_deg[e] = trial[e]
            evaluate_at(work.code, problem, work.at, angle_deg, eave)
            total, other = set_excess(problem, work)
    return loss, eave


@entry
def tidy_roof(polygon: Polygon, points: np.ndarray, angle_deg: np.ndarray, eave: float, context: Context):
    """(loss, eave, angles) of a roof with whole degrees where that costs little. A roof that a flat one describes
    as well has only edges of 0 degrees."""
    work, limits = fit_work_at(context.work_at), context.settings.limits
    n, m = len(polygon.xy_m), points.shape[1]
    direction, _, _, _ = edge_groups(polygon)
    problem = make_problem(polygon, points, m, direction, context)
    tolerance = _class_gain_m(context, min(m, context.settings.effort.num_search_points))
    angle, trial = angle_deg.copy(), np.zeros(n)
    if not load_polygon(polygon, work):
        return IMPOSSIBLE, eave, angle
    loss = evaluate_at(work.code, problem, work.at, angle, eave)
    new_loss, new_eave = improve_at(
        work.code, problem, work.at, trial, np.nan, SEARCHING.num_next, True, IMPOSSIBLE
    )
    if new_loss <= loss + tolerance:
        return new_loss, new_eave, trial
    for d in range(problem.num_directions):
        # At the end of a gable roof hardly any point distinguishes a steep face from a vertical one, and returns from
        # a wall that stands back below its eave look like a steep face.
        changed, depth_m = False, 0.0
        evaluate_at(work.code, problem, work.at, angle, eave)
        for e in range(n):
            trial[e] = angle[e]
            if direction[e] == d and SEARCHING.nearly_gable_deg < angle[e] < 90.0:
                trial[e] = 90.0
                changed = True
                for k in range(len(problem.z)):
                    if work.face[k] == e:
                        depth_m = max(depth_m, work.distance[k])
        if changed:
            new_loss, new_eave = improve_at(
                work.code, problem, work.at, trial, eave, SEARCHING.num_next, True, IMPOSSIBLE
            )
            is_narrow = depth_m < SEARCHING.min_slope_width_m
            max_growth_m = SEARCHING.wall_hits_m if is_narrow else limits.rounding_m
            if new_loss <= loss + max(tolerance, max_growth_m):
                loss, eave = new_loss, new_eave
                for e in range(n):
                    angle[e] = trial[e]
    loss, eave = _flip_gables(problem, work, angle, trial, loss, eave, 0.5 * tolerance)
    is_small = n <= SEARCHING.too_many_edges
    if problem.num_directions < n and is_small and loss > limits.separate_slope_gain_m:
        # edges that face the same way may have different slopes
        min_gain_m = max(tolerance, limits.separate_slope_gain_m)
        separate_direction = np.empty(n, np.int64)
        for e in range(n):
            separate_direction[e] = e
        separate = make_problem(polygon, points, m, separate_direction, context)
        separate_deg = angle.copy()
        new_loss, new_eave = improve_at(
            work.code, separate, work.at, separate_deg, eave, SEARCHING.num_full, True, IMPOSSIBLE
        )
        new_loss, new_eave = _flip_gables(separate, work, separate_deg, trial, new_loss, new_eave, min_gain_m)
        if new_loss < loss - min_gain_m:
            loss, eave, angle = new_loss, new_eave, separate_deg
    changed = False
    for e in range(n):
        trial[e] = np.rint(angle[e])
        changed = changed or trial[e] != angle[e]
    if changed:
        new_loss, new_eave = improve_at(
            work.code, problem, work.at, trial, eave, SEARCHING.num_next, False, IMPOSSIBLE
        )
        if new_loss <= loss + limits.rounding_m:
            return new_loss, new_eave, trial
    return loss, eave, angle
