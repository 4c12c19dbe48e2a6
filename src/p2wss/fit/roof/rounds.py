"""Fits one roof to its points, as compiled code: search, flat top, last rounds, whole degrees."""

from __future__ import annotations

import numpy as np

from p2wss.fit.parts.jumps import quantile
from p2wss.fit.roof.envelope import inward_distances
from p2wss.fit.roof.search import MANY_EDGES, is_tried, search_at, set_excess
from p2wss.fit.roof.solve import IMPOSSIBLE, MAX_DIFFERENCE_M, evaluate_at, improve_at, load_polygon
from p2wss.fit.roof.starts import edge_groups, start_angles
from p2wss.fit.roof.work import Problem, Settings, fit_work_at
from p2wss.skeleton.compiled import ZERO, allocating, by_address, entry, inner
from p2wss.skeleton.ordering import sort_first
from p2wss.skeleton.status import Status

_OK = int(Status.OK)
_LOW_QUANTILE, _FLAT_TOP_QUANTILES = 0.05, (0.6, 0.8, 0.93)
_STEEP_DEG, _STEEP_HIP_DEG = 58.0, 55.0
_LAST_ROUNDS, _TIDY_ROUNDS = 5, 3
# below this loss no flat top is searched; a roof with one that starts worse by the second figure is dropped
_LOW_LOSS_M, _FLAT_TOP_START_M = 0.06, 0.05
# a flat top below this height above the eave is not tried
_MIN_TOP_M = 1.0
# Narrower slopes are returns from the walls: there are none below a flat top, and a slope at the end of a gable roof
# becomes a gable if that costs no more than the second figure.
_MIN_SLOPE_WIDTH_M, _WALL_HITS_M = 0.8, 0.04
_DEGREE = np.pi / 180.0
# with more edges than MANY_EDGES the search has one round, with more than these only the starts, of which one is
# followed
_TOO_MANY_EDGES = 120
_NEARLY_GABLE_DEG, _USUAL_DEG = 60.0, 38.0
# a change between gable and slope that is this much worse after a round is dropped
_GIVE_UP_M = 0.05
# with this many points the thresholds hold as they are; with fewer, gains have to be proportionally larger
_FULL_NUM_POINTS = 150.0


@allocating
def every_kth_value(values, max_count):
    """At most ``max_count`` of the values, evenly spaced."""
    n = len(values)
    if n <= max_count:
        return values
    result = np.empty(max_count)
    for i in range(max_count):
        result[i] = values[int((i + 0.5) * n / max_count)]
    return result


@allocating
def make_problem(xy_m, ring_offset, x, y, z, max_points, direction, settings, prior):
    """The problem of a polygon and at most ``max_points`` of its points, evenly spaced. direction: of
    :func:`p2wss.fit.roof.starts.edge_groups`."""
    local_x, local_y = (
        every_kth_value(x, max_points) - xy_m[0, 0],
        every_kth_value(y, max_points) - xy_m[0, 1],
    )
    num_directions = 0
    for e in range(len(direction)):
        num_directions = max(num_directions, direction[e] + 1)
    return Problem(
        len(xy_m),
        len(ring_offset) - 1,
        local_x,
        local_y,
        every_kth_value(z, max_points) - 0.0,
        direction,
        num_directions,
        settings.cap_m,
        settings.max_roof_height_m,
        prior,
        inward_distances(xy_m, ring_offset, local_x, local_y),
    )


@allocating
def _flat_tops(z, angle_deg, eave):
    """(angles, heights of the top) of roofs with a flat top: the same roof, a steeper one and a hip roof, each cut at a
    few heights that the points suggest."""
    n = len(angle_deg)
    ordered = z.copy()
    sort_first(ordered, len(ordered))
    low = quantile(ordered, len(z), _LOW_QUANTILE)
    rows, tops = np.empty((9, n)), np.empty(9)
    count = 0
    for share in _FLAT_TOP_QUANTILES:
        # the eave of a flat roof may lie at the height of the top
        rise = quantile(ordered, len(z), share) - min(eave, low)
        if rise <= _MIN_TOP_M:
            continue
        for kind in range(3):
            tops[count] = rise
            for e in range(n):
                is_slope = 0.0 < angle_deg[e] < 90.0
                steep = _STEEP_DEG if is_slope else angle_deg[e]
                rows[count, e] = angle_deg[e] if kind == 0 else steep if kind == 1 else _STEEP_HIP_DEG
            count += 1
    return rows[:count], tops[:count]


