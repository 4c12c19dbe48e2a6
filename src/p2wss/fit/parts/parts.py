"""Parts of a building: polygons along the main axes of the footprint with a roof each, and what they cost.

Cuts run along the main axes of the footprint, so the polygon is first rotated to them (:func:`main_frame`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from p2wss.fit.parts.best_cut import Roofed, Rules, Side, split_roof
from p2wss.fit.parts.cutting import clearance_m, is_sound
from p2wss.fit.parts.kinds import KINDS
from p2wss.fit.parts.merging import merged_rings
from p2wss.fit.parts.roofs import Roof
from p2wss.fit.points import even_order
from p2wss.fit.roof.fitter import FittedRoof, Fitter, as_columns, flat_rings, rings_of
from p2wss.fit.roof.prior import with_slope_cost
from p2wss.fit.roof.starts import edge_groups
from p2wss.fit.roof.work import NO_PRIOR, Prior
from p2wss.fit.settings import NOISE_M, SCREENING, SEARCHING, Cutting, Effort, Settings


@dataclass(frozen=True, eq=False)
class Part:
    """A part with its roof. point_m: (3, m), as compiled code takes them. cost_m: :meth:`PartFitter.cost_m`."""

    point_m: np.ndarray
    roof: Roof
    cost_m: float

    @property
    def excess_m(self) -> float:
        """The most that better roofs might gain."""
        return self.cost_m - NOISE_M * self.point_m.shape[1]


def main_frame(rings: Sequence[np.ndarray]) -> np.ndarray:
    """Rotation (2, 2) for which the edges in ``xy @ rotation`` run along the axes as far as possible."""
    _, axis, bearing, length = edge_groups(flat_rings(rings))
    main = axis == 0
    turn = float(np.angle(np.sum(length[main] * np.exp(2j * bearing[main])))) / 2
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])


def total_cost_m(roofs: Sequence[Roof], cutting: Cutting) -> float:
    """The loss summed over all points, plus the price of each part after the first."""
    num_points = sum(roof.num_points for roof in roofs)
    return sum(roof.total_loss_m for roof in roofs) + (len(roofs) - 1) * cutting.price_m(num_points)


class PartFitter:
    """Fits the parts of one building.

    num_points: of the building. price_m, slope_cost_m: what a part and each of its slopes cost in the sum of the
    residuals. Without a price there is only one part, which has one eave height as in the paper. Parts that result from
    cuts and mergers get one round over their edges.
    """

    def __init__(self, fitter: Fitter, effort: Effort, cutting: Cutting, num_points: int) -> None:
        self.cutting = cutting
        self.price_m = cutting.price_m(num_points)
        self.slope_cost_m = cutting.slope_share * self.price_m if cutting.max_parts > 1 else 0.0
        self._fitter = fitter
        self._effort = effort
        self._one_round = effort._replace(max_rounds=1)

    def whole(
        self, rings: Sequence[np.ndarray], point_m: np.ndarray, guesses: Sequence[np.ndarray], prior: Prior
    ) -> Part | None:
        """The whole building as one part; None if no roof can be fitted. point_m: (m, 3), in even order."""
        slope_prior = with_slope_cost(prior, self.slope_cost_m, len(point_m), sum(map(len, rings)))
        roof = self._fitter.fit(rings, point_m, self._effort, guesses, slope_prior)
        # the prior describes the whole building, so parts are compared without it
        return None if roof is None else self._part(roof, as_columns(point_m))

    def cut(self, part: Part, min_gain_m: float) -> tuple[Part, Part] | None:
        """The two sides of the best cut, None if no cut gains ``min_gain_m``."""
        num_points, min_points = part.point_m.shape[1], self.cutting.min_points
        if part.excess_m < min_gain_m or num_points < 2 * min_points:
            return None
        polygon, limits = flat_rings(part.roof.rings), self._fitter.limits
        work_at = self._fitter.work(2 * len(polygon.xy_m) + 8, num_points)
        rules = Rules(
            work_at,
            Settings(SCREENING, limits),
            Settings(self._one_round, limits),
            min_points,
            clearance_m(polygon, work_at),
            self.slope_cost_m,
        )
        roofed = Roofed(polygon, part.roof.angle_deg, part.point_m)
        line, *sides = split_roof(roofed, part.cost_m - min_gain_m, rules)
        if line.axis < 0:
            return None
        is_high = part.point_m[line.axis] >= line.position
        low, high = (
            self._side(side, np.compress(within, part.point_m, axis=1))
            for within, side in zip((~is_high, is_high), sides, strict=True)
        )
        return (low, high) if part.cost_m - low.cost_m - high.cost_m >= min_gain_m else None

    def merged(self, one: Part, other: Part) -> Part | None:
        """Two parts as a single one with a new roof; None if they do not touch along an edge, if their union is too
        thin, or if a quick fit shows that it would cost more than both and a price."""
        rings = merged_rings(one.roof.rings, other.roof.rings)
        if rings is None:
            return None
        columns = np.hstack([one.point_m, other.point_m])
        columns = np.ascontiguousarray(columns[:, even_order(columns.T)])
        polygon, point_m = flat_rings(rings), columns.T
        num_edges = len(polygon.xy_m)
        if not is_sound(polygon, np.inf, self._fitter.work(num_edges, len(point_m))):
            return None
        prior = with_slope_cost(NO_PRIOR, self.slope_cost_m, len(point_m), num_edges)
        if num_edges <= SEARCHING.many_edges:
            quick = self._fitter.fit(rings, point_m, SCREENING, (), prior)
            max_cost_m = self.cutting.merger_slack * (one.cost_m + other.cost_m + self.price_m)
            if quick is None or quick.total_loss_m > max_cost_m:
                return None
        roof = self._fitter.fit(rings, point_m, self._one_round, (), prior)
        return None if roof is None else self._part(roof, columns)

    def final_roof(self, part: Part, prior: Prior) -> Roof:
        """The roof of a part with whole degrees, or of the kind that is best beside it."""
        roof, point_m = part.roof, part.point_m.T
        slope_prior = with_slope_cost(prior, self.slope_cost_m, len(point_m), len(roof.angle_deg))
        level = FittedRoof(roof.rings, roof.angle_deg, roof.eave_z_m, roof.loss_m, len(point_m))
        return self._best_kind(self._fitter.tidy(level, point_m, self._effort, slope_prior), point_m, prior)

    def cost_m(self, roof: Roof) -> float:
        """What a roof costs: the sum of its residuals, and the price of its slopes."""
        return roof.total_loss_m + roof.num_slopes * self.slope_cost_m

    def _side(self, side: Side, point_m: np.ndarray) -> Part:
        """The part on one side of a cut, with its points (3, m)."""
        rings, num_points = rings_of(side.polygon), point_m.shape[1]
        return self._part(FittedRoof(rings, side.angle_deg, side.eave_z_m, side.loss_m, num_points), point_m)

    def _part(self, roof: FittedRoof, point_m: np.ndarray) -> Part:
        """A part with a roof that is fitted to its points (3, m), or one of another kind."""
        best = self._best_kind(roof, point_m.T, NO_PRIOR)
        return Part(point_m, best, self.cost_m(best))

    def _best_kind(self, roof: FittedRoof, point_m: np.ndarray, prior: Prior) -> Roof:
        """The roof, or that of another kind which costs least with its loss over all points (m, 3)."""
        roof = replace(roof, loss_m=self._fitter.loss(roof, point_m, prior))
        if not self.slope_cost_m:
            return roof
        arguments = self._fitter, roof, point_m, self._effort, prior, self.slope_cost_m
        others = [kind(*arguments) for kind in KINDS]
        return min([roof, *filter(None, others)], key=self.cost_m)
