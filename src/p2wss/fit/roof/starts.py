"""The roofs that a search starts from, and which edges face the same way or are parallel."""

from __future__ import annotations

import numpy as np

from p2wss.fit.roof.work import Polygon
from p2wss.fit.settings import SEARCHING
from p2wss.skeleton.compiled import allocating, both
from p2wss.skeleton.ordering import stable_order

# edges whose directions differ by less face the same way
_SAME_DIRECTION_DEG = 12.0


@both
def edge_groups(polygon: Polygon):
    """(direction, axis, bearing, length) of the edges of rings. direction: int64, the same number where edges
    face the same way; axis: int64, the same number where they are parallel; number 0 has the greatest total
    length. bearing: radians. length: metres."""
    xy_m, ring_offset = polygon
    n = len(xy_m)
    bearing, length = np.empty(n), np.empty(n)
    shorter = np.empty(n)
    for ring in range(len(ring_offset) - 1):
        for i in range(ring_offset[ring], ring_offset[ring + 1]):
            j = i + 1 if i + 1 < ring_offset[ring + 1] else ring_offset[ring]
            x, y = xy_m[j, 0] - xy_m[i, 0], xy_m[j, 1] - xy_m[i, 1]
            bearing[i], length[i] = np.arctan2(y, x), np.hypot(x, y)
            # lengths are compared in whole millimetres, so that rounding errors decide nothing
            shorter[i] = -np.rint(length[i] * 1000.0)
    order = stable_order(shorter)
    bearing_deg = bearing * (180.0 / np.pi)
    return (
        _groups(bearing_deg, length, order, 360.0),
        _groups(bearing_deg, length, order, 180.0),
        bearing,
        length,
    )


@allocating
def _groups(bearing_deg: np.ndarray, length: np.ndarray, order: np.ndarray, period_deg: float):
    """Clusters of bearings around the longest edges, numbered in the order of their total length."""
    n = len(length)
    group, total = np.full(n, -1), np.zeros(n)
    count = 0
    for i in order:
        if group[i] >= 0:
            continue
        for j in range(n):
            turn = abs((bearing_deg[j] - bearing_deg[i] + period_deg / 2) % period_deg - period_deg / 2)
            if group[j] < 0 and turn < _SAME_DIRECTION_DEG:
                group[j] = count
                total[count] += length[j]
        count += 1
    result = np.empty(n, np.int64)
    for i in range(n):
        rank = 0
        for c in range(count):
            longer = total[c] - total[group[i]]
            if longer > 1e-3 or (abs(longer) <= 1e-3 and c < group[i]):
                rank += 1
        result[i] = rank
    return result


@allocating
def start_angles(direction: np.ndarray, axis: np.ndarray, guesses: np.ndarray):
    """Angles of the starts, (num_starts, num_edges): the ``guesses`` (num_guesses, num_edges), a hip roof, a
    gable roof along either main axis, and flat.

    A guess with edges of 0 degrees is added a second time with slopes in their place, because those edges flatten the
    roof around them and the search would not recover from that.
    """
    n = len(direction)
    num_axes = 1
    for e in range(n):
        if axis[e] > 0:
            num_axes = 2
    rows = np.zeros((2 * len(guesses) + 2 + num_axes, n))
    count = 0
    for g in range(len(guesses)):
        has_flat = False
        for e in range(n):
            rows[count, e] = guesses[g, e]
            has_flat = has_flat or guesses[g, e] == 0.0
        count += 1
        if has_flat:
            for e in range(n):
                rows[count, e] = SEARCHING.low_deg if guesses[g, e] == 0.0 else guesses[g, e]
            count += 1
    for e in range(n):
        rows[count, e] = SEARCHING.hip_deg
    for a in range(num_axes):
        for e in range(n):
            rows[count + 1 + a, e] = SEARCHING.hip_deg if axis[e] == a else 90.0
    # the last row keeps its zeros: a flat roof
    return rows[: count + 2 + num_axes]
