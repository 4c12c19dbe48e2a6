"""The most promising cut through a part, chosen with few points and without a search of classes, and the roofs on
either side of it."""

from __future__ import annotations

import numpy as np

from p2wss.fit.parts.cutting import (
    clearance_m,
    inherited_angles,
    is_sound_at,
    side_of_cut_at,
)
from p2wss.fit.parts.jumps import candidates
from p2wss.fit.roof.rounds import (
    every_kth_value,
    fit_roof_at,
    improve_roof_at,
    with_flat_top,
)
from p2wss.fit.roof.search import MANY_EDGES
from p2wss.fit.roof.solve import IMPOSSIBLE
from p2wss.fit.roof.work import NO_PRIOR, Prior, fit_work_at
from p2wss.skeleton.compiled import ZERO, allocating, by_address, entry, inner
from p2wss.skeleton.ordering import sort_first, stable_order

_NUM_POINTS = np.int64(160)
# this many of the cuts, if their cost is at most this multiple of the best, are evaluated again with flat tops; the
# best of them are fitted in full
_MAX_FINALISTS, _FINALIST_RATIO, _NUM_FITTED = 6, 1.4, 2
# nor are cuts evaluated any further that cost more than this multiple of what they may
_LIMIT_RATIO = 1.2
_NEARBY_M = 0.35
_SHIFTS_M = np.array([-0.25, -0.12, 0.12, 0.25])
_SHIFT_ROUNDS = 2
# a cut beside the corners of the footprint has to be better than one through a corner by this ratio
_OFF_CORNER_RATIO, _ON_CORNER_M = 1.02, 1e-6


@entry
def split_roof(
    xy_m, ring_offset, angle_deg, points, limit_m, min_points, slope_cost_m, work_at, screen, settings
):  # fmt: skip
    """(axis, position, low side, high side) of the best cut through a part; the axis is -1 if no cut costs less than
    ``limit_m``. The sides are as :func:`fit_side` returns them.

    xy_m, ring_offset, angle_deg: the part and its roof. points: float64 (3, m), its points in even order. A cut costs
    the sum of the residuals and ``slope_cost_m`` for each slope. min_points: on either side. screen: settings of the
    quick fits. settings: of the fits of the two sides.
    """
    work = fit_work_at(work_at)
    sample = _every_kth_point(points, _NUM_POINTS)
    clearance = clearance_m(xy_m, ring_offset, work_at)
    axes, positions = candidates(xy_m, points[0], points[1], points[2])
    max_cost_m = limit_m
    axis, position = -1, 0.0
    low = high = (IMPOSSIBLE, 0.0, np.inf, angle_deg, xy_m, ring_offset)
    for is_moved in (False, True):
        cost_m, index, new_low, new_high = best_cut(
            xy_m, ring_offset, angle_deg, points, sample, axes, positions, min_points, clearance, work, screen,
            settings, slope_cost_m, max_cost_m,
        )  # fmt: skip
        if index < 0:
            break
        axis, position, low, high = axes[index], positions[index], new_low, new_high
        if is_moved or len(xy_m) > MANY_EDGES:
            break
        nearby = _best_nearby(
            xy_m, ring_offset, points, sample, axis, position, low, high, min_points, clearance, work, screen
        )
        if nearby == position:
            break
        axes, positions = axes[:1], positions[:1]
        axes[0], positions[0] = axis, nearby
        max_cost_m = min(cost_m * _OFF_CORNER_RATIO, limit_m)
    return axis, position, low, high


@allocating
def _every_kth_point(points, max_count):
    """At most ``max_count`` of the points (3, m), evenly spaced."""
    num = min(points.shape[1], max_count)
    result = np.empty((3, num))
    for axis in range(3):
        values = every_kth_value(points[axis], max_count)
        for k in range(num):
            result[axis, k] = values[k]
    return result


@allocating
def _best_nearby(
    xy_m, ring_offset, points, sample, axis, position, low, high, min_points, min_clearance_m, work, screen
):  # fmt: skip
    """The best of a position, of others a little beside it, and of the corners nearby, by roofs that are only improved.
    The position itself if no cut can be made."""
    corners = xy_m[:, axis].copy()
    sort_first(corners, len(corners))
    nearby = np.empty(1 + len(_SHIFTS_M) + len(corners))
    nearby[0], count = position, 1
    for shift in _SHIFTS_M:
        nearby[count] = position + shift
        count += 1
    for i in range(len(corners)):
        if abs(corners[i] - position) < _NEARBY_M and (i == 0 or corners[i] != corners[i - 1]):
            nearby[count] = corners[i]
            count += 1
    nearby, costs = nearby[:count], np.zeros(count)
    for is_high in (False, True):
        _, eave, top, side_deg, side_xy, side_offset = high if is_high else low
        costs += _costs_of_positions(
            eave, top, side_deg, side_xy, side_offset, xy_m, ring_offset, sample, points[axis], axis, position,
            is_high, nearby, min_points, min_clearance_m, work, screen, NO_PRIOR,
        )  # fmt: skip
    best, best_cost = position, np.inf
    for k in range(count):
        gap = np.inf
        for corner in corners:
            gap = min(gap, abs(corner - nearby[k]))
        cost = costs[k] * _OFF_CORNER_RATIO if gap >= _ON_CORNER_M else costs[k]
        if cost < best_cost:
            best, best_cost = nearby[k], cost
    return best


