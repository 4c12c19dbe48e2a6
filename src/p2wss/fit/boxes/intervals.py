"""The rectangle with a flat top that lowers the residuals of a roof most, grown from a few points, as compiled code."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from p2wss.fit.parts.jumps import quantile
from p2wss.skeleton.compiled import ONE, ZERO, allocating, entry, inner
from p2wss.skeleton.ordering import sort_first

_NUM_ROUNDS = 6
# a side lies midway between the points on either side of it, but never further than this from those inside
_MAX_GAP_M = 0.3
# how far a box extends below a rising roof, so that it ends inside the roof without a wall
_INTO_ROOF_M = 1.0


class Survey(NamedTuple):
    """Points and the roof over them, each (m,). roof_z: height of the roof over each point; slant: z of its unit
    normal. before: its residual, at most the cap. order_x, order_y: indices that sort the points along the axes."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    roof_z: np.ndarray
    slant: np.ndarray
    before: np.ndarray
    order_x: np.ndarray
    order_y: np.ndarray

    def of(self, around: np.ndarray) -> Survey:
        """The survey of the points that ``around``, bool (m,), chooses."""
        number = np.cumsum(around) - 1
        orders = (number[order[around[order]]] for order in (self.order_x, self.order_y))
        return Survey(*(values[around] for values in self[:6]), *orders)


@entry
def grow_box(survey: Survey, seed: np.ndarray, sign: int, above_m: float, cap_m: float, min_points: int):
    """(gain in metres of loss, low corner, high corner, top) of the box that gains most, from that around the points
    ``seed``: alternately the best interval along each axis, exactly, and the top.

    sign: 1 for a box above the roof, -1 for a recess. above_m, min_points: at least so many points in the box are half
    so far off the roof. cap_m: larger residuals count as this.
    """
    x, y, z, roof_z = survey.x, survey.y, survey.z, survey.roof_z
    m = len(x)
    gain, buffer = np.empty(m), np.empty(m)
    low, high = np.empty(2), np.empty(2)
    for axis in range(2):
        position = x if axis == 0 else y
        for i in range(len(seed)):
            buffer[i] = position[seed[i]]
        sort_first(buffer, len(seed))
        low[axis] = quantile(buffer, len(seed), 0.02) - 1e-6
        high[axis] = quantile(buffer, len(seed), 0.98) + 1e-6
    for i in range(len(seed)):
        buffer[i] = z[seed[i]]
    top = _median(buffer, len(seed))
    best_total, best_low, best_high, best_top = 0.0, low.copy(), high.copy(), top
    for _ in range(_NUM_ROUNDS):
        for k in range(m):
            gain[k] = survey.before[k] - min(abs(z[k] - top), cap_m) if sign * (top - roof_z[k]) > 0 else 0.0
        for axis in range(2):
            position, across = (x, y) if axis == 0 else (y, x)
            order = survey.order_x if axis == 0 else survey.order_y
            is_any, new_low, new_high = _interval(
                position, across, gain, order, low[1 - axis], high[1 - axis], buffer
            )
            if not is_any:
                return best_total, best_low, best_high, best_top
            low[axis], high[axis] = new_low, new_high
        total, count = 0.0, ZERO
        for k in range(m):
            if low[0] <= x[k] <= high[0] and low[1] <= y[k] <= high[1]:
                total += gain[k]
                if sign * (z[k] - roof_z[k]) * survey.slant[k] > 0.5 * above_m:
                    buffer[count] = z[k]
                    count += 1
        if total <= best_total + 1e-9 or count < min_points:
            break
        best_total, best_top = total, top
        for axis in range(2):
            best_low[axis], best_high[axis] = low[axis], high[axis]
        top = _median(buffer, count)
    return best_total, best_low, best_high, best_top


@inner
def _median(values: np.ndarray, count: int):
    sort_first(values, count)
    return quantile(values, count, 0.5)


@allocating
def _interval(
    position: np.ndarray,
    across: np.ndarray,
    gain: np.ndarray,
    order: np.ndarray,
    low_across: float,
    high_across: float,
    along: np.ndarray,
):
    """(whether there is any, its ends): the interval with the greatest sum of gains of the points of a strip. An end
    lies midway to the next point that a longer interval would change, and further on below a rising roof (see
    :func:`_end`)."""
    count, number = ZERO, np.empty(len(order), np.int64)
    for k in order:
        if low_across <= across[k] <= high_across:
            number[count], along[count] = k, position[k]
            count += 1
    if count == 0:
        return False, 0.0, 0.0
    best_sum, first, last = -np.inf, ZERO, ZERO
    total, start = 0.0, ZERO
    for i in range(count):
        if total <= 0.0:
            total, start = 0.0, i
        total += gain[number[i]]
        if total > best_sum:
            best_sum, first, last = total, start, i
    low = -_end(along, gain, number, first, -ONE, count)
    return True, low, _end(along, gain, number, last, ONE, count)


@inner
def _end(along: np.ndarray, gain: np.ndarray, number: np.ndarray, place: int, step: int, count: int):
    """The end of an interval at the point ``place``, outwards in the direction ``step``, as a distance in that
    direction. Points whose residual the box does not change, as the roof is higher there, count as below a rising
    roof."""
    here = step * along[place]
    num_below, last_below, i = 1, here, place + step
    while 0 <= i < count and gain[number[i]] == 0.0:
        last_below = step * along[i]
        num_below += 1
        i += step
    gap = step * along[i] - here if 0 <= i < count else np.inf
    if gap > _INTO_ROOF_M and num_below > 1:
        return min(last_below, here + _INTO_ROOF_M)
    return here + min(0.5 * gap, _MAX_GAP_M)