@inner
def _slope_width_m(angle_deg, top_m):
    """Width in plan of the steepest slope below a flat top."""
    steepest = 0.0
    for angle in angle_deg:
        if steepest < angle < 90.0:
            steepest = angle
    return top_m / np.tan(steepest * _DEGREE) if steepest > 0.0 else np.inf


@inner
def with_flat_top(settings, flat_top):
    """The same settings, with flat tops only if ``flat_top`` allows them."""
    return Settings(
        settings.num_search_points, settings.num_points, settings.num_followed, settings.num_descents,
        settings.max_rounds, flat_top and settings.flat_top, settings.cap_m, settings.max_roof_height_m,
        settings.top_gain_m, settings.class_gain_m, settings.separate_slope_gain_m, settings.rounding_m,
    )  # fmt: skip


@inner
def with_little_effort(settings):
    """The same settings, with one start followed and without flat tops."""
    return Settings(
        settings.num_search_points, settings.num_points, 1, settings.num_descents, settings.max_rounds, False,
        settings.cap_m, settings.max_roof_height_m, settings.top_gain_m, settings.class_gain_m,
        settings.separate_slope_gain_m, settings.rounding_m,
    )  # fmt: skip


@allocating
def _level_roof(num_edges, z, settings, prior):
    """(loss, eave, top, angles) of the level roof at the median height, for which no skeleton is needed."""
    ordered = z.copy()
    sort_first(ordered, len(ordered))
    eave, loss = quantile(ordered, len(z), 0.5), 0.0
    for height in z:
        loss += min(abs(height - eave), settings.cap_m) / len(z)
    if len(prior.eave_z_m) > 0:
        loss += prior.eave_cost * min(abs(eave - prior.eave_z_m[0]), MAX_DIFFERENCE_M)
    if len(prior.slope_deg) > 0:
        for e in range(num_edges):
            loss += prior.class_cost_m[e, 0]
    return loss, eave, np.inf, np.zeros(num_edges)