@entry
def fit_side(
    xy_m, ring_offset, angle_deg, points, axis, position, is_high, min_points, max_points, min_clearance_m,
    known_deg, known_loss, known_eave, work_at, settings, prior,
):  # fmt: skip
    """(loss per point, eave, top, angles, vertices, offsets) of one side of a cut, fitted to at most ``max_points`` of
    its points. The loss is ``IMPOSSIBLE`` if the side has fewer than ``min_points`` or is not sound. known_deg,
    known_loss, known_eave: what this function returned without flat tops; else ``IMPOSSIBLE`` as the loss."""
    work = fit_work_at(work_at)
    side_xy, side_offset = side_of_cut_at(work.code, xy_m, ring_offset, axis, position, is_high)
    side_points = _points_of_side(points, axis, position, is_high)
    is_known = known_loss < IMPOSSIBLE
    if side_points.shape[1] < min_points or not (
        is_known or is_sound_at(work.code, side_xy, side_offset, min_clearance_m, work_at)
    ):
        return IMPOSSIBLE, 0.0, np.inf, angle_deg, side_xy, side_offset
    guess = known_deg
    if len(side_xy) > MANY_EDGES and settings.num_descents == 0:
        guess = np.zeros(len(side_xy))
    elif not is_known:
        guess = inherited_angles(xy_m, ring_offset, angle_deg, side_xy, side_offset, axis, position, 90.0)
    loss, eave, top, angle = fit_roof_at(
        work.code, side_xy, side_offset, every_kth_value(side_points[0], max_points),
        every_kth_value(side_points[1], max_points), every_kth_value(side_points[2], max_points),
        guess.reshape(1, -1), known_loss, known_eave, work_at, settings, prior,
    )  # fmt: skip
    return loss, eave, top, angle, side_xy, side_offset


fit_side_at = by_address(fit_side)


@allocating
def _points_of_side(points, axis, position, is_high):
    """The points (3, m) that are on one side of a cut."""
    count = 0
    for k in range(points.shape[1]):
        if (points[axis, k] >= position) == is_high:
            count += 1
    result = np.empty((3, count))
    count = 0
    for k in range(points.shape[1]):
        if (points[axis, k] >= position) == is_high:
            result[0, count], result[1, count], result[2, count] = points[0, k], points[1, k], points[2, k]
            count += 1
    return result


@allocating
def slope_prior(num_edges, cost_m):
    """A prior for which each slope costs ``cost_m`` in the mean, and nothing else costs anything."""
    class_cost_m = np.zeros((num_edges, 3))
    for e in range(num_edges):
        class_cost_m[e, 2] = cost_m
    return Prior(class_cost_m, np.full(num_edges, 38.0), 0.0, np.zeros(0), 0.0)


