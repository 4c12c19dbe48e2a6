"""The cut through a part that promises most, found with few points and without a search of classes, and the roofs
on either side of it."""

from __future__ import annotations

import numpy as np

from p2wss.fit.cutting import clearance_m, inherited_angles, is_sound, side_of_cut
from p2wss.fit.jumps import candidates
from p2wss.fit.roof import every_kth_row, fit_roof, improved_roof, with_flat_top
from p2wss.fit.solve import IMPOSSIBLE
from p2wss.skeleton.compiled import entry

_NUM_POINTS = 160
# so many of the cuts, at most so much worse than the best, are looked at again, now with roofs cut flat
_MOST_FINALISTS, _FINALIST_RATIO = 3, 1.3
_NEARBY_M = 0.35
_SHIFTS_M = np.array([-0.25, -0.12, 0.12, 0.25])
_SHIFT_ROUNDS = 2
# a cut through a corner of the footprint is preferred at this ratio of losses
_OFF_CORNER = 1.02
# a cut that a quick look gives less than this share of what it has to gain is given up
_HOPEFUL = 0.5
# of a side
_FEWEST_POINTS = 3


@entry
def _fit_side(
    xy_m, ring_offset, angle_deg, points, axis, position, is_high, least_clearance_m, work, settings, prior
):
    """(loss per point, eave, top, angles, vertices, offsets) of one side of a cut."""
    side_xy, side_offset = side_of_cut(xy_m, ring_offset, axis, position, is_high)
    if not is_sound(side_xy, side_offset, least_clearance_m, work):
        return IMPOSSIBLE, 0.0, np.inf, angle_deg, side_xy, side_offset
    guess = inherited_angles(xy_m, ring_offset, angle_deg, side_xy, side_offset, axis, position, 90.0)
    own = points[:, np.flatnonzero((points[axis] >= position) == is_high)]
    if own.shape[1] == 0:
        return IMPOSSIBLE, 0.0, np.inf, angle_deg, side_xy, side_offset
    most = settings.num_search_points
    loss, eave, top, angle = fit_roof(
        side_xy, side_offset, every_kth_row(own[0], most), every_kth_row(own[1], most),
        every_kth_row(own[2], most), guess.reshape(1, -1), work, settings, prior,
    )  # fmt: skip
    return loss, eave, top, angle, side_xy, side_offset


@entry
def best_cut(xy_m, ring_offset, angle_deg, x, y, z, least_points, work, settings, prior):
    """(cost, axis, position) of the best cut across x (axis 0) or y through a part: the loss over all its
    points, somewhat more than that of a full search. Cost ``IMPOSSIBLE``: there is none.

    xy_m, ring_offset, angle_deg: the part and its roof. x, y, z: its points, evenly ordered. least_points: on
    either side. settings: of the fits there. A cut whose one side alone costs too much is left at that.
    """
    m = len(z)
    least_clearance = clearance_m(xy_m, ring_offset, work)
    points = np.empty((3, min(m, _NUM_POINTS)))
    points[0], points[1] = every_kth_row(x, _NUM_POINTS), every_kth_row(y, _NUM_POINTS)
    points[2] = every_kth_row(z, _NUM_POINTS)
    axes, positions = candidates(xy_m, x, y, z)
    order, most = np.arange(len(axes)), len(axes)
    costs = np.full(len(axes), IMPOSSIBLE)
    best = -1
    best_low = best_high = (IMPOSSIBLE, 0.0, np.inf, angle_deg, xy_m, ring_offset)
    for flat_top in (False, True):
        own = with_flat_top(settings, flat_top)
        # what costs more is no finalist or, of them, not the best
        ratio, least_cost = 1.0 if flat_top else _FINALIST_RATIO, IMPOSSIBLE
        best = -1
        for c in order[:most]:
            costs[c] = IMPOSSIBLE
            num_low = _count_below(x if axes[c] == 0 else y, positions[c])
            if min(num_low, m - num_low) < least_points:
                continue
            low = _fit_side(
                xy_m, ring_offset, angle_deg, points, axes[c], positions[c], False, least_clearance, work, own,
                prior,
            )  # fmt: skip
            if low[0] >= IMPOSSIBLE or low[0] * num_low > ratio * least_cost:
                continue
            high = _fit_side(
                xy_m, ring_offset, angle_deg, points, axes[c], positions[c], True, least_clearance, work, own,
                prior,
            )  # fmt: skip
            if high[0] >= IMPOSSIBLE:
                continue
            costs[c] = low[0] * num_low + high[0] * (m - num_low)
            if costs[c] < least_cost:
                best, least_cost, best_low, best_high = c, costs[c], low, high
        order = np.argsort(costs, kind="mergesort")
        most = min(most, _MOST_FINALISTS)
        while most > 0 and costs[order[most - 1]] > min(_FINALIST_RATIO * costs[order[0]], 0.5 * IMPOSSIBLE):
            most -= 1
    if best < 0:
        return IMPOSSIBLE, 0, 0.0
    place = _best_place(
        xy_m, ring_offset, best_low, best_high, points, x if axes[best] == 0 else y, axes[best], positions[best],
        least_points, least_clearance, work, settings, prior,
    )  # fmt: skip
    return costs[best], axes[best], place


