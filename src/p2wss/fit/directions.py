"""Directions in a plan. Directions that differ by a right angle are the same."""

from collections.abc import Sequence

import numpy as np

from p2wss.skeleton.angles import bearings


def turn_between(
    angle: np.ndarray | float, other: np.ndarray | float, quarter: float = np.pi / 2
) -> np.ndarray:
    """The turn from ``other`` to ``angle`` modulo a quarter turn: from minus to plus an eighth. Radians, or the unit in
    which ``quarter`` is given."""
    return (np.asarray(angle) - other + quarter / 2) % quarter - quarter / 2


def edge_ends(rings: Sequence[np.ndarray]) -> np.ndarray:
    """(e, 2, 2), the ends of the edges of rings, each (n, 2)."""
    # numpy's ``roll`` and ``stack`` take several times as long for a few vertices
    after = np.concatenate([part for ring in rings for part in (ring[1:], ring[:1])])
    return np.concatenate([np.concatenate(list(rings)), after], axis=1).reshape(-1, 2, 2)


def directions(rings: Sequence[np.ndarray], same_deg: float) -> list[float]:
    """Directions of the edges of a footprint, radians modulo a quarter turn. Edges within ``same_deg`` have one
    direction; the one with the greatest total length is first."""
    ends = edge_ends(rings)
    edge = ends[:, 1] - ends[:, 0]
    length = np.hypot(edge[:, 0], edge[:, 1])
    angle = bearings(edge) % (np.pi / 2)
    found = []
    while len(length):
        turn = turn_between(angle, angle[length.argmax()])
        same = np.abs(turn) <= np.radians(same_deg)
        sum_m = length[same].sum()
        mean = angle[length.argmax()] + (turn[same] * length[same]).sum() / sum_m
        found.append((float(sum_m), float(mean)))
        angle, length = angle[~same], length[~same]
    return [angle for _, angle in sorted(found, key=lambda each: -each[0])]
