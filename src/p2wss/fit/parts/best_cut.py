"""The most promising cut through a part, chosen with few points and without a search of classes, and the roofs on
either side of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from p2wss.fit.parts.cutting import inherited_angles, is_sound_at, side_of_cut_at
from p2wss.fit.parts.jumps import candidates
from p2wss.fit.roof.prior import slope_prior
from p2wss.fit.roof.rounds import every_kth_point, fit_roof_at, improve_roof_at
from p2wss.fit.roof.solve import IMPOSSIBLE
from p2wss.fit.roof.work import Context, Polygon, fit_work_at
from p2wss.fit.settings import CUTS, SEARCHING, Settings
from p2wss.skeleton.compiled import ZERO, allocating, by_address, entry
from p2wss.skeleton.ordering import sort_first, stable_order

# a position this near to a corner is at the corner
_ON_CORNER_M = 1e-6


class Roofed(NamedTuple):
    """A part that may be cut. polygon, angle_deg: of its roof. points: float64 (3, m), in even order."""

    polygon: Polygon
    angle_deg: np.ndarray
    points: np.ndarray


class Rules(NamedTuple):
    """How cuts are fitted. screen, full: settings of the fits to a sample and to all points. min_points: on either
    side. min_clearance_m: of the polygon of either side, unless 5 cm are more. slope_cost_m: what each slope costs in
    the sum of the residuals."""

    work_at: int
    screen: Settings
    full: Settings
    min_points: int
    min_clearance_m: float
    slope_cost_m: float


class Line(NamedTuple):
    """A cut across x (axis 0) or y (axis 1)."""

    axis: int
    position: float


class Side(NamedTuple):
    """One side of a cut with its roof. loss_m: the mean over its points."""

    loss_m: float
    eave_z_m: float
    angle_deg: np.ndarray
    polygon: Polygon


@entry
def split_roof(part: Roofed, limit_m: float, rules: Rules):
    """(line, low side, high side) of the best cut through a part; its axis is -1 if no cut costs less than ``limit_m``.
    A cut costs the sum of the residuals and ``rules.slope_cost_m`` for each slope."""
    xy_m = part.polygon.xy_m
    sample = Roofed(part.polygon, part.angle_deg, every_kth_point(part.points, CUTS.num_points))
    axes, positions = candidates(xy_m, part.points)
    line = Line(-1, 0.0)
    low = high = Side(IMPOSSIBLE, 0.0, part.angle_deg, part.polygon)
    max_cost_m = limit_m
    for is_moved in (False, True):
        cost_m, index, new_low, new_high = _best_cut(part, sample, axes, positions, max_cost_m, rules)
        if index < 0:
            break
        line, low, high = Line(axes[index], positions[index]), new_low, new_high
        if is_moved or len(xy_m) > SEARCHING.many_edges:
            break
        nearby = _best_nearby(part, sample, line, low, high, rules)
        if nearby == line.position:
            break
        axes, positions = np.full(1, line.axis), np.full(1, nearby)
        max_cost_m = min(cost_m * CUTS.off_corner_ratio, limit_m)
    return line, low, high


@allocating
def _best_nearby(part: Roofed, sample: Roofed, line: Line, low: Side, high: Side, rules: Rules):
    """The best of the position of a cut, of others a little beside it, and of the corners nearby, by roofs that are
    only improved. That of the cut if no other can be made."""
    corners = part.polygon.xy_m[:, line.axis].copy()
    sort_first(corners, len(corners))
    nearby = np.empty(1 + len(CUTS.shifts_m) + len(corners))
    nearby[0], count = line.position, 1
    for shift_m in CUTS.shifts_m:
        nearby[count] = line.position + shift_m
        count += 1
    for i in range(len(corners)):
        if abs(corners[i] - line.position) < CUTS.nearby_m and (i == 0 or corners[i] != corners[i - 1]):
            nearby[count] = corners[i]
            count += 1
    best, best_cost = line.position, np.inf
    for k in range(count):
        moved = Line(line.axis, nearby[k])
        cost, gap = 0.0, np.inf
        for is_high in (False, True):
            cost += _moved_cost_m(part, sample, line, moved, is_high, high if is_high else low, rules)
        for corner in corners:
            gap = min(gap, abs(corner - nearby[k]))
        cost *= CUTS.off_corner_ratio if gap >= _ON_CORNER_M else 1.0
        if cost < best_cost:
            best, best_cost = nearby[k], cost
    return best


@allocating
def _moved_cost_m(
    part: Roofed, sample: Roofed, line: Line, moved: Line, is_high: bool, side: Side, rules: Rules
):
    """What one side costs if a cut is moved and the roof that was fitted to that side is only improved; infinite where
    the side is not sound."""
    work = fit_work_at(rules.work_at)
    polygon = side_of_cut_at(work.code, part.polygon, moved.axis, moved.position, is_high)
    count = _count_below(part.points, moved)
    count = part.points.shape[1] - count if is_high else count
    points = _points_of_side(sample.points, moved, is_high)
    if count < rules.min_points or points.shape[1] == 0:
        return np.inf
    if not is_sound_at(work.code, polygon, rules.min_clearance_m, work.at):
        return np.inf
    on_cut_deg = _angle_on_cut(side, line)
    angle_deg = inherited_angles(
        side.polygon, side.angle_deg, polygon, moved.axis, moved.position, on_cut_deg
    )
    points = every_kth_point(points, 2 * rules.screen.effort.num_search_points)
    context = Context(rules.work_at, rules.screen, slope_prior(ZERO, 0.0))
    return count * improve_roof_at(
        work.code, polygon, points, angle_deg, side.eave_z_m, CUTS.num_rounds, context
    )


@allocating
def _angle_on_cut(side: Side, line: Line):
    """The angle of the edge on a cut."""
    xy_m, ring_offset = side.polygon
    for ring in range(len(ring_offset) - 1):
        for i in range(ring_offset[ring], ring_offset[ring + 1]):
            j = i + 1 if i + 1 < ring_offset[ring + 1] else ring_offset[ring]
            if xy_m[i, line.axis] == line.position and xy_m[j, line.axis] == line.position:
                return side.angle_deg[i]
    return 90.0


@allocating
def _count_below(points: np.ndarray, line: Line):
    count = 0
    for k in range(points.shape[1]):
        if points[line.axis, k] < line.position:
            count += 1
    return count


@allocating
def _points_of_side(points: np.ndarray, line: Line, is_high: bool):
    """The points (3, m) that are on one side of a cut."""
    count = 0
    for k in range(points.shape[1]):
        if (points[line.axis, k] >= line.position) == is_high:
            count += 1
    result = np.empty((3, count))
    count = 0
    for k in range(points.shape[1]):
        if (points[line.axis, k] >= line.position) == is_high:
            result[0, count], result[1, count], result[2, count] = points[0, k], points[1, k], points[2, k]
            count += 1
    return result


@entry
def fit_side(
    part: Roofed,
    line: Line,
    is_high: bool,
    min_points: int,
    max_points: int,
    min_clearance_m: float,
    context: Context,
):
    """One side of a cut, fitted to at most ``max_points`` of its points. The loss is ``IMPOSSIBLE`` if the side has
    fewer than ``min_points`` or is not sound."""
    work, effort = fit_work_at(context.work_at), context.settings.effort
    polygon = side_of_cut_at(work.code, part.polygon, line.axis, line.position, is_high)
    points = _points_of_side(part.points, line, is_high)
    if points.shape[1] < min_points or not is_sound_at(work.code, polygon, min_clearance_m, context.work_at):
        return Side(IMPOSSIBLE, 0.0, part.angle_deg, polygon)
    if len(polygon.xy_m) > SEARCHING.many_edges and effort.num_descents == 0:
        guess = np.zeros(len(polygon.xy_m))
    else:
        guess = inherited_angles(part.polygon, part.angle_deg, polygon, line.axis, line.position, 90.0)
    points = every_kth_point(points, max_points)
    loss, eave, angle = fit_roof_at(work.code, polygon, points, guess.reshape(1, -1), context)
    return Side(loss, eave, angle, polygon)


fit_side_at = by_address(fit_side)


@allocating
def _screened_costs(
    sample: Roofed,
    axes: np.ndarray,
    positions: np.ndarray,
    num_low: np.ndarray,
    num_points: int,
    limit_m: float,
    rules: Rules,
):
    """What each of several cuts costs by a fit to few points; ``IMPOSSIBLE`` if that is more than ``limit_m`` or far
    more than the best."""
    work = fit_work_at(rules.work_at)
    context = Context(rules.work_at, rules.screen, slope_prior(ZERO, 0.0))
    costs, min_cost = np.full(len(axes), IMPOSSIBLE), IMPOSSIBLE
    for c in range(len(axes)):
        if min(num_low[c], num_points - num_low[c]) < rules.min_points:
            continue
        # the side with more points first: what it costs alone often decides
        cost, is_larger_high = 0.0, 2 * num_low[c] < num_points
        for is_high in (is_larger_high, not is_larger_high):
            side = fit_side_at(
                work.code, sample, Line(axes[c], positions[c]), is_high, 1, rules.screen.effort.num_search_points,
                rules.min_clearance_m, context,
            )  # fmt: skip
            if side.loss_m >= IMPOSSIBLE:
                cost = IMPOSSIBLE
                break
            cost += side.loss_m * (num_points - num_low[c] if is_high else num_low[c])
            if is_high == is_larger_high and cost > min(CUTS.finalist_ratio * min_cost, limit_m):
                cost = IMPOSSIBLE
                break
        costs[c] = min(cost, IMPOSSIBLE)
        min_cost = min(min_cost, cost)
    return costs


@allocating
def _best_cut(
    part: Roofed, sample: Roofed, axes: np.ndarray, positions: np.ndarray, limit_m: float, rules: Rules
):
    """(cost, index, low side, high side) of the best of several cuts through a part, across x (axis 0) or y (axis 1).
    The index is -1 if no cut costs less than ``limit_m``.

    sample: of the part, which is fitted first, by which most cuts are dropped. The second side of a cut is not fitted
    if the first alone costs too much.
    """
    m = part.points.shape[1]
    num_low = np.empty(len(axes), np.int64)
    for c in range(len(axes)):
        num_low[c] = _count_below(part.points, Line(axes[c], positions[c]))
    order, num_tried = np.arange(len(axes)), len(axes)
    if num_tried > CUTS.num_fitted:
        max_cost_m = CUTS.limit_ratio * limit_m
        costs = _screened_costs(sample, axes, positions, num_low, m, max_cost_m, rules)
        order = stable_order(costs)
        highest = min(CUTS.finalist_ratio * costs[order[0]], max_cost_m, 0.5 * IMPOSSIBLE)
        num_tried = CUTS.num_fitted
        while num_tried > 0 and costs[order[num_tried - 1]] > highest:
            num_tried -= 1
    best, best_cost = -1, limit_m
    best_low = best_high = Side(IMPOSSIBLE, 0.0, part.angle_deg, part.polygon)
    for c in order[:num_tried]:
        line = Line(axes[c], positions[c])
        if min(num_low[c], m - num_low[c]) < rules.min_points:
            continue
        num_high = m - num_low[c]
        # again the side with more points first
        is_high = num_high > num_low[c]
        count = max(num_low[c], num_high)
        first = _fit_in_full(part, line, is_high, count, rules)
        if first.loss_m >= IMPOSSIBLE or first.loss_m * count > best_cost:
            continue
        second = _fit_in_full(part, line, not is_high, m - count, rules)
        low, high = (second, first) if is_high else (first, second)
        cost = low.loss_m * num_low[c] + high.loss_m * num_high
        if cost < best_cost:
            best, best_cost, best_low, best_high = c, cost, low, high
    return best_cost, best, best_low, best_high


@allocating
def _fit_in_full(part: Roofed, line: Line, is_high: bool, num_points: int, rules: Rules):
    """One side of a cut, which has ``num_points``, with its slopes at their price."""
    work = fit_work_at(rules.work_at)
    max_edges = 2 * len(part.polygon.xy_m) + 8
    prior = slope_prior(max_edges, rules.slope_cost_m / num_points)
    context = Context(rules.work_at, rules.full, prior)
    return fit_side_at(
        work.code, part, line, is_high, rules.min_points, rules.full.effort.num_points, rules.min_clearance_m, context
    )  # fmt: skip
