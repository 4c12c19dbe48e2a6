"""Where the search begins: which edges belong together, and simple roofs over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from p2wss.skeleton.compiled import entry

# edges that differ by less face the same way
_SAME_DIRECTION_DEG = 12.0
HIP_DEG, _SHED_DEG, _LOW_DEG = 42.0, 20.0, 18.0


@dataclass(frozen=True)
class Edges:
    """Edges of a polygon over all its rings. direction: int64, equal where edges face the same way; axis:
    int64, equal where they are parallel; both counted from the one with the greatest total length. bearing_rad:
    of each edge. length_m: of each edge."""

    direction: np.ndarray
    axis: np.ndarray
    bearing_rad: np.ndarray
    length_m: np.ndarray

    @property
    def num_directions(self) -> int:
        return int(self.direction.max()) + 1

    @property
    def num_axes(self) -> int:
        return int(self.axis.max()) + 1


def edges(rings: Sequence[np.ndarray]) -> Edges:
    """Lengths and groups of the edges of ``rings``, each (n, 2)."""
    xy_m = np.concatenate(list(rings))
    along = np.concatenate([np.roll(ring, -1, axis=0) for ring in rings]) - xy_m
    length = np.hypot(along[:, 0], along[:, 1])
    bearing = np.arctan2(along[:, 1], along[:, 0])
    # a length decides by its millimetres only, so that rounding does not
    order = np.argsort(-np.round(length, 3), kind="stable")
    bearing_deg = np.degrees(bearing)
    return Edges(
        _groups(bearing_deg, length, order, 360.0),
        _groups(bearing_deg, length, order, 180.0),
        bearing,
        length,
    )


@entry
def _groups(bearing_deg, length, order, period_deg):
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


def starts(own: Edges, guesses: Sequence[np.ndarray], with_sheds: bool) -> np.ndarray:
    """Angles to begin with, (num_starts, num_edges): the guesses, a hip roof, a gable roof along either main
    axis, flat, and if wanted a shed roof down each main direction.

    A guess with 0 degree edges comes a second time with slopes for them, because a search does not find its
    way out of what they flatten.
    """
    n = len(own.direction)
    rows = []
    for guess in guesses:
        rows.append(np.asarray(guess, float))
        if (guess == 0).any():
            rows.append(np.where(guess == 0, _LOW_DEG, guess))
    rows.append(np.full(n, HIP_DEG))
    rows += [np.where(own.axis == axis, HIP_DEG, 90.0) for axis in range(min(own.num_axes, 2))]
    rows.append(np.zeros(n))
    if with_sheds:
        rows += [
            np.where(own.direction == down, _SHED_DEG, 90.0) for down in range(min(own.num_directions, 4))
        ]
    return np.array(rows)