@entry
def fit_roof(xy_m, ring_offset, x, y, z, guesses, known_loss, known_eave, work_at, settings, prior):
    """(loss, eave, top, angles) of the best roof over a polygon; the loss is ``IMPOSSIBLE`` if the kernel refuses it.

    xy_m (n, 2), ring_offset: the polygon. x, y, z: points in even order; the search takes a sample of them and the
    last rounds take all. guesses: (num_guesses, n), degrees. known_loss, known_eave: of the only guess, if this
    function has returned it for the same points without flat tops, so that only those are searched; else
    ``IMPOSSIBLE`` and 0. settings, prior: of :mod:`p2wss.fit.roof.work`.
    """
    work = fit_work_at(work_at)
    n = len(xy_m)
    # the search grows with the cube of the number of edges
    max_rounds = 0 if n > _TOO_MANY_EDGES else 1 if n > MANY_EDGES else settings.max_rounds
    if n > MANY_EDGES and settings.num_descents == 0:
        return _level_roof(n, z, settings, prior)
    if n > _TOO_MANY_EDGES:
        settings = with_little_effort(settings)
    direction, axis, _, _ = edge_groups(xy_m, ring_offset)
    sample = make_problem(xy_m, ring_offset, x, y, z, settings.num_search_points, direction, settings, prior)
    status, _ = load_polygon(xy_m, ring_offset, work)
    tolerance = settings.class_gain_m * max(1.0, _FULL_NUM_POINTS / len(sample.z))
    loss, eave, top = known_loss, known_eave, np.inf
    if loss < IMPOSSIBLE:
        angle_deg = guesses[0].copy()
    else:
        rows = start_angles(direction, axis, guesses)
        if status != _OK:
            return IMPOSSIBLE, 0.0, np.inf, rows[0]
        tops = np.empty(len(rows))
        for i in range(len(rows)):
            tops[i] = np.inf
        loss, eave, top, row = search_at(
            work.code, sample, work.at, settings, rows, tops, max_rounds, tolerance, IMPOSSIBLE
        )
        angle_deg = rows[row].copy()
    if loss >= IMPOSSIBLE:
        return loss, eave, top, angle_deg
    if settings.flat_top and loss > _LOW_LOSS_M:
        rows, tops = _flat_tops(sample.z, angle_deg, eave)
        if len(rows) > 0:
            new_loss, new_eave, new_top, row = search_at(
                work.code, sample, work.at, settings, rows, tops, max(max_rounds - 1, 0), tolerance,
                loss + _FLAT_TOP_START_M,
            )  # fmt: skip
            is_wide = _slope_width_m(rows[row], new_top) >= _MIN_SLOPE_WIDTH_M
            if is_wide and new_loss < loss - settings.top_gain_m:
                loss, eave, top = new_loss, new_eave, new_top
                for e in range(n):
                    angle_deg[e] = rows[row, e]
    if len(z) > len(sample.z):
        full = make_problem(xy_m, ring_offset, x, y, z, len(z), direction, settings, prior)
        loss, eave, top = improve_at(
            work.code, full, work.at, angle_deg, eave, top, _LAST_ROUNDS, False, True, IMPOSSIBLE
        )
    return loss, eave, top, angle_deg


fit_roof_at = by_address(fit_roof)


@entry
def improve_roof(xy_m, ring_offset, x, y, z, angle_deg, eave, top, num_rounds, work_at, settings, prior):
    """Loss of a roof after ``num_rounds`` rounds of improvement; ``angle_deg`` is changed in place."""
    work = fit_work_at(work_at)
    direction, _, _, _ = edge_groups(xy_m, ring_offset)
    problem = make_problem(xy_m, ring_offset, x, y, z, len(z), direction, settings, prior)
    status, _ = load_polygon(xy_m, ring_offset, work)
    if status != _OK:
        return IMPOSSIBLE
    loss, _, _ = improve_at(
        work.code, problem, work.at, angle_deg, eave, top, num_rounds, False, True, IMPOSSIBLE
    )
    return loss


improve_roof_at = by_address(improve_roof)


@inner
def _flip_gables(problem, work, angle_deg, trial, loss, eave, top, tolerance):
    """Turns single slopes into gables and single gables into slopes where that lowers the loss, as all points may show
    what the sample of the search did not. ``angle_deg`` is changed in place. Returns (loss, eave, top)."""
    n = problem.num_edges
    evaluate_at(work.code, problem, work.at, angle_deg, eave, top)
    total, other = set_excess(problem, work)
    num_tried = ZERO
    for unit in range(n):
        if total < tolerance or angle_deg[unit] == 0.0:
            continue
        if not is_tried(problem, work, unit, other, tolerance, num_tried):
            continue
        num_tried += 1
        slope = _USUAL_DEG
        for e in range(n):
            trial[e] = angle_deg[e]
            if problem.direction[e] == problem.direction[unit] and 0.0 < angle_deg[e] < 90.0:
                slope = angle_deg[e]
        trial[unit] = slope if angle_deg[unit] == 90.0 else 90.0
        new_loss, new_eave, new_top = improve_at(
            work.code, problem, work.at, trial, eave, top, _TIDY_ROUNDS, False, True, loss + _GIVE_UP_M
        )
        if new_loss < loss - tolerance:
            loss, eave, top = new_loss, new_eave, new_top
            for e in range(n):
                angle_deg[e] = trial[e]
            evaluate_at(work.code, problem, work.at, angle_deg, eave, top)
            total, other = set_excess(problem, work)
    return loss, eave, top


