"""Buildings with several heights: the footprint is cut along height jumps into parts that have a roof each.

Cuts run along the main axes of the footprint, so the polygon is first rotated to them (:func:`main_frame`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from p2wss.fit.one_height import Effort, FittedRoof, Fitter, Gain, flat_rings
from p2wss.fit.points import even_order
from p2wss.fit.screen import Side, split_roof
from p2wss.fit.starts import edge_groups
from p2wss.fit.work import NO_PRIOR, Prior

_NOISE_M = 0.03
_SCREEN = Effort(num_search_points=40, num_descents=0)


@dataclass(frozen=True)
class Cutting(Gain):
    """Which parts a building may have.

    max_parts: of one building. gain_share: a cut must also gain this share of the loss of the part that it divides.
    min_points: of a part.
    """

    max_parts: int = 12
    gain_share: float = 0.03
    min_points: int = 6


@dataclass(frozen=True)
class _Part:
    """A part with its roof. point_m: (3, m), as compiled code takes them."""

    point_m: np.ndarray
    roof: FittedRoof


@dataclass(frozen=True)
class _Split:
    """A cut of one part into two, and what it gains in the sum over the points."""

    gain_m: float
    parts: tuple[_Part, _Part]


def main_frame(rings: Sequence[np.ndarray]) -> np.ndarray:
    """Rotation (2, 2) for which the edges in ``xy @ rotation`` run along the axes as far as possible."""
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
) -> list[FittedRoof]:
    """The parts of a building: one if no cut gains enough, none if no roof can be fitted. Everything is in the frame
    of ``rings``, which is that of :func:`main_frame`; vertices on a cut have exactly its coordinate.

    Greedy: the cut that gains most is made first. effort: of the whole building; parts get one round over their
    edges. guesses, prior: of the whole building, too.
    """
    point_m = point_m[even_order(point_m)] if len(point_m) else point_m
    whole = fitter.fit(rings, point_m, effort, guesses, prior)
    if whole is None:
        return []
    # the prior describes the whole building, so parts are compared without it
    parts = [_Part(np.ascontiguousarray(point_m.T), replace(whole, loss_m=fitter.loss(whole, point_m)))]
    splits: list[_Split | None] = [None]
    is_searched = [False]
    min_gain = cutting.min_gain_m(len(point_m))
    while len(parts) < cutting.max_parts:
        for i, part in enumerate(parts):
            if not is_searched[i]:
                splits[i], is_searched[i] = _best_split(fitter, part, min_gain, effort, cutting), True
        i = max(range(len(parts)), key=lambda k: split.gain_m if (split := splits[k]) else 0.0)
        best = splits[i]
        if best is None:
            break
        parts[i : i + 1] = best.parts
        splits[i : i + 1] = [None, None]
        is_searched[i : i + 1] = [False, False]
    final_prior = prior if len(parts) == 1 else NO_PRIOR
    roofs = [fitter.tidy(part.roof, part.point_m.T, effort, final_prior) for part in parts]
    return [
        replace(roof, loss_m=fitter.loss(roof, part.point_m.T, final_prior))
        for roof, part in zip(roofs, parts, strict=True)
    ]


def cost_m(parts: Sequence[FittedRoof], cutting: Cutting) -> float:
    """The loss summed over all points, plus the minimum gain of each part after the first."""
    num_points = sum(part.num_points for part in parts)
    return sum(part.total_loss_m for part in parts) + (len(parts) - 1) * cutting.min_gain_m(num_points)


def _best_split(
    fitter: Fitter, part: _Part, min_gain: float, effort: Effort, cutting: Cutting
) -> _Split | None:
    loss, count = part.roof.total_loss_m, part.point_m.shape[1]
    if loss - _NOISE_M * count < min_gain or count < 2 * cutting.min_points:
        return None
    min_gain = max(min_gain, cutting.gain_share * loss)
    xy_m, offset = flat_rings(part.roof.rings)
    cut = split_roof(
        xy_m,
        offset,
        part.roof.angle_deg,
        part.point_m,
        loss,
        min_gain,
        cutting.min_points,
        fitter.work(2 * len(xy_m), count),
        fitter.settings(_SCREEN),
        fitter.settings(replace(effort, max_rounds=1)),
        NO_PRIOR,
    )
    if cut is None:
        return None
    axis, position, low, high = cut
    is_high = part.point_m[axis] >= position
    sides = _side(part, ~is_high, low), _side(part, is_high, high)
    gain = loss - sides[0].roof.total_loss_m - sides[1].roof.total_loss_m
    return _Split(gain, sides) if gain >= min_gain else None


def _side(part: _Part, mask: np.ndarray, side: Side) -> _Part:
    point_m = np.compress(mask, part.point_m, axis=1)
    rings = [side.xy_m[first:last] for first, last in pairwise(side.ring_offset.tolist())]
    roof = FittedRoof(rings, side.angle_deg, side.eave_z_m, side.top_m, side.loss_m, point_m.shape[1])
    return _Part(point_m, roof)
