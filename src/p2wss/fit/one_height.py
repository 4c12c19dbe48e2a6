"""One eave height, an angle per edge, at most one flat top: the paper's building, fitted to points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from p2wss.fit.linkage import linked_work
from p2wss.fit.points import even_order, every_kth
from p2wss.fit.roof import fit_roof, improved_roof, tidy_roof
from p2wss.fit.solve import IMPOSSIBLE
from p2wss.fit.work import NO_PRIOR, FitWork, Prior, Settings

# fewer points show no roof
MIN_NUM_POINTS = 3


@dataclass(frozen=True)
class Effort:
    """How much a fit may cost. num_search_points: of the search; num_points: of the last rounds.
    num_followed: starts that are improved; num_descents: of these, whose classes are searched; max_rounds: over
    the edges, each, one less with roofs cut flat."""

    num_search_points: int = 64
    num_points: int = 300
    num_followed: int = 5
    num_descents: int = 1
    max_rounds: int = 2


@dataclass(frozen=True)
class Limits:
    """What a roof may be, and what a change has to gain, in metres of loss.

    cap_m: residuals count up to this. flat_top: try roofs that are cut flat. top_gain_m: that this must gain.
    class_gain_m: that another class for an edge must gain, with 150 points; with fewer proportionally more.
    own_slope_gain_m: that different slopes of edges that face the same way must gain.
    rounding_m: that whole degrees and equal angles for edges that face the same way may cost.
    """

    cap_m: float = 1.0
    flat_top: bool = True
    max_roof_height_m: float = 12.0
    top_gain_m: float = 0.01
    class_gain_m: float = 0.002
    own_slope_gain_m: float = 0.006
    rounding_m: float = 0.01


@dataclass(frozen=True)
class OneHeight:
    """A fitted building. rings: each (n, 2), exterior first. angle_deg: one per edge, rings in order: 0, 90 or
    5 to 75. eave_z_m: in the heights of the points. top_m: height of a flat cut above the eave, infinity for
    none. loss_m: mean over the points of min(|distance to the roof|, cap), and what a prior adds."""

    rings: Sequence[np.ndarray]
    angle_deg: np.ndarray
    eave_z_m: float
    top_m: float
    loss_m: float
    num_points: int

    @property
    def total_loss_m(self) -> float:
        return self.loss_m * self.num_points


@dataclass(frozen=True)
class Gain:
    """What one more part or box must lower the loss by. gain_m: in the mean over all points of the building;
    cost_m: and at least so much in sum, however few points there are."""

    gain_m: float = 0.012
    cost_m: float = 1.0

    def least_gain_m(self, num_points: int) -> float:
        """In sum, on a building with so many points."""
        return max(self.gain_m * num_points, self.cost_m)


class Fitter:
    """Fits one polygon to the points inside it; keeps its work arrays from one polygon to the next."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._work: FitWork = linked_work(32, 1024)

    @property
    def num_evaluations(self) -> int:
        """Roofs looked at so far."""
        return int(self._work.num_evaluations[0])

    def fit(
        self,
        rings: Sequence[np.ndarray],
        point_m: np.ndarray,
        effort: Effort,
        guesses: Sequence[np.ndarray] = (),
        prior: Prior = NO_PRIOR,
    ) -> OneHeight | None:
        """The best building over the polygon for points (m, 3) inside it, in the frame of the rings, in the
        order of :func:`p2wss.fit.points.even_order`. ``guesses``: angles per edge to begin with, beside a
        few simple roofs. None: fewer than three points, or a polygon that the kernel refuses. Deterministic.

        The loss is never above that of a flat roof or of a guess with its best height.
        """
        if len(point_m) < MIN_NUM_POINTS:
            return None
        xy_m, ring_offset = flat_rings(rings)
        rows = np.array(guesses, np.float64).reshape(-1, len(xy_m))
        loss, eave, top, angle = fit_roof(
            xy_m,
            ring_offset,
            *self._points(point_m, effort),
            rows,
            self.work(len(xy_m), len(point_m)),
            self.settings(effort),
            prior,
        )
        return None if loss >= IMPOSSIBLE else OneHeight(rings, angle, eave, top, loss, len(point_m))

    def fit_whole(
        self,
        rings: Sequence[np.ndarray],
        point_m: np.ndarray,
        effort: Effort,
        guesses: Sequence[np.ndarray] = (),
        prior: Prior = NO_PRIOR,
    ) -> OneHeight | None:
        """As :meth:`fit` with points in any order, then whole degrees where that costs little."""
        point_m = point_m[even_order(point_m)]
        found = self.fit(rings, point_m, effort, guesses, prior)
        return None if found is None else self.tidied(found, point_m, effort, prior)

    def tidied(
        self, found: OneHeight, point_m: np.ndarray, effort: Effort, prior: Prior = NO_PRIOR
    ) -> OneHeight:
        """An earlier result with whole degrees where that costs little; points in even order."""
        xy_m, ring_offset = flat_rings(found.rings)
        loss, eave, top, angle = tidy_roof(
            xy_m,
            ring_offset,
            *self._points(point_m, effort),
            found.angle_deg,
            found.eave_z_m,
            found.top_m,
            self.work(len(xy_m), len(point_m)),
            self.settings(effort),
            prior,
        )
        return replace(found, angle_deg=angle, eave_z_m=eave, top_m=top, loss_m=loss)

    def loss(self, one: OneHeight, point_m: np.ndarray, prior: Prior = NO_PRIOR) -> float:
        """Loss of a given building on points (m, 3)."""
        xy_m, ring_offset = flat_rings(one.rings)
        every = Effort(num_points=len(point_m))
        return improved_roof(
            xy_m,
            ring_offset,
            *self._points(point_m, every),
            np.array(one.angle_deg, np.float64),
            float(one.eave_z_m),
            float(one.top_m),
            0,
            self.work(len(xy_m), len(point_m)),
            self.settings(every),
            prior,
        )

    def settings(self, effort: Effort) -> Settings:
        """Effort and limits as compiled code takes them."""
        limits = self.limits
        return Settings(
            effort.num_search_points,
            effort.num_points,
            effort.num_followed,
            effort.num_descents,
            effort.max_rounds,
            limits.flat_top,
            float(limits.cap_m),
            float(limits.max_roof_height_m),
            float(limits.top_gain_m),
            float(limits.class_gain_m),
            float(limits.own_slope_gain_m),
            float(limits.rounding_m),
        )

    def work(self, num_edges: int, num_points: int) -> FitWork:
        """Work arrays that are large enough."""
        if num_edges > len(self._work.tangent) or num_points > len(self._work.face):
            grown = linked_work(
                max(num_edges, len(self._work.tangent)), max(num_points, len(self._work.face))
            )
            grown.num_evaluations[:] = self._work.num_evaluations
            self._work = grown
        return self._work

    @staticmethod
    def _points(point_m: np.ndarray, effort: Effort) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        chosen = point_m[every_kth(len(point_m), effort.num_points)].T
        x, y, z = np.ascontiguousarray(chosen, np.float64)
        return x, y, z


def flat_rings(rings: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(vertices (n, 2), offsets of the rings) for compiled code."""
    xy_m = np.ascontiguousarray(np.concatenate(list(rings)), np.float64)
    offset = np.zeros(len(rings) + 1, np.int64)
    np.cumsum([len(ring) for ring in rings], out=offset[1:])
    return xy_m, offset
