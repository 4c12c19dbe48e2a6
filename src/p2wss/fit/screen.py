"""The cut through a part that promises most, found with few points and without a search of classes, and the roofs
on either side of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from p2wss.fit.cutting import (
    clearance_m,
    inherited_angles,
    is_sound_at,
    side_of_cut_at,
)
from p2wss.fit.jumps import candidates
from p2wss.fit.points import every_kth
from p2wss.fit.roof import (
    every_kth_row,
    fit_roof_at,
    improved_roof_at,
    with_flat_top,
)
from p2wss.fit.solve import IMPOSSIBLE
from p2wss.fit.work import FitWork, Prior, Settings
from p2wss.skeleton.compiled import allocating, by_address, entry, inner
from p2wss.skeleton.ordering import stable_order

_NUM_POINTS = 160
# so many of the cuts, at most so much worse than the best, are looked at again, now with roofs cut flat
_MOST_FINALISTS, _FINALIST_RATIO = 3, 1.3
_NEARBY_M = 0.35
_SHIFTS_M = np.array([-0.25, -0.12, 0.12, 0.25])
_SHIFT_ROUNDS = 2
# a cut through a corner of the footprint is preferred at this ratio of losses
_OFF_CORNER, _ON_CORNER_M = 1.02, 1e-6
# a cut that a quick look gives less than this share of what it has to gain is given up
_HOPEFUL = 0.5
# of a side
_FEWEST_POINTS = 3


class Side(NamedTuple):
    """The roof on one side of a cut, whose polygon has vertices ``xy_m`` (n, 2) and rings at ``ring_offset``.

    loss_m: mean over its points, ``IMPOSSIBLE`` if there is none. angle_deg: float64 (n,).
    """

    loss_m: float
    eave_z_m: float
    top_m: float
    angle_deg: np.ndarray
    xy_m: np.ndarray
    ring_offset: np.ndarray


def split_roof(
    xy_m: np.ndarray,
    ring_offset: np.ndarray,
    angle_deg: np.ndarray,
    points: np.ndarray,
    loss: float,
    least_gain: float,
    least_points: int,
    work: FitWork,
    screen: Settings,
    settings: Settings,
    prior: Prior,
) -> tuple[int, float, Side, Side] | None:
    """(axis, position, low side, high side) of the best cut through a part, if a quick look promises half of
    ``least_gain``; None: there is none.

    xy_m, ring_offset, angle_deg: the part and its roof. points: float64 (3, m), its points, evenly ordered.
    loss: summed over all points of the part, as ``least_gain``. least_points: on either side. screen, settings:
    of the quick fits and of those of the sides.
    """
    few = np.take(points, every_kth(points.shape[1], _NUM_POINTS), axis=1)
    clearance = clearance_m(xy_m, ring_offset, work)
    axes, positions = candidates(xy_m, *points)
    cost, chosen, *sides = best_cut(
        xy_m,
        ring_offset,
        angle_deg,
        points,
        few,
        axes,
        positions,
        least_points,
        clearance,
        work,
        screen,
        prior,
    )
    if cost >= IMPOSSIBLE or loss - cost < _HOPEFUL * least_gain:
        return None
    axis, position = int(axes[chosen]), float(positions[chosen])
    places = _places_near(xy_m, axis, position)
    costs = np.zeros(len(places))
    for is_high in (False, True):
        _, *roof = sides[is_high]
        costs += _place_costs(
            *roof, xy_m, ring_offset, few, points[axis], axis, position, is_high, places, least_points, clearance,
            work, screen, prior,
        )  # fmt: skip
    off_corner = (np.abs(xy_m[:, axis] - places[:, None]) >= _ON_CORNER_M).all(axis=1)
    costs[off_corner] *= _OFF_CORNER
    if np.isfinite(costs).any():
        position = float(places[costs.argmin()])
    low, high = (
        Side(
            *fit_side(
                xy_m, ring_offset, angle_deg, points, axis, position, is_high, _FEWEST_POINTS,
                settings.num_points, clearance, work, settings, prior,
            )
        )
        for is_high in (False, True)
    )  # fmt: skip
    return None if max(low.loss_m, high.loss_m) >= IMPOSSIBLE else (axis, position, low, high)


def _places_near(xy_m: np.ndarray, axis: int, position: float) -> np.ndarray:
    """Here, a little beside, and corners."""
    corners = np.unique(xy_m[:, axis])
    return np.concatenate([[position], position + _SHIFTS_M, corners[np.abs(corners - position) < _NEARBY_M]])


@entry
def fit_side(
    xy_m, ring_offset, angle_deg, points, axis, position, is_high, least_points, most, least_clearance_m, work,
    settings, prior,
):  # fmt: skip
    """(loss per point, eave, top, angles, vertices, offsets) of one side of a cut, fitted to at most ``most`` of
    its points; loss ``IMPOSSIBLE``: it has fewer than ``least_points``, or is not sound."""
    side_xy, side_offset = side_of_cut_at(work.code, xy_m, ring_offset, axis, position, is_high)
    own = _points_of_side(points, axis, position, is_high)
    if own.shape[1] < least_points or not is_sound_at(
        work.code, side_xy, side_offset, least_clearance_m, work
    ):
        return IMPOSSIBLE, 0.0, np.inf, angle_deg, side_xy, side_offset
    guess = inherited_angles(xy_m, ring_offset, angle_deg, side_xy, side_offset, axis, position, 90.0)
    loss, eave, top, angle = fit_roof_at(work.code, side_xy, side_offset, every_kth_row(own[0], most),
        every_kth_row(own[1], most), every_kth_row(own[2], most), guess.reshape(1, -1), work, settings, prior,
    )  # fmt: skip
    return loss, eave, top, angle, side_xy, side_offset


fit_side_at = by_address(fit_side)


@allocating
def _points_of_side(points, axis, position, is_high):
    """Of (3, m) those on one side of a cut."""
    count = 0
    for k in range(points.shape[1]):
        if (points[axis, k] >= position) == is_high:
            count += 1
    own = np.empty((3, count))
    count = 0
    for k in range(points.shape[1]):
        if (points[axis, k] >= position) == is_high:
            own[0, count], own[1, count], own[2, count] = points[0, k], points[1, k], points[2, k]
            count += 1
    return own


@entry
def best_cut(
    xy_m, ring_offset, angle_deg, points, few, axes, positions, least_points, least_clearance_m, work, settings,
    prior,
):  # fmt: skip
    """(cost, number, low side, high side) of the best of the cuts across x (axis 0) or y through a part: the loss
    over all its points, somewhat more than that of a full search; of a side as :func:`fit_side`. Cost
    ``IMPOSSIBLE``: there is none.

    xy_m, ring_offset, angle_deg: the part and its roof. points: (3, m), its points, evenly ordered; few: those
    that are fitted. least_points: on either side. settings: of the fits there. A cut whose one side alone costs
    too much is left at that.
    """
    m, most = points.shape[1], settings.num_search_points
    costs, num_low = np.empty(len(axes)), np.empty(len(axes), np.int64)
    for c in range(len(axes)):
        costs[c], num_low[c] = IMPOSSIBLE, _count_below(points[axes[c]], positions[c])
    order, num_tried = stable_order(costs), len(axes)
    best = -1
    best_low = best_high = (IMPOSSIBLE, 0.0, np.inf, angle_deg, xy_m, ring_offset)
    for flat_top in (False, True):
        own = with_flat_top(settings, flat_top)
        # what costs more is no finalist or, of them, not the best
        ratio, least_cost = 1.0 if flat_top else _FINALIST_RATIO, IMPOSSIBLE
        best = -1
        for c in order[:num_tried]:
            costs[c] = IMPOSSIBLE
            if min(num_low[c], m - num_low[c]) < least_points:
                continue
            low = fit_side_at(work.code, xy_m, ring_offset, angle_deg, few, axes[c], positions[c], False, 1,
                most, least_clearance_m, work, own, prior,
            )  # fmt: skip
            if low[0] >= IMPOSSIBLE or low[0] * num_low[c] > ratio * least_cost:
                continue
            high = fit_side_at(work.code, xy_m, ring_offset, angle_deg, few, axes[c], positions[c], True, 1,
                most, least_clearance_m, work, own, prior,
            )  # fmt: skip
            if high[0] >= IMPOSSIBLE:
                continue
            costs[c] = low[0] * num_low[c] + high[0] * (m - num_low[c])
            if costs[c] < least_cost:
                best, least_cost, best_low, best_high = c, costs[c], low, high
        order = stable_order(costs)
        num_tried = min(num_tried, _MOST_FINALISTS)
        while num_tried > 0:
            if costs[order[num_tried - 1]] <= min(_FINALIST_RATIO * costs[order[0]], 0.5 * IMPOSSIBLE):
                break
            num_tried -= 1
    return costs[best] if best >= 0 else IMPOSSIBLE, best, best_low, best_high


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


@entry
def _place_costs(
    eave, top, side_deg, side_xy, side_offset, xy_m, ring_offset, few, along, axis, position, is_high, places,
    least_points, least_clearance_m, work, settings, prior,
):  # fmt: skip
    """What a cut near ``position`` costs on one side of it, while the roof there, found for ``position``, stays
    much the same; infinite: nothing sound. along: coordinate ``axis`` of all points of the part."""
    costs = np.empty(len(places))
    most = 2 * settings.num_search_points
    on_cut = _angle_on_cut(side_xy, side_offset, side_deg, axis, position)
    for k in range(len(places)):
        place = places[k]
        new_xy, new_offset = side_of_cut_at(work.code, xy_m, ring_offset, axis, place, is_high)
        count = _count_below(along, place)
        count = len(along) - count if is_high else count
        own = _points_of_side(few, axis, place, is_high)
        costs[k] = np.inf
        if count < least_points or own.shape[1] == 0:
            continue
        if not is_sound_at(work.code, new_xy, new_offset, least_clearance_m, work):
            continue
        guess = inherited_angles(side_xy, side_offset, side_deg, new_xy, new_offset, axis, place, on_cut)
        loss = improved_roof_at(work.code, new_xy, new_offset, every_kth_row(own[0], most),
            every_kth_row(own[1], most), every_kth_row(own[2], most), guess, eave, top, _SHIFT_ROUNDS, work,
            settings, prior,
        )  # fmt: skip
        costs[k] = loss * count
    return costs
