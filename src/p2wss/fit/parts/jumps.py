"""Positions at which straight cuts through a footprint may separate roofs of different heights."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import ONE, ZERO, allocating, inner
from p2wss.skeleton.ordering import sort_first, stable_order

_STEP_M, _BIN_M = 0.25, 1.2
# points at these distances from a line show the height on either side
_NEAR_M, _FAR_M = 0.1, 0.9
# both distances grow where the points are sparser than this spacing
_DENSE_M = 0.4
_MAX_JUMP_M = 2.0
_MARGIN_M = 0.8
_MIN_SCORE_M2 = 0.25
_MIN_SPACING_M = 0.7
# at most this many jumps and as many corners per axis, and one more for each of these metres
_MIN_LINES, _LINE_EVERY_M = 4, 5.0
# corners within this distance of a jump are tried with it
_CORNER_M, _MARGIN_AT_CORNERS_M = 0.3, 0.9


@inner
def quantile(ordered: np.ndarray, count: int, share: float):
    """The quantile ``share`` of the first ``count`` values, which are in order."""
    place = share * (count - 1)
    low = int(place)
    high = min(low + 1, count - 1)
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])


@inner
def _extent(values):
    low, high = values[0], values[0]
    for value in values:
        low, high = min(low, value), max(high, value)
    return low, high


@allocating
def _by_cell(cell: np.ndarray, num_cells: int):
    """(indices of the points (m,) by the number of their cell, where each cell begins there)."""
    order, first = np.empty(len(cell), np.int64), np.zeros(num_cells + 2, np.int64)
    for number in cell:
        first[number + 2] += 1
    for number in range(num_cells):
        first[number + 2] += first[number + 1]
    for k in range(len(cell)):
        order[first[cell[k] + 1]] = k
        first[cell[k] + 1] += 1
    return order, first


@inner
def _merge_by_height(
    along: np.ndarray, z: np.ndarray, count: int, new_along: np.ndarray, new_z: np.ndarray, num_new: int
):
    """Adds ``num_new`` points to the first ``count``; both are in order of height."""
    k = count
    for new in range(num_new - 1, -1, -1):
        while k > 0 and z[k - 1] > new_z[new]:
            along[k + new], z[k + new] = along[k - 1], z[k - 1]
            k -= 1
        along[k + new], z[k + new] = new_along[new], new_z[new]


@allocating
def jump_scores(
    along: np.ndarray, across: np.ndarray, z: np.ndarray, lines: np.ndarray, low_m: float, high_m: float
):
    """How much of a jump there is across each of the ``lines`` (ascending positions in ``along``), in square metres:
    the difference of the medians on either side beyond what slopes explain, at most 2 m, summed over strips.

    along, across, z: float64 (m,), coordinates of points. low_m, high_m: extent of the polygon in ``across``.
    """
    low_along, high_along = _extent(along)
    spacing_m = np.sqrt((high_m - low_m) * (high_along - low_along) / len(z))
    stretch = max(1.0, spacing_m / _DENSE_M)
    num_bins = max(1, int((high_m - low_m) / (_BIN_M * stretch)))
    width = (high_m - low_m) / num_bins
    # the points by strip, and along each by steps
    num_steps = 2 + int((high_along - low_along) / _STEP_M)
    cell = np.empty(len(z), np.int64)
    for k in range(len(z)):
        strip = min(max(int((across[k] - low_m) / width), 0), num_bins - 1)
        cell[k] = strip * num_steps + int((along[k] - low_along) / _STEP_M)
    order, first = _by_cell(cell, num_bins * num_steps)
    # the points near a line in order of height: most of them are near the next line too
    near_along, near_z = np.empty(len(z)), np.empty(len(z))
    new_along, new_z = np.empty(len(z)), np.empty(len(z))
    before, after = np.empty(len(z)), np.empty(len(z))
    score = np.zeros(len(lines))
    far_m = _FAR_M * stretch
    for b in range(num_bins):
        count, step = ZERO, ZERO
        for i in range(len(lines)):
            num_new = ZERO
            # one step early, so that rounding leaves no point out
            while step < num_steps and low_along + (step - 1) * _STEP_M < lines[i] + far_m:
                for k in order[first[b * num_steps + step] : first[b * num_steps + step + 1]]:
                    _merge_by_height(new_along, new_z, num_new, along[k : k + 1], z[k : k + 1], ONE)
                    num_new += 1
                step += 1
            _merge_by_height(near_along, near_z, count, new_along, new_z, num_new)
            # without branches, which are slow where every other one is taken
            num_near, count = count + num_new, ZERO
            left, right = ZERO, ZERO
            for c in range(num_near):
                offset = near_along[c] - lines[i]
                before[left] = after[right] = near_z[c]
                left += int((offset > -far_m) & (offset < -_NEAR_M))
                right += int((offset > _NEAR_M) & (offset < far_m))
                near_along[count], near_z[count] = near_along[c], near_z[c]
                count += int(offset > -far_m)
            if left < 3 or right < 3:
                continue
            jump = abs(quantile(before, left, 0.5) - quantile(after, right, 0.5))
            spread = quantile(before, left, 0.9) - quantile(before, left, 0.1)
            spread += quantile(after, right, 0.9) - quantile(after, right, 0.1)
            score[i] += min(max(jump - 0.5 * spread, 0.0), _MAX_JUMP_M) * width
    return score


@allocating
def candidates(xy_m: np.ndarray, points: np.ndarray):
    """(axes, positions) of cuts to try through a polygon with points (3, m): per axis the clearest jumps, at least
    0.7 m apart, and corners; four of each at most, and one more for every 5 m."""
    max_lines = np.empty(2, np.int64)
    for axis in range(2):
        low, high = _extent(xy_m[:, axis].copy())
        max_lines[axis] = _MIN_LINES + int((high - low) / _LINE_EVERY_M)
    size = 2 * (max_lines[0] + max_lines[1])
    axes, positions = np.empty(size, np.int64), np.empty(size)
    count = ZERO
    for axis in range(2):
        corners = xy_m[:, axis].copy()
        sort_first(corners, len(corners))
        low, high = corners[0], corners[-1]
        first = count
        num_lines = int(np.ceil((high - low - 2 * _MARGIN_M) / _STEP_M))
        if num_lines > 0:
            lines = np.empty(num_lines)
            for i in range(num_lines):
                lines[i] = low + _MARGIN_M + _STEP_M * i
            low_across, high_across = _extent(xy_m[:, 1 - axis].copy())
            score = jump_scores(points[axis], points[1 - axis], points[2], lines, low_across, high_across)
            for i in stable_order(-score):
                if score[i] <= _MIN_SCORE_M2 or count == first + max_lines[axis]:
                    break
                if _is_apart(positions, first, count, lines[i], _MIN_SPACING_M):
                    axes[count], positions[count] = axis, lines[i]
                    count += 1
        num_corners, jumps_end = 0, count
        for i in range(len(corners)):
            if num_corners == max_lines[axis] or corners[i] >= high - _MARGIN_AT_CORNERS_M:
                break
            if corners[i] <= low + _MARGIN_AT_CORNERS_M or (i > 0 and corners[i] - corners[i - 1] < 1e-6):
                continue
            if _is_apart(positions, first, jumps_end, corners[i], _CORNER_M):
                axes[count], positions[count] = axis, corners[i]
                count += 1
                num_corners += 1
    return axes[:count], positions[:count]


@inner
def _is_apart(positions: np.ndarray, first: int, last: int, position: float, min_m: float):
    for k in range(first, last):  # noqa: SIM110 - compiled
        if abs(positions[k] - position) < min_m:
            return False
    return True
