"""Buildings with several heights: the footprint is cut along height jumps into parts that have a roof each.

Cuts run along the main axes of the footprint, so the polygon is first rotated to them (:func:`main_frame`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from p2wss.fit.cutting import is_sound
from p2wss.fit.merging import merged_rings
from p2wss.fit.one_height import Effort, FittedRoof, Fitter, Gain, flat_rings
from p2wss.fit.points import even_order
from p2wss.fit.screen import split_roof
from p2wss.fit.search import MANY_EDGES
from p2wss.fit.starts import edge_groups
from p2wss.fit.work import NO_PRIOR, Prior

_NOISE_M = 0.03
_SCREEN = Effort(num_search_points=40, num_descents=0)
# a merger is fitted in full if a quick fit costs at most this multiple of the limit
_MERGER_SLACK = 1.4


@dataclass(frozen=True)
class Cutting(Gain):
    """Which parts a building may have.

    max_parts: of one building. slope_share: what each sloped face costs, as a share of what a part costs.
    over_share: cuts are made that gain this share of what a part costs; those that do not pay are merged again.
    min_points: of a part.
    """

    gain_m: float = 0.014
    max_parts: int = 32
    slope_share: float = 0.3
    over_share: float = 0.2
    min_points: int = 6


@dataclass(frozen=True)
class Part:
    """A part with its roof. point_m: (3, m), as compiled code takes them. cost_m: the sum of its residuals, and the
    price of its slopes."""

    point_m: np.ndarray
    roof: FittedRoof
    cost_m: float


@dataclass(frozen=True)
class _Split:
    """A cut of one part into two, and what it gains."""

    gain_m: float
    parts: tuple[Part, Part]


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

    Cuts are made as long as they gain a share of what a part costs, the one that gains most first. Then parts are
    merged until every merger would cost more than it saves, so that parts need not be rectangular. effort: of the whole
    building; parts get one round over their edges. guesses, prior: of the whole building, too.
    """
    point_m = point_m[even_order(point_m)] if len(point_m) else point_m
    min_gain = cutting.min_gain_m(len(point_m))
    slope_cost_m = cutting.slope_share * min_gain if cutting.max_parts > 1 else 0.0
    whole = fitter.fit(rings, point_m, effort, guesses, with_slope_cost(prior, slope_cost_m, len(point_m)))
    if whole is None:
        return []
    # the prior describes the whole building, so parts are compared without it
    parts = [_part(fitter, whole, np.ascontiguousarray(point_m.T), slope_cost_m, effort)]
    splits: list[_Split | None] = [None]
    is_searched = [False]
    parents: dict[frozenset[int], Part] = {}
    while len(parts) < cutting.max_parts:
        for i, part in enumerate(parts):
            if not is_searched[i]:
                share_m = cutting.over_share * min_gain
                splits[i] = _best_split(fitter, part, share_m, slope_cost_m, effort, cutting)
                is_searched[i] = True
        i = max(range(len(parts)), key=lambda k: split.gain_m if (split := splits[k]) else 0.0)
        best = splits[i]
        if best is None:
            break
        parents[frozenset(map(id, best.parts))] = parts[i]
        parts[i : i + 1] = best.parts
        splits[i : i + 1] = [None, None]
        is_searched[i : i + 1] = [False, False]
    parts = _merge_parts(fitter, parts, parents, min_gain, slope_cost_m, effort)
    roofs = []
    for part in parts:
        own_prior = prior if len(parts) == 1 else NO_PRIOR
        num = part.point_m.shape[1]
        tidy_prior = with_slope_cost(own_prior, slope_cost_m, num, len(part.roof.angle_deg))
        roof = fitter.tidy(replace(part.roof, outward_m=None), part.point_m.T, effort, tidy_prior)
        roof = replace(roof, loss_m=fitter.loss(roof, part.point_m.T, own_prior))
        tidy = replace(part, roof=roof)
        roofs.append(_with_eaves(fitter, tidy, slope_cost_m, effort, own_prior).roof)
    return roofs


def _with_eaves(
    fitter: Fitter, part: Part, slope_cost_m: float, effort: Effort, prior: Prior = NO_PRIOR
) -> Part:
    """The part with eaves at different heights, if these gain more than a slope costs in the sum of the residuals.
    Without a price there is only one part, which has one eave height as in the paper."""
    roof, point_m = part.roof, part.point_m.T
    if not slope_cost_m or roof.loss_m < _NOISE_M:
        return part
    slope_prior = with_slope_cost(prior, slope_cost_m, len(point_m), len(roof.angle_deg))
    loss_m = fitter.loss(roof, point_m, slope_prior)
    # eaves at different heights are those of two slopes at least, which cost as much each
    if loss_m * len(point_m) <= 3 * slope_cost_m:
        return part
    uneven = fitter.fit_eaves(roof, point_m, effort, slope_prior)
    if uneven is roof:
        return part
    gain_m = (loss_m - fitter.loss(uneven, point_m, slope_prior)) * len(point_m) - slope_cost_m
    if gain_m <= 0:
        return part
    uneven = replace(uneven, loss_m=fitter.loss(uneven, point_m, prior))
    return Part(part.point_m, uneven, part.cost_m - gain_m)