@entry
def tidy_roof(xy_m, ring_offset, x, y, z, angle_deg, eave, top, work_at, settings, prior):
    """(loss, eave, top, angles) of a roof with whole degrees where that costs little. A roof that a flat one describes
    as well has only edges of 0 degrees."""
    work = fit_work_at(work_at)
    n = len(xy_m)
    direction, _, _, _ = edge_groups(xy_m, ring_offset)
    problem = make_problem(xy_m, ring_offset, x, y, z, len(z), direction, settings, prior)
    tolerance = settings.class_gain_m * max(1.0, _FULL_NUM_POINTS / min(len(z), settings.num_search_points))
    status, _ = load_polygon(xy_m, ring_offset, work)
    angle, trial = angle_deg.copy(), np.zeros(n)
    if status != _OK:
        return IMPOSSIBLE, eave, top, angle
    loss = evaluate_at(work.code, problem, work.at, angle, eave, top)
    new_loss, new_eave, new_top = improve_at(
        work.code, problem, work.at, trial, eave, np.inf, _TIDY_ROUNDS, True, True, IMPOSSIBLE
    )
    if new_loss <= loss + tolerance:
        return new_loss, new_eave, new_top, trial
    for d in range(problem.num_directions):
        # At the end of a gable roof hardly any point distinguishes a steep face from a vertical one, and returns from
        # a wall that stands back below its eave look like a steep face.
        changed, depth_m = False, 0.0
        evaluate_at(work.code, problem, work.at, angle, eave, top)
        for e in range(n):
            trial[e] = angle[e]
            if direction[e] == d and _NEARLY_GABLE_DEG < angle[e] < 90.0:
                trial[e] = 90.0
                changed = True
                for k in range(len(problem.z)):
                    if work.face[k] == e:
                        depth_m = max(depth_m, work.distance[k])
        if changed:
            new_loss, new_eave, new_top = improve_at(
                work.code, problem, work.at, trial, eave, top, _TIDY_ROUNDS, False, True, IMPOSSIBLE
            )
            max_growth_m = _WALL_HITS_M if depth_m < _MIN_SLOPE_WIDTH_M else settings.rounding_m
            if new_loss <= loss + max(tolerance, max_growth_m):
                loss, eave, top = new_loss, new_eave, new_top
                for e in range(n):
                    angle[e] = trial[e]
    loss, eave, top = _flip_gables(problem, work, angle, trial, loss, eave, top, 0.5 * tolerance)
    if problem.num_directions < n <= _TOO_MANY_EDGES and loss > settings.separate_slope_gain_m:
        # edges that face the same way may have different slopes
        min_gain_m = max(tolerance, settings.separate_slope_gain_m)
        separate_direction = np.empty(n, np.int64)
        for e in range(n):
            separate_direction[e] = e
        separate = make_problem(xy_m, ring_offset, x, y, z, len(z), separate_direction, settings, prior)
        separate_deg = angle.copy()
        new_loss, new_eave, new_top = improve_at(
            work.code, separate, work.at, separate_deg, eave, top, _LAST_ROUNDS, False, True, IMPOSSIBLE
        )
        new_loss, new_eave, new_top = _flip_gables(
            separate, work, separate_deg, trial, new_loss, new_eave, new_top, min_gain_m
        )
        if new_loss < loss - min_gain_m:
            loss, eave, top, angle = new_loss, new_eave, new_top, separate_deg
    changed = False
    for e in range(n):
        trial[e] = np.rint(angle[e])
        changed = changed or trial[e] != angle[e]
    if changed:
        new_loss, new_eave, new_top = improve_at(
            work.code, problem, work.at, trial, eave, top, _TIDY_ROUNDS, False, False, IMPOSSIBLE
        )
        if new_loss <= loss + settings.rounding_m:
            return new_loss, new_eave, new_top, trial
    return loss, eave, top, angle
