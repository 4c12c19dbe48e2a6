"""One eave height, an angle per edge, at most one flat top: the paper's building, fitted to points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from p2wss.refine.points import even_order, every_kth
from p2wss.refine.search import polish, search
from p2wss.refine.solve import IMPOSSIBLE
from p2wss.refine.starts import Edges, edges, starts
from p2wss.refine.work import FitWork, Problem, fit_work

# fewer points show no roof
MIN_NUM_POINTS = 3
_FLAT_TOP_QUANTILES = (0.6, 0.8, 0.93)
_LOW_QUANTILE = 0.05
_STEEP_DEG = 58.0
_LAST_ROUNDS = 6
# with less loss no flat top is looked for; one that starts worse than the roof without by this is left
_GOOD_ENOUGH_M, _TOP_WORTH_M = 0.06, 0.05
# above these the search is cut short, and left to the starts
_MANY_EDGES, _TOO_MANY_EDGES = 40, 120
_NEARLY_GABLE_DEG = 60.0
# heights of flat tops that are worth a try
_LOWEST_TOP_M = 0.4


@dataclass(frozen=True)
class Effort:
    """How much a fit may cost. num_search_points: of the search; num_points: of the last rounds.
    num_descents: starts whose classes are searched, max_rounds: over the edges, each."""

    num_search_points: int = 64
    num_points: int = 300
    num_descents: int = 1
    max_rounds: int = 2
    with_sheds: bool = False


@dataclass(frozen=True)
class Limits:
    """What a roof may be, and what a change has to gain, in metres of loss.

    cap_m: residuals count up to this. flat_top: try roofs that are cut flat. top_gain_m: that this must gain.
    class_gain_m: that another class for an edge must gain, with 150 points; with fewer proportionally more.
    rounding_m: that whole degrees and equal angles for edges that face the same way may cost.
    """

    cap_m: float = 1.0
    flat_top: bool = True
    max_roof_height_m: float = 12.0
    top_gain_m: float = 0.01
    class_gain_m: float = 0.002
    rounding_m: float = 0.01


@dataclass(frozen=True)
class OneHeight:
    """A fitted building. rings: each (n, 2), exterior first. angle_deg: one per edge, rings in order: 0, 90 or
    5 to 75. eave_z_m: in the heights of the points. top_m: height of a flat cut above the eave, infinity for
    none. loss_m: mean over the points of min(|distance to the roof|, cap)."""

    rings: Sequence[np.ndarray]
    angle_deg: np.ndarray
    eave_z_m: float
    top_m: float
    loss_m: float
    num_points: int

    @property
    def total_loss_m(self) -> float:
        return self.loss_m * self.num_points


class Fitter:
    """Fits one polygon to the points inside it; keeps its work arrays from one polygon to the next."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._work: FitWork = fit_work(32, 1024)

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
    ) -> OneHeight | None:
        """The best building over the polygon for points (m, 3) inside it, in the frame of the rings, in any
        order. ``guesses``: angles per edge to begin with, beside a few simple roofs. None: fewer than three
        points, or a polygon that the kernel refuses. Deterministic.

        The loss is never above that of a flat roof or of a guess with its best height, all angles whole.
        """
        if len(point_m) < MIN_NUM_POINTS:
            return None
        return Fit(self, rings, point_m[even_order(point_m)], effort).run(guesses)

    def fit_whole(
        self,
        rings: Sequence[np.ndarray],
        point_m: np.ndarray,
        effort: Effort,
        guesses: Sequence[np.ndarray] = (),
    ) -> OneHeight | None:
        """As :meth:`fit`, then whole degrees where that costs little."""
        if len(point_m) < MIN_NUM_POINTS:
            return None
        fit = Fit(self, rings, point_m[even_order(point_m)], effort)
        found = fit.run(guesses)
        return None if found is None else fit.tidy(found)

    def tidied(self, found: OneHeight, point_m: np.ndarray, effort: Effort) -> OneHeight:
        """An earlier result with whole degrees where that costs little."""
        return Fit(self, found.rings, point_m[even_order(point_m)], effort).tidy(found)

    def loss(self, one: OneHeight, point_m: np.ndarray) -> float:
        """Loss of a given building on points (m, 3)."""
        fit = Fit(self, one.rings, point_m, Effort(num_points=len(point_m)))
        return fit.polished(one.angle_deg, one.eave_z_m, one.top_m, num_rounds=0).loss_m

    def work(self, num_edges: int, num_points: int) -> FitWork:
        if num_edges > len(self._work.tangent) or num_points > len(self._work.face):
            grown = fit_work(max(num_edges, len(self._work.tangent)), max(num_points, len(self._work.face)))
            grown.num_evaluations[:] = self._work.num_evaluations
            self._work = grown
        return self._work