def with_slope_cost(prior: Prior, slope_cost_m: float, num_points: int, num_edges: int = 0) -> Prior:
    """The prior of a roof over ``num_points`` points for which each slope costs ``slope_cost_m`` more in the sum.
    num_edges: of a roof without a prior."""
    if not slope_cost_m:
        return prior
    if not len(prior.slope_deg):
        prior = Prior(np.zeros((num_edges, 3)), np.full(num_edges, 38.0), 0.0, np.zeros(0), 0.0)
    class_cost_m = prior.class_cost_m.copy()
    class_cost_m[:, 2] += slope_cost_m / num_points
    return prior._replace(class_cost_m=class_cost_m)


def cost_m(parts: Sequence[FittedRoof], cutting: Cutting) -> float:
    """The loss summed over all points, plus the minimum gain of each part after the first."""
    num_points = sum(part.num_points for part in parts)
    return sum(part.total_loss_m for part in parts) + (len(parts) - 1) * cutting.min_gain_m(num_points)


def _part(fitter: Fitter, roof: FittedRoof, point_m: np.ndarray, slope_cost_m: float, effort: Effort) -> Part:
    """A part with a roof that is fitted to its points, whose eaves may then get different heights."""
    roof = replace(roof, loss_m=fitter.loss(roof, point_m.T))
    num_slopes = int(((roof.angle_deg > 0) & (roof.angle_deg < 90)).sum())
    part = Part(point_m, roof, roof.total_loss_m + num_slopes * slope_cost_m)
    return _with_eaves(fitter, part, slope_cost_m, effort)


def _best_split(
    fitter: Fitter, part: Part, min_gain: float, slope_cost_m: float, effort: Effort, cutting: Cutting
) -> _Split | None:
    count = part.point_m.shape[1]
    if part.cost_m - _NOISE_M * count < min_gain or count < 2 * cutting.min_points:
        return None
    xy_m, offset = flat_rings(part.roof.rings)
    _, axis, position, *roofs = split_roof(
        xy_m,
        offset,
        part.roof.angle_deg,
        part.point_m,
        part.cost_m,
        min_gain,
        cutting.min_points,
        slope_cost_m,
        fitter.work(2 * len(xy_m) + 8, count),
        fitter.settings(_SCREEN),
        fitter.settings(replace(effort, max_rounds=1)),
    )
    if axis < 0:
        return None
    is_high = part.point_m[axis] >= position
    low, high = _side(part, ~is_high, *roofs[0]), _side(part, is_high, *roofs[1])
    sides = _with_eaves(fitter, low, slope_cost_m, effort), _with_eaves(fitter, high, slope_cost_m, effort)
    gain = part.cost_m - sides[0].cost_m - sides[1].cost_m
    return _Split(gain, sides) if gain >= min_gain else None


def _side(
    part: Part,
    mask: np.ndarray,
    loss_m: float,
    eave_z_m: float,
    top_m: float,
    angle_deg: np.ndarray,
    xy_m: np.ndarray,
    ring_offset: np.ndarray,
) -> Part:
    """The part on one side of a cut, with the points in ``mask`` and the roof that :func:`split_roof` returns."""
    point_m = np.compress(mask, part.point_m, axis=1)
    rings = [xy_m[first:last] for first, last in pairwise(ring_offset.tolist())]
    roof = FittedRoof(rings, angle_deg, eave_z_m, top_m, loss_m, point_m.shape[1])
    return Part(point_m, roof, roof.total_loss_m)


def _merge_parts(
    fitter: Fitter,
    parts: list[Part],
    parents: dict[frozenset[int], Part],
    price_m: float,
    slope_cost_m: float,
    effort: Effort,
) -> list[Part]:
    """The parts after those mergers that cost less than ``price_m``, the cheapest first."""
    mergers: dict[frozenset[int], Part | None] = {}
    while len(parts) > 1:
        best_gain, best = 0.0, None
        for i, one in enumerate(parts):
            for other in parts[:i]:
                pair = frozenset((id(one), id(other)))
                if pair not in mergers:
                    limit_m = one.cost_m + other.cost_m + price_m
                    mergers[pair] = parents.get(pair) or _merger(
                        fitter, one, other, limit_m, slope_cost_m, effort
                    )
                merger = mergers[pair]
                if merger is not None:
                    gain = one.cost_m + other.cost_m + price_m - merger.cost_m
                    if gain > best_gain:
                        best_gain, best = gain, (one, other, merger)
        if best is None:
            return parts
        parts = [part for part in parts if part is not best[0] and part is not best[1]] + [best[2]]
    return parts


def _merger(
    fitter: Fitter, one: Part, other: Part, limit_m: float, slope_cost_m: float, effort: Effort
) -> Part | None:
    """Two parts as one, None if they do not touch along an edge or if it would cost more than ``limit_m``."""
    rings = merged_rings(one.roof.rings, other.roof.rings)
    if rings is None:
        return None
    point_m = np.hstack([one.point_m, other.point_m])
    point_m = point_m[:, even_order(point_m.T)]
    num = point_m.shape[1]
    xy_m, offset = flat_rings(rings)
    if not is_sound(xy_m, offset, 0.05, fitter.work(len(xy_m), num)):
        return None
    prior = with_slope_cost(NO_PRIOR, slope_cost_m, num, len(xy_m))
    if len(xy_m) <= MANY_EDGES:
        quick = fitter.fit(rings, point_m.T, _SCREEN, (), prior)
        if quick is None or quick.total_loss_m > _MERGER_SLACK * limit_m:
            return None
    roof = fitter.fit(rings, point_m.T, replace(effort, max_rounds=1), (), prior)
    return None if roof is None else _part(fitter, roof, point_m, slope_cost_m, effort)
