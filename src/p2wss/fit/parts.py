"""Discontinuous heights: a footprint cut along height jumps into parts with a roof each.

Cuts run along the footprint's main axes, so the polygon is turned into them first (:func:`main_frame`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from p2wss.fit.one_height import Effort, Fitter, Gain, OneHeight, flat_rings
from p2wss.fit.points import even_order
from p2wss.fit.screen import Side, split_roof
from p2wss.fit.starts import edge_groups
from p2wss.fit.work import NO_PRIOR, Prior

_NOISE_M = 0.03
_SCREEN = Effort(num_search_points=40, num_descents=0)


@dataclass(frozen=True)
class Cutting(Gain):
    """max_parts: of one building. gain_share: share of the loss of what it cuts that one more part must gain too.
    least_points: of a part."""

    max_parts: int = 4
    gain_share: float = 0.1
    least_points: int = 6


@dataclass(frozen=True)
class _Part:
    """point_m: (3, m), as compiled code takes them."""

    point_m: np.ndarray
    fit: OneHeight


@dataclass(frozen=True)
class _Split:
    gain_m: float
    parts: tuple[_Part, _Part]


def main_frame(rings: Sequence[np.ndarray]) -> np.ndarray:
    """Rotation (2, 2) with ``xy @ rotation`` along the axes that the edges prefer."""
    _, axis, bearing, length = edge_groups(*flat_rings(rings))
    main = axis == 0
    turn = float(np.angle(np.sum(length[main] * np.exp(2j * bearing[main])))) / 2
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])


def fit_parts(
    fitter: Fitter,
    rings: Sequence[np.ndarray],
    point_m: np.ndarray,
    effort: Effort,
    cutting: Cutting,
    guesses: Sequence[np.ndarray] = (),
    prior: Prior = NO_PRIOR,
) -> list[OneHeight]:
    """The parts of a building, one if no cut gains enough; none if there is no roof to fit. All in the frame of
    ``rings``, which is that of :func:`main_frame`; vertices on a cut have exactly its coordinate.

    Greedy: the cut that gains most is made first. ``effort``: of the whole; parts get one round over their edges.
    """
    point_m = point_m[even_order(point_m)] if len(point_m) else point_m
    whole = fitter.fit(rings, point_m, effort, guesses, prior)
    if whole is None:
        return []
    # the prior is of the whole building: parts are compared without
    parts = [_Part(np.ascontiguousarray(point_m.T), replace(whole, loss_m=fitter.loss(whole, point_m)))]
    splits: list[_Split | None] = [None]
    tried = [False]
    least = cutting.least_gain_m(len(point_m))
    while len(parts) < cutting.max_parts:
        for i, part in enumerate(parts):
            if not tried[i]:
                splits[i], tried[i] = _best_split(fitter, part, least, effort, cutting), True
        i = max(range(len(parts)), key=lambda k: split.gain_m if (split := splits[k]) else 0.0)
        chosen = splits[i]
        if chosen is None:
            break
        parts[i : i + 1] = chosen.parts
        splits[i : i + 1] = [None, None]
        tried[i : i + 1] = [False, False]
    beliefs = prior if len(parts) == 1 else NO_PRIOR
    tidied = [fitter.tidied(part.fit, part.point_m.T, effort, beliefs) for part in parts]
    return [
        replace(fit, loss_m=fitter.loss(fit, part.point_m.T, beliefs))
        for fit, part in zip(tidied, parts, strict=True)
    ]


def cost_m(parts: Sequence[OneHeight], cutting: Cutting) -> float:
    """Sum of the losses over all points, and what each further part has to gain."""
    num_points = sum(part.num_points for part in parts)
    return sum(part.total_loss_m for part in parts) + (len(parts) - 1) * cutting.least_gain_m(num_points)


def _best_split(fitter: Fitter, part: _Part, least: float, effort: Effort, cutting: Cutting) -> _Split | None:
    loss, count = part.fit.total_loss_m, part.point_m.shape[1]
    if loss - _NOISE_M * count < least or count < 2 * cutting.least_points:
        return None
    least = max(least, cutting.gain_share * loss)
    xy_m, offset = flat_rings(part.fit.rings)
    found = split_roof(
        xy_m,
        offset,
        part.fit.angle_deg,
        part.point_m,
        loss,
        least,
        cutting.least_points,
        fitter.work(2 * len(xy_m), count),
        fitter.settings(_SCREEN),
        fitter.settings(replace(effort, max_rounds=1)),
        NO_PRIOR,
    )
    if found is None:
        return None
    axis, position, low, high = found
    is_high = part.point_m[axis] >= position
    sides = _side(part, ~is_high, low), _side(part, is_high, high)
    gain = loss - sides[0].fit.total_loss_m - sides[1].fit.total_loss_m
    return _Split(gain, sides) if gain >= least else None


def _side(part: _Part, own: np.ndarray, side: Side) -> _Part:
    point_m = np.compress(own, part.point_m, axis=1)
    rings = [side.xy_m[first:last] for first, last in pairwise(side.ring_offset.tolist())]
    fit = OneHeight(rings, side.angle_deg, side.eave_z_m, side.top_m, side.loss_m, point_m.shape[1])
    return _Part(point_m, fit)