@allocating
def best_cut(
    xy_m, ring_offset, angle_deg, points, sample, axes, positions, min_points, min_clearance_m, work, screen,
    settings, slope_cost_m, limit_m,
):  # fmt: skip
    """(cost, index, low side, high side) of the best of several cuts through a part, across x (axis 0) or y (axis 1).
    The cost is the loss summed over all points and ``slope_cost_m`` for each slope; the index is -1 if no cut costs
    less than ``limit_m``. The sides are as :func:`fit_side` returns them.

    xy_m, ring_offset, angle_deg: the part and its roof. points: (3, m), its points in even order; sample: those that
    are fitted first, by which most cuts are dropped. min_points: on either side. screen, settings: of the fits to the
    sample and of those to all points. The second side of a cut is not fitted if the first alone costs too much.
    """
    m, max_points, max_edges = points.shape[1], screen.num_search_points, 2 * len(xy_m) + 8
    # what the first round finds for either side of each cut: loss, eave, number of edges; and the angles
    known, known_deg = np.full((len(axes), 2, 3), IMPOSSIBLE), np.empty((len(axes), 2, max_edges))
    costs, num_low = np.empty(len(axes)), np.empty(len(axes), np.int64)
    for c in range(len(axes)):
        costs[c], num_low[c] = IMPOSSIBLE, _count_below(points[axes[c]], positions[c])
    no_prior, no_angles = slope_prior(ZERO, 0.0), np.empty(0)
    order, num_tried = stable_order(costs), len(axes)
    max_screened_cost = _LIMIT_RATIO * limit_m
    if num_tried > _NUM_FITTED:
        for flat_top in (False, True):
            round_settings = with_flat_top(screen, flat_top)
            min_cost = IMPOSSIBLE
            for c in order[:num_tried]:
                costs[c] = IMPOSSIBLE
                if min(num_low[c], m - num_low[c]) < min_points:
                    continue
                # the side with more points first: what it costs alone often decides
                cost, larger = 0.0, int(2 * num_low[c] < m)
                for side in (larger, 1 - larger):
                    count = m - num_low[c] if side else num_low[c]
                    num_known = int(known[c, side, 2]) if flat_top else 0
                    result = fit_side_at(
                        work.code, xy_m, ring_offset, angle_deg, sample, axes[c], positions[c], side == 1, 1,
                        max_points, min_clearance_m, known_deg[c, side, :num_known], known[c, side, 0],
                        known[c, side, 1], work.at, round_settings, no_prior,
                    )  # fmt: skip
                    if result[0] >= IMPOSSIBLE:
                        cost = IMPOSSIBLE
                        break
                    cost += result[0] * count
                    if not flat_top:
                        num_edges = len(result[3])
                        known[c, side, 0], known[c, side, 1], known[c, side, 2] = (
                            result[0],
                            result[1],
                            num_edges,
                        )
                        known_deg[c, side, :num_edges] = result[3]
                    if side == larger and cost > min(_FINALIST_RATIO * min_cost, max_screened_cost):
                        cost = IMPOSSIBLE
                        break
                if cost >= IMPOSSIBLE:
                    continue
                costs[c] = cost
                min_cost = min(min_cost, costs[c])
            order = stable_order(costs)
            num_tried = min(num_tried, _NUM_FITTED if flat_top else _MAX_FINALISTS)
            while num_tried > 0:
                highest = min(_FINALIST_RATIO * costs[order[0]], max_screened_cost, 0.5 * IMPOSSIBLE)
                if costs[order[num_tried - 1]] <= highest:
                    break
                num_tried -= 1
    best, best_cost = -1, limit_m
    best_low = best_high = (IMPOSSIBLE, 0.0, np.inf, angle_deg, xy_m, ring_offset)
    for c in order[:num_tried]:
        if min(num_low[c], m - num_low[c]) < min_points:
            continue
        num_high = m - num_low[c]
        # again the side with more points first
        is_high = num_high > num_low[c]
        count = max(num_low[c], num_high)
        first = fit_side_at(work.code, xy_m, ring_offset, angle_deg, points, axes[c], positions[c], is_high, min_points,
            settings.num_points, min_clearance_m, no_angles, IMPOSSIBLE, 0.0, work.at, settings,
            slope_prior(max_edges, slope_cost_m / count),
        )  # fmt: skip
        if first[0] >= IMPOSSIBLE or first[0] * count > best_cost:
            continue
        second = fit_side_at(work.code, xy_m, ring_offset, angle_deg, points, axes[c], positions[c], not is_high,
            min_points, settings.num_points, min_clearance_m, no_angles, IMPOSSIBLE, 0.0, work.at, settings,
            slope_prior(max_edges, slope_cost_m / (m - count)),
        )  # fmt: skip
        low, high = (second, first) if is_high else (first, second)
        cost = low[0] * num_low[c] + high[0] * num_high
        if cost < best_cost:
            best, best_cost, best_low, best_high = c, cost, low, high
    return best_cost, best, best_low, best_high


@inner
def _count_below(along, position):
    count = 0
    for k in range(len(along)):
        if along[k] < position:
            count += 1
    return count


@inner
def _angle_on_cut(xy_m, ring_offset, angle_deg, axis, position):
    for ring in range(len(ring_offset) - 1):
        for i in range(ring_offset[ring], ring_offset[ring + 1]):
            j = i + 1 if i + 1 < ring_offset[ring + 1] else ring_offset[ring]
            if xy_m[i, axis] == position and xy_m[j, axis] == position:
                return angle_deg[i]
    return 90.0


@allocating
def _costs_of_positions(
    eave, top, side_deg, side_xy, side_offset, xy_m, ring_offset, sample, along, axis, position, is_high, positions,
    min_points, min_clearance_m, work, settings, prior,
):  # fmt: skip
    """Costs of cuts at ``positions`` near ``position`` on one side, where the roof that was fitted for ``position``
    is only improved; infinite where the side is not sound. along: coordinate ``axis`` of all points of the part."""
    costs = np.empty(len(positions))
    max_points = 2 * settings.num_search_points
    on_cut = _angle_on_cut(side_xy, side_offset, side_deg, axis, position)
    for k in range(len(positions)):
        new_position = positions[k]
        new_xy, new_offset = side_of_cut_at(work.code, xy_m, ring_offset, axis, new_position, is_high)
        count = _count_below(along, new_position)
        count = len(along) - count if is_high else count
        side_points = _points_of_side(sample, axis, new_position, is_high)
        costs[k] = np.inf
        if count < min_points or side_points.shape[1] == 0:
            continue
        if not is_sound_at(work.code, new_xy, new_offset, min_clearance_m, work.at):
            continue
        guess = inherited_angles(
            side_xy, side_offset, side_deg, new_xy, new_offset, axis, new_position, on_cut
        )
        loss = improve_roof_at(
            work.code, new_xy, new_offset, every_kth_value(side_points[0], max_points),
            every_kth_value(side_points[1], max_points), every_kth_value(side_points[2], max_points), guess, eave,
            top, _SHIFT_ROUNDS, work.at, settings, prior,
        )  # fmt: skip
        costs[k] = loss * count
    return costs
