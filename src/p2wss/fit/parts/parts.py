"""Parts of a building: polygons along the main axes of the footprint with a roof each, and what they cost.

Cuts run along the main axes of the footprint, so the polygon is first rotated to them (:func:`main_frame`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from p2wss.fit.parts.best_cut import split_roof
from p2wss.fit.parts.cutting import inherited_angles, is_sound
from p2wss.fit.parts.merging import merged_rings
from p2wss.fit.points import even_order
from p2wss.fit.roof.fitter import Effort, FittedRoof, Fitter, Gain, flat_rings
from p2wss.fit.roof.search import MANY_EDGES
from p2wss.fit.roof.starts import edge_groups
from p2wss.fit.roof.work import NO_PRIOR, Prior

# residuals that no better roof would lower
_NOISE_M = 0.03
_SCREEN = Effort(num_search_points=40, num_descents=0)
# a merger is fitted in full if a quick fit costs at most this multiple of the limit
_MERGER_SLACK = 1.4
# Two parts are divided anew only if better roofs might gain this multiple of the price of a part.
_MIN_EXCESS_SHARE = 7.0


@dataclass(frozen=True)
class Cutting(Gain):
    """Which parts a building may have.

    max_parts: of one building. slope_share: what each sloped face costs, as a share of what a part costs.
    over_share: cuts are made that gain this share of what a part costs; those that do not pay are merged again.
    loss_share: a cut may lose this share, which is that of the slopes of a divided gable roof and a little more, if a
    second one, through one of its sides, makes up for it; 0 for never.
    division_share: two parts are divided anew if that gains this share; 0 for never. min_points: of a part.
    """

    gain_m: float = 0.014
    max_parts: int = 32
    slope_share: float = 0.3
    over_share: float = 0.7
    loss_share: float = 0.7
    division_share: float = 0.3
    min_points: int = 6


@dataclass(frozen=True, eq=False)
class Part:
    """A part with its roof. point_m: (3, m), as compiled code takes them. cost_m: the sum of its residuals, and the
    price of its slopes."""

    point_m: np.ndarray
    roof: FittedRoof
    cost_m: float

    @property
    def excess_m(self) -> float:
        """The most that better roofs might gain."""
        return self.cost_m - _NOISE_M * self.point_m.shape[1]


@dataclass(frozen=True)
class Union:
    """Two parts that touch, as one polygon. rings: exterior first. point_m: (3, m), in even order."""

    parts: tuple[Part, Part]
    rings: Sequence[np.ndarray]
    point_m: np.ndarray

    @property
    def num_edges(self) -> int:
        return sum(map(len, self.rings))

    @property
    def cost_m(self) -> float:
        return sum(part.cost_m for part in self.parts)


def main_frame(rings: Sequence[np.ndarray]) -> np.ndarray:
    """Rotation (2, 2) for which the edges in ``xy @ rotation`` run along the axes as far as possible."""
    _, axis, bearing, length = edge_groups(*flat_rings(rings))
    main = axis == 0
    turn = float(np.angle(np.sum(length[main] * np.exp(2j * bearing[main])))) / 2
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])


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


class PartFitter:
    """Fits the parts of one building.

    num_points: of the building. price_m, slope_cost_m: what a part and each of its slopes cost in the sum of the
    residuals. Without a price there is only one part, which has one eave height as in the paper. Parts that result from
    cuts and mergers get one round over their edges.
    """

    def __init__(self, fitter: Fitter, effort: Effort, cutting: Cutting, num_points: int) -> None:
        self.cutting = cutting
        self.price_m = cutting.min_gain_m(num_points)
        self.slope_cost_m = cutting.slope_share * self.price_m if cutting.max_parts > 1 else 0.0
        self._fitter = fitter
        self._effort = effort
        self._one_round = replace(effort, max_rounds=1)

    def whole(
        self, rings: Sequence[np.ndarray], point_m: np.ndarray, guesses: Sequence[np.ndarray], prior: Prior
    ) -> Part | None:
        """The whole building as one part; None if no roof can be fitted. point_m: (m, 3), in even order."""
        slope_prior = with_slope_cost(prior, self.slope_cost_m, len(point_m))
        roof = self._fitter.fit(rings, point_m, self._effort, guesses, slope_prior)
        # the prior describes the whole building, so parts are compared without it
        return None if roof is None else self._part(roof, np.ascontiguousarray(point_m.T))

    def cut(self, part: Part, min_gain_m: float) -> tuple[Part, Part] | None:
        """The two sides of the best cut, None if no cut gains ``min_gain_m``."""
        num_points, min_points = part.point_m.shape[1], self.cutting.min_points
        if part.excess_m < min_gain_m or num_points < 2 * min_points:
            return None
        xy_m, offset = flat_rings(part.roof.rings)
        axis, position, *roofs = split_roof(
            xy_m,
            offset,
            part.roof.angle_deg,
            part.point_m,
            part.cost_m - min_gain_m,
            min_points,
            self.slope_cost_m,
            self._fitter.work(2 * len(xy_m) + 8, num_points),
            self._fitter.settings(_SCREEN),
            self._fitter.settings(self._one_round),
        )
        if axis < 0:
            return None
        is_high = part.point_m[axis] >= position
        low = self._with_eaves(_side(part, ~is_high, *roofs[0]))
        high = self._with_eaves(_side(part, is_high, *roofs[1]))
        return (low, high) if part.cost_m - low.cost_m - high.cost_m >= min_gain_m else None

    def union(self, one: Part, other: Part) -> Union | None:
        """Two parts together, None if they do not touch along an edge or if their union is too thin."""
        rings = merged_rings(one.roof.rings, other.roof.rings)
        if rings is None:
            return None
        point_m = np.hstack([one.point_m, other.point_m])
        point_m = np.ascontiguousarray(point_m[:, even_order(point_m.T)])
        xy_m, offset = flat_rings(rings)
        if not is_sound(xy_m, offset, 0.05, self._fitter.work(len(xy_m), point_m.shape[1])):
            return None
        return Union((one, other), rings, point_m)

    def merged(self, union: Union) -> tuple[Part] | None:
        """Two parts as a single one with a new roof, None if a quick fit shows that it would cost more than both and a
        price."""
        rings, point_m, num_edges = union.rings, union.point_m.T, union.num_edges
        prior = with_slope_cost(NO_PRIOR, self.slope_cost_m, len(point_m), num_edges)
        if num_edges <= MANY_EDGES:
            quick = self._fitter.fit(rings, point_m, _SCREEN, (), prior)
            if quick is None or quick.total_loss_m > _MERGER_SLACK * (union.cost_m + self.price_m):
                return None
        roof = self._fitter.fit(rings, point_m, self._one_round, (), prior)
        return None if roof is None else (self._part(roof, union.point_m),)

    def divided(self, union: Union) -> tuple[Part, Part] | None:
        """Two parts divided along another line, None if that gains too little or is not likely to gain anything."""
        min_gain_m = self.cutting.division_share * self.price_m
        excess_m = sum(part.excess_m for part in union.parts)
        if not min_gain_m or excess_m < _MIN_EXCESS_SHARE * self.price_m or union.num_edges > MANY_EDGES:
            return None
        both = flat_rings([ring for part in union.parts for ring in part.roof.rings])
        both_deg = np.concatenate([part.roof.angle_deg for part in union.parts])
        # no edge of the union is on a cut
        angle_deg = inherited_angles(*both, both_deg, *flat_rings(union.rings), 0, np.nan, 90.0)
        # what a cut gains is what it saves of the cost of both parts
        num_points = union.point_m.shape[1]
        roof = FittedRoof(union.rings, angle_deg, np.nan, np.inf, union.cost_m / num_points, num_points)
        return self.cut(Part(union.point_m, roof, union.cost_m), min_gain_m)

    def final_roof(self, part: Part, prior: Prior) -> FittedRoof:
        """The roof of a part with whole degrees, and with the eaves that go with them."""
        point_m = part.point_m.T
        slope_prior = with_slope_cost(prior, self.slope_cost_m, len(point_m), len(part.roof.angle_deg))
        roof = self._fitter.tidy(replace(part.roof, outward_m=None), point_m, self._effort, slope_prior)
        roof = replace(roof, loss_m=self._fitter.loss(roof, point_m, prior))
        return self._with_eaves(replace(part, roof=roof), prior).roof

    def _part(self, roof: FittedRoof, point_m: np.ndarray) -> Part:
        """A part with a roof that is fitted to its points, whose eaves may then get different heights."""
        roof = replace(roof, loss_m=self._fitter.loss(roof, point_m.T))
        num_slopes = int(((roof.angle_deg > 0) & (roof.angle_deg < 90)).sum())
        return self._with_eaves(Part(point_m, roof, roof.total_loss_m + num_slopes * self.slope_cost_m))

    def _with_eaves(self, part: Part, prior: Prior = NO_PRIOR) -> Part:
        """The part with eaves at different heights, if these gain more than a slope costs."""
        roof, point_m = part.roof, part.point_m.T
        if not self.slope_cost_m or roof.loss_m < _NOISE_M:
            return part
        slope_prior = with_slope_cost(prior, self.slope_cost_m, len(point_m), len(roof.angle_deg))
        loss_m = self._fitter.loss(roof, point_m, slope_prior)
        # eaves at different heights are those of two slopes at least, which cost as much each
        if (loss_m - _NOISE_M) * len(point_m) <= 3 * self.slope_cost_m:
            return part
        uneven = self._fitter.fit_eaves(roof, point_m, self._effort, slope_prior)
        if uneven is roof:
            return part
        uneven_loss_m = self._fitter.loss(uneven, point_m, slope_prior)
        gain_m = (loss_m - uneven_loss_m) * len(point_m) - self.slope_cost_m
        if gain_m <= 0:
            return part
        uneven = replace(uneven, loss_m=self._fitter.loss(uneven, point_m, prior))
        return Part(part.point_m, uneven, part.cost_m - gain_m)


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