class Fit:
    """One polygon with its points, in an even order, for the fits of one :class:`Fitter`."""

    def __init__(
        self, fitter: Fitter, rings: Sequence[np.ndarray], point_m: np.ndarray, effort: Effort
    ) -> None:
        self.limits, self.rings = fitter.limits, rings
        self.xy_m = np.ascontiguousarray(np.concatenate(list(rings)), np.float64)
        # the search grows with the cube of the number of edges
        if len(self.xy_m) > _MANY_EDGES:
            effort = replace(effort, max_rounds=min(effort.max_rounds, 1))
        if len(self.xy_m) > _TOO_MANY_EDGES:
            effort = replace(effort, num_descents=0)
        self.effort = effort
        self.ring_offset = np.concatenate([[0], np.cumsum([len(ring) for ring in rings])]).astype(np.int64)
        self.edges: Edges = edges(rings)
        self.few = self._problem(point_m[every_kth(len(point_m), effort.num_search_points)])
        self.all = self._problem(point_m[every_kth(len(point_m), effort.num_points)])
        self.num_points = len(point_m)
        self.work = fitter.work(len(self.xy_m), max(len(self.all.x), len(self.few.x)))
        self.class_gain_m = fitter.limits.class_gain_m * max(1.0, 150.0 / len(self.few.x))

    def _problem(self, point_m: np.ndarray) -> Problem:
        x, y = (np.ascontiguousarray(point_m[:, k] - self.xy_m[0, k]) for k in range(2))
        direction, limits = self.edges.direction, self.limits
        return Problem(
            len(self.xy_m),
            len(self.rings),
            x,
            y,
            np.ascontiguousarray(point_m[:, 2], np.float64),
            direction,
            self.edges.num_directions,
            direction,
            self.edges.num_directions,
            limits.cap_m,
            limits.max_roof_height_m,
        )

    def run(self, guesses: Sequence[np.ndarray]) -> OneHeight | None:
        rows = starts(self.edges, guesses, self.effort.with_sheds)
        found = self._search(rows, np.full(len(rows), np.inf), self.effort.max_rounds, IMPOSSIBLE)
        if found.loss_m >= IMPOSSIBLE:
            return None
        if self.limits.flat_top and found.loss_m > _GOOD_ENOUGH_M:
            found = self._with_flat_top(found)
        if self.effort.num_points > len(self.few.x) or self.effort.num_descents == 0:
            found = self.polished(found.angle_deg, found.eave_z_m, found.top_m, num_rounds=_LAST_ROUNDS)
        return found

    def _search(
        self, start_deg: np.ndarray, start_top_m: np.ndarray, max_rounds: int, descend_below_m: float
    ) -> OneHeight:
        loss, eave, top = search(
            self.xy_m,
            self.ring_offset,
            self.few,
            self.work,
            start_deg,
            start_top_m,
            self.effort.num_descents,
            max_rounds,
            self.class_gain_m,
            descend_below_m,
        )
        return OneHeight(self.rings, start_deg[0].copy(), eave, top, loss, self.num_points)

    def polished(
        self,
        angle_deg: np.ndarray,
        eave_m: float,
        top_m: float,
        num_rounds: int,
        from_median: bool = False,
        free_angles: bool = True,
    ) -> OneHeight:
        angle = np.array(angle_deg, np.float64)
        loss, eave, top = polish(
            self.xy_m,
            self.ring_offset,
            self.all,
            self.work,
            angle,
            float(eave_m),
            float(top_m),
            from_median,
            free_angles,
            num_rounds,
        )
        return OneHeight(self.rings, angle, eave, top, loss, self.num_points)

    def _with_flat_top(self, found: OneHeight) -> OneHeight:
        """The same roof, steeper ones and a hip cut flat, at a few heights that the points suggest."""
        low, *tops = np.quantile(self.few.z, (_LOW_QUANTILE, *_FLAT_TOP_QUANTILES))
        # a flat roof may have taken the height of the top
        rise = np.array(tops) - min(found.eave_z_m, low)
        rise = rise[rise > _LOWEST_TOP_M]
        if not len(rise) or not len(self.few.x):
            return found
        slopes = (found.angle_deg > 0) & (found.angle_deg < 90)
        roofs = [found.angle_deg, np.where(slopes, _STEEP_DEG, found.angle_deg), np.full(len(slopes), 55.0)]
        rows = np.repeat(np.array(roofs), len(rise), axis=0)
        cut = self._search(rows, np.tile(rise, len(roofs)), 1, found.loss_m + _TOP_WORTH_M)
        return cut if cut.loss_m < found.loss_m - self.limits.top_gain_m else found

    def rounded(self, found: OneHeight) -> OneHeight:
        """Whole degrees, heights fitted again, unless that costs too much."""
        whole = np.round(found.angle_deg)
        if np.array_equal(whole, found.angle_deg):
            return found
        made = self.polished(whole, found.eave_z_m, found.top_m, num_rounds=3, free_angles=False)
        return made if made.loss_m <= found.loss_m + self.limits.rounding_m else found

    def tidy(self, found: OneHeight) -> OneHeight:
        """Whole degrees where that costs little; a roof as good as flat has only 0 degree edges."""
        here = self.polished(found.angle_deg, found.eave_z_m, found.top_m, num_rounds=0)
        zero = np.zeros(len(found.angle_deg))
        flat = self.polished(zero, found.eave_z_m, np.inf, num_rounds=3, from_median=True)
        if flat.loss_m <= here.loss_m + self.class_gain_m:
            return flat
        for direction in range(self.edges.num_directions):
            # the end of a gable roof: hardly a point tells a steep face from an upright one
            own = self.edges.direction == direction
            steep = own & (here.angle_deg > _NEARLY_GABLE_DEG) & (here.angle_deg < 90)
            if steep.any():
                upright = np.where(steep, 90.0, here.angle_deg)
                gable = self.polished(upright, here.eave_z_m, here.top_m, num_rounds=3)
                if gable.loss_m <= here.loss_m + self.class_gain_m:
                    here = gable
        return self.rounded(here)
