"""Where straight cuts through a footprint may separate roofs of different heights."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import entry, inner

_STEP_M, _BIN_M = 0.25, 1.2
# points this far from a line tell the height on either side
_NEAR_M, _FAR_M = 0.1, 0.9
# both grow where a point has more room than this to itself
_DENSE_M = 0.4
_MOST_M = 2.0
_MARGIN_M = 0.8
_LEAST_SCORE_M2 = 0.25
_APART_M = 0.7
_MOST_LINES, _MOST_CORNERS = 3, 3
# corners this near to a jump are looked at with it
_CORNER_M, _MARGIN_AT_CORNERS_M = 0.3, 0.9


@inner
def quantile(ordered, count, share):
    """Of the first ``count`` values, which are in order."""
    place = share * (count - 1)
    low = int(place)
    high = min(low + 1, count - 1)
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])


@entry
def jump_scores(along, across, z, lines, low_m, high_m):
    """How much of a jump there is across each of the ``lines`` (positions in ``along``), in square metres: the
    difference of the medians on either side beyond what slopes explain, at most 2 m, summed over strips.

    along, across, z: float64 (m,), coordinates of points. low_m, high_m: extent of the polygon in ``across``.
    """
    room_m = np.sqrt((high_m - low_m) * (along.max() - along.min()) / len(z))
    stretch = max(1.0, room_m / _DENSE_M)
    num_bins = max(1, int((high_m - low_m) / (_BIN_M * stretch)))
    width = (high_m - low_m) / num_bins
    strip = np.empty(len(z), np.int64)
    for k in range(len(z)):
        strip[k] = min(max(int((across[k] - low_m) / width), 0), num_bins - 1)
    order = np.argsort(strip, kind="mergesort")
    first = np.searchsorted(strip[order], np.arange(num_bins + 1))
    before, after = np.empty(len(z)), np.empty(len(z))
    score = np.zeros(len(lines))
    for i in range(len(lines)):
        for b in range(num_bins):
            left, right = 0, 0
            for k in order[first[b] : first[b + 1]]:
                offset = along[k] - lines[i]
                if -_FAR_M * stretch < offset < -_NEAR_M:
                    before[left] = z[k]
                    left += 1
                elif _NEAR_M < offset < _FAR_M * stretch:
                    after[right] = z[k]
                    right += 1
            if left < 3 or right < 3:
                continue
            before[:left].sort()
            after[:right].sort()
            jump = abs(quantile(before, left, 0.5) - quantile(after, right, 0.5))
            spread = quantile(before, left, 0.9) - quantile(before, left, 0.1)
            spread += quantile(after, right, 0.9) - quantile(after, right, 0.1)
            score[i] += min(max(jump - 0.5 * spread, 0.0), _MOST_M) * width
    return score


@entry
def candidates(xy_m, x, y, z):
    """(axis, position) of cuts worth a try: at most three of the clearest jumps per axis, at least 0.7 m
    apart, and three corners."""
    axes, positions = (
        np.empty(2 * (_MOST_LINES + _MOST_CORNERS), np.int64),
        np.empty(2 * (_MOST_LINES + _MOST_CORNERS)),
    )
    count = 0
    for axis in range(2):
        corners = np.sort(xy_m[:, axis])
        low, high = corners[0], corners[-1]
        first = count
        num_lines = int(np.ceil((high - low - 2 * _MARGIN_M) / _STEP_M))
        if num_lines > 0:
            lines = low + _MARGIN_M + _STEP_M * np.arange(num_lines)
            across = xy_m[:, 1 - axis]
            score = jump_scores(
                x if axis == 0 else y, y if axis == 0 else x, z, lines, across.min(), across.max()
            )
            for i in np.argsort(-score, kind="mergesort"):
                if score[i] <= _LEAST_SCORE_M2 or count == first + _MOST_LINES:
                    break
                if _apart(positions[first:count], lines[i], _APART_M):
                    axes[count], positions[count] = axis, lines[i]
                    count += 1
        num_corners, jumps_end = 0, count
        for i in range(len(corners)):
            if num_corners == _MOST_CORNERS or corners[i] >= high - _MARGIN_AT_CORNERS_M:
                break
            if corners[i] <= low + _MARGIN_AT_CORNERS_M or (i > 0 and corners[i] - corners[i - 1] < 1e-6):
                continue
            if _apart(positions[first:jumps_end], corners[i], _CORNER_M):
                axes[count], positions[count] = axis, corners[i]
                count += 1
                num_corners += 1
    return axes[:count], positions[:count]


@entry
def _apart(positions, position, least_m):
    for other in positions:  # noqa: SIM110 - compiled
        if abs(other - position) < least_m:
            return False
    return True
