"""Fits the paper's building to points: one eave height and an angle per edge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import numpy as np

from p2wss.fit.points import even_order, every_kth
from p2wss.fit.roof.linkage import linked_work
from p2wss.fit.roof.rounds import fit_roof, roof_loss, tidy_roof
from p2wss.fit.roof.solve import IMPOSSIBLE
from p2wss.fit.roof.work import NO_PRIOR, Context, FitWork, Polygon, Prior
from p2wss.fit.settings import EFFORT, Effort, Limits, Settings

# fewer points show no roof
MIN_NUM_POINTS = 3


@dataclass(frozen=True)
class FittedRoof:
    """A roof of the kernel over a polygon.

    rings: each (n, 2), exterior first. angle_deg: one per edge, rings in order: 0, 90 or 5 to 75. eave_z_m: height of
    the eaves. loss_m: mean residual of the points, with what the prior adds.
    """

    rings: Sequence[np.ndarray]
    angle_deg: np.ndarray
    eave_z_m: float
    loss_m: float


class Fitter:
    """Fits roofs to points, one polygon at a time; keeps its work arrays from one polygon to the next."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits

    @cached_property
    def _work(self) -> FitWork:
        return linked_work(32, 1024)

    @property
    def num_evaluations(self) -> int:
        """Number of roofs evaluated so far."""
        return int(self._work.num_evaluations[0])

    def fit(
        self,
        rings: Sequence[np.ndarray],
        point_m: np.ndarray,
        effort: Effort,
        guesses: Sequence[np.ndarray] = (),
        prior: Prior = NO_PRIOR,
    ) -> FittedRoof | None:
        """The best roof over a polygon for the points (m, 3) inside it, which are in the frame of the rings, with whole
        degrees where that costs little. None with fewer than three points or a polygon that the kernel refuses.
        Deterministic, whatever the order of the points.

        guesses: angles per edge to start from, besides a few simple roofs.

        The loss is never above that of a flat roof or of a guess with its best height.
        """
        if len(point_m) < MIN_NUM_POINTS:
            return None
        polygon = flat_rings(rings)
        ordered_m = point_m[even_order(point_m)]
        sample = as_columns(ordered_m[every_kth(len(ordered_m), effort.num_points)])
        guess_deg = np.array(guesses, np.float64).reshape(-1, len(polygon.xy_m))
        context = self.context(polygon, len(point_m), effort, prior)
        loss, eave, angle = fit_roof(polygon, sample, guess_deg, context)
        if loss >= IMPOSSIBLE:
            return None
        loss, eave, angle = tidy_roof(polygon, sample, angle, eave, context)
        roof = FittedRoof(rings, angle, eave, loss)
        return replace(roof, loss_m=self.loss(roof, point_m, prior))

    def loss(self, roof: FittedRoof, point_m: np.ndarray, prior: Prior = NO_PRIOR) -> float:
        """Loss of a roof on points (m, 3), metres."""
        polygon = flat_rings(roof.rings)
        angle_deg = np.array(roof.angle_deg, np.float64)
        context = self.context(polygon, len(point_m), prior=prior)
        return roof_loss(polygon, as_columns(point_m), angle_deg, float(roof.eave_z_m), context)

    def context(
        self, polygon: Polygon, num_points: int, effort: Effort = EFFORT, prior: Prior = NO_PRIOR
    ) -> Context:
        """What compiled code takes besides a polygon and so many points. effort: of a search."""
        return Context(self.work(len(polygon.xy_m), num_points), Settings(effort, self.limits), prior)

    def work(self, num_edges: int, num_points: int) -> int:
        """The address of work arrays for at least this many edges and points."""
        if num_edges > len(self._work.tangent) or num_points > len(self._work.face):
            work = linked_work(max(num_edges, len(self._work.tangent)), max(num_points, len(self._work.face)))
            work.num_evaluations[:] = self._work.num_evaluations
            self._work = work
        return self._work.at


def as_columns(point_m: np.ndarray) -> np.ndarray:
    """Points (m, 3) as compiled code takes them: (3, m), contiguous."""
    return np.ascontiguousarray(point_m.T, np.float64)


def flat_rings(rings: Sequence[np.ndarray]) -> Polygon:
    """The rings, each (n, 2), as compiled code takes them."""
    xy_m = np.ascontiguousarray(np.concatenate(list(rings)) if len(rings) > 1 else rings[0], np.float64)
    return Polygon(xy_m, np.array([0, *accumulate(map(len, rings))], np.int64))
