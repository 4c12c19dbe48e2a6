"""Where straight cuts through a footprint may separate roofs of different heights."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import entry, inner

_STEP_M, _BIN_M = 0.25, 1.2
# points this far from a line tell the height on either side
_NEAR_M, _FAR_M = 0.1, 0.9
_MOST_M = 2.0
_MARGIN_M = 0.8
_LEAST_SCORE_M2 = 0.25
_APART_M = 0.7


@inner
def _quantile(ordered, count, share):
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
    num_bins = max(1, int((high_m - low_m) / _BIN_M))
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
                if -_FAR_M < offset < -_NEAR_M:
                    before[left] = z[k]
                    left += 1
                elif _NEAR_M < offset < _FAR_M:
                    after[right] = z[k]
                    right += 1
            if left < 3 or right < 3:
                continue
            before[:left].sort()
            after[:right].sort()
            jump = abs(_quantile(before, left, 0.5) - _quantile(after, right, 0.5))
            spread = _quantile(before, left, 0.9) - _quantile(before, left, 0.1)
            spread += _quantile(after, right, 0.9) - _quantile(after, right, 0.1)
            score[i] += min(max(jump - 0.5 * spread, 0.0), _MOST_M) * width
    return score


def jump_lines(xy_m: np.ndarray, point_m: np.ndarray, axis: int, most: int) -> list[float]:
    """At most ``most`` positions along ``axis``, the clearest jump first, at least 0.7 m apart."""
    low, high = xy_m.min(axis=0), xy_m.max(axis=0)
    lines = np.arange(low[axis] + _MARGIN_M, high[axis] - _MARGIN_M, _STEP_M)
    if not len(lines) or not len(point_m):
        return []
    along, across, z = (np.ascontiguousarray(point_m[:, k]) for k in (axis, 1 - axis, 2))
    score = jump_scores(along, across, z, lines, float(low[1 - axis]), float(high[1 - axis]))
    chosen: list[float] = []
    for i in np.argsort(-score, kind="stable").tolist():
        if score[i] <= _LEAST_SCORE_M2 or len(chosen) == most:
            break
        if all(abs(lines[i] - other) >= _APART_M for other in chosen):
            chosen.append(float(lines[i]))
    return chosen