@entry
def _roof_of_side(xy_m, ring_offset, angle_deg, x, y, z, axis, position, is_high, work, settings, prior):
    """(loss per point, eave, top, angles, vertices, offsets) of one side of a cut, searched in full."""
    side_xy, side_offset = side_of_cut(xy_m, ring_offset, axis, position, is_high)
    own = np.flatnonzero(((x if axis == 0 else y) >= position) == is_high)
    if len(own) < _FEWEST_POINTS:
        return IMPOSSIBLE, 0.0, np.inf, angle_deg, side_xy, side_offset
    guess = inherited_angles(xy_m, ring_offset, angle_deg, side_xy, side_offset, axis, position, 90.0)
    most = settings.num_points
    loss, eave, top, angle = fit_roof(
        side_xy, side_offset, every_kth_row(x[own], most), every_kth_row(y[own], most),
        every_kth_row(z[own], most), guess.reshape(1, -1), work, settings, prior,
    )  # fmt: skip
    return loss, eave, top, angle, side_xy, side_offset


@entry
def split_roof(
    xy_m, ring_offset, angle_deg, x, y, z, loss, least_gain, least_points, work, screen, settings, prior
):  # fmt: skip
    """(axis, position, low side, high side) of the best cut through a part, if a quick look promises half of
    ``least_gain``; axis -1: there is none. Of a side: (loss per point, eave, top, angles, vertices, offsets).

    Arguments: of :func:`best_cut`. loss: summed over all points of the part, as ``least_gain``. screen, settings:
    of the quick fits and of those of the sides.
    """
    cost, axis, position = best_cut(xy_m, ring_offset, angle_deg, x, y, z, least_points, work, screen, prior)
    low = (IMPOSSIBLE, 0.0, np.inf, angle_deg, xy_m, ring_offset)
    if cost >= IMPOSSIBLE or loss - cost < _HOPEFUL * least_gain:
        return -1, position, low, low
    low = _roof_of_side(
        xy_m, ring_offset, angle_deg, x, y, z, axis, position, False, work, settings, prior
    )  # fmt: skip
    high = _roof_of_side(
        xy_m, ring_offset, angle_deg, x, y, z, axis, position, True, work, settings, prior
    )  # fmt: skip
    if low[0] >= IMPOSSIBLE or high[0] >= IMPOSSIBLE:
        return -1, position, low, high
    return axis, position, low, high


@entry
def _count_below(along, position):
    count = 0
    for k in range(len(along)):
        if along[k] < position:
            count += 1
    return count


@entry
def _places_near(xy_m, axis, position):
    """Here, a little beside, and corners."""
    corners = np.unique(xy_m[:, axis])
    corners = corners[np.abs(corners - position) < _NEARBY_M]
    return np.concatenate((np.array([position]), position + _SHIFTS_M, corners))


@entry
def _angle_on_cut(xy_m, ring_offset, angle_deg, axis, position):
    for ring in range(len(ring_offset) - 1):
        for i in range(ring_offset[ring], ring_offset[ring + 1]):
            j = i + 1 if i + 1 < ring_offset[ring + 1] else ring_offset[ring]
            if xy_m[i, axis] == position and xy_m[j, axis] == position:
                return angle_deg[i]
    return 90.0


@entry
def _best_place(
    xy_m, ring_offset, low, high, points, along, axis, position, least_points, least_clearance_m, work, settings, prior
):  # fmt: skip
    """Where near ``position`` the cut is best, while the roofs on either side stay much the same: ``low`` and
    ``high``, as :func:`_fit_side` has them."""
    places = _places_near(xy_m, axis, position)
    costs = np.zeros(len(places))
    most = 2 * settings.num_search_points
    for is_high in (False, True):
        _, eave, top, side_deg, side_xy, side_offset = high if is_high else low
        on_cut = _angle_on_cut(side_xy, side_offset, side_deg, axis, position)
        for k in range(len(places)):
            place = places[k]
            new_xy, new_offset = side_of_cut(xy_m, ring_offset, axis, place, is_high)
            count = _count_below(along, place)
            count = len(along) - count if is_high else count
            own = points[:, np.flatnonzero((points[axis] >= place) == is_high)]
            if (
                count < least_points
                or own.shape[1] == 0
                or not is_sound(new_xy, new_offset, least_clearance_m, work)
            ):
                costs[k] = np.inf
                continue
            guess = inherited_angles(side_xy, side_offset, side_deg, new_xy, new_offset, axis, place, on_cut)
            loss = improved_roof(
                new_xy, new_offset, every_kth_row(own[0], most), every_kth_row(own[1], most),
                every_kth_row(own[2], most), guess, eave, top, _SHIFT_ROUNDS, work, settings, prior,
            )  # fmt: skip
            costs[k] += loss * count
    for k in range(len(places)):
        if not (np.abs(xy_m[:, axis] - places[k]) < 1e-6).any():
            costs[k] *= _OFF_CORNER
    return places[np.argmin(costs)] if np.isfinite(costs).any() else position
