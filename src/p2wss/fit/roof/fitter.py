"""Fits the paper's building to points: one eave height, an angle per edge, and at most one flat top."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import shapely

from p2wss.fit.linkage import linked_work
from p2wss.fit.points import even_order, every_kth
from p2wss.fit.roof.eaves import fit_eaves, moved_walls
from p2wss.fit.roof.rounds import fit_roof, improve_roof, tidy_roof
from p2wss.fit.roof.solve import IMPOSSIBLE
from p2wss.fit.roof.work import NO_PRIOR, FitWork, Prior, Settings
from p2wss.skeleton.queries import OUTSIDE

# fewer points show no roof
MIN_NUM_POINTS = 3


@dataclass(frozen=True)
class Effort:
    """How much a fit may cost.

    num_search_points: sample of the search. num_points: of the last rounds. num_followed: starts that are improved
    after a first round. num_descents: starts from which the classes are searched. max_rounds: of such a search over
    all edges; one fewer with a flat top.
    """

    num_search_points: int = 64
    num_points: int = 300
    num_followed: int = 5
    num_descents: int = 1
    max_rounds: int = 2


@dataclass(frozen=True)
class Limits:
    """What a roof may be, and what a change has to gain, in metres of loss.

    cap_m: larger residuals count as this. flat_top: try roofs with a flat top. uneven_eaves: try eaves at different
    heights, where there may be several parts. top_gain_m: gain that a flat top
    needs. class_gain_m: gain that another class of an edge needs with 150 points, proportionally more with fewer.
    separate_slope_gain_m: gain that different slopes of edges that face the same way need. rounding_m: what whole
    degrees and equal angles of edges that face the same way may cost.
    """

    cap_m: float = 1.0
    flat_top: bool = True
    uneven_eaves: bool = True
    max_roof_height_m: float = 12.0
    top_gain_m: float = 0.01
    class_gain_m: float = 0.002
    separate_slope_gain_m: float = 0.006
    rounding_m: float = 0.01


@dataclass(frozen=True)
class FittedRoof:
    """A roof over a polygon: a building, a part of one, or a box.

    rings: each (n, 2), exterior first. angle_deg: one per edge, rings in order: 0, 90 or 5 to 75. eave_z_m: in the
    heights of the points. top_m: height of a flat cut above the eave, infinity for none. loss_m: mean over the
    points of min(|distance to the roof|, cap), plus the cost of a prior. outward_m: (n,), how far outside its edge
    each slope begins, so that its eave is higher than ``eave_z_m``; None: all eaves have that height.
    """

    rings: Sequence[np.ndarray]
    angle_deg: np.ndarray
    eave_z_m: float
    top_m: float
    loss_m: float
    num_points: int
    outward_m: np.ndarray | None = None

    @cached_property
    def slope_rings(self) -> Sequence[np.ndarray]:
        """Where slopes begin: the kernel's roof over these rings, cut off at ``rings``, is this roof."""
        if self.outward_m is None:
            return self.rings
        xy_m, ring_offset = flat_rings(self.rings)
        moved_m = moved_walls(xy_m, ring_offset, self.outward_m)
        return [moved_m[first:last] for first, last in pairwise(ring_offset.tolist())]

    @property
    def total_loss_m(self) -> float:
        return self.loss_m * self.num_points


@dataclass(frozen=True)
class Gain:
    """How much one more part or box must lower the loss.

    gain_m: in the mean over all points of the building. cost_m: at least this much in the sum over the points,
    however few there are.
    """

    gain_m: float = 0.012
    cost_m: float = 1.0

    def min_gain_m(self, num_points: int) -> float:
        """The minimum in the sum over the points of a building that has ``num_points``."""
        return max(self.gain_m * num_points, self.cost_m)


class Fitter:
    """Fits roofs to points, one polygon at a time; keeps its work arrays from one polygon to the next."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._work: FitWork = linked_work(32, 1024)
        # of a loss, which needs no search
        self._loss_settings = self.settings(Effort())

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
        """The best roof over a polygon for the points (m, 3) inside it, which are in the frame of the rings and in
        the order of :func:`p2wss.fit.points.even_order`. None with fewer than three points or a polygon that the
        kernel refuses. Deterministic.

        guesses: angles per edge to start from, besides a few simple roofs.

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
            IMPOSSIBLE,
            0.0,
            self.work(len(xy_m), len(point_m)),
            self.settings(effort),
            prior,
        )
        return None if loss >= IMPOSSIBLE else FittedRoof(rings, angle, eave, top, loss, len(point_m))

    def fit_whole(
        self,
        rings: Sequence[np.ndarray],
        point_m: np.ndarray,
        effort: Effort,
        guesses: Sequence[np.ndarray] = (),
        prior: Prior = NO_PRIOR,
    ) -> FittedRoof | None:
        """As :meth:`fit` with points in any order, followed by :meth:`tidy`."""
        point_m = point_m[even_order(point_m)]
        roof = self.fit(rings, point_m, effort, guesses, prior)
        return None if roof is None else self.tidy(roof, point_m, effort, prior)

    def tidy(
        self, roof: FittedRoof, point_m: np.ndarray, effort: Effort, prior: Prior = NO_PRIOR
    ) -> FittedRoof:
        """A result of :meth:`fit` with whole degrees where that costs little; the points are in even order."""
        loss, eave, top, angle = tidy_roof(*self._arguments(roof, point_m, effort, prior))
        return replace(roof, angle_deg=angle, eave_z_m=eave, top_m=top, loss_m=loss)

    def fit_eaves(
        self, roof: FittedRoof, point_m: np.ndarray, effort: Effort, prior: Prior = NO_PRIOR
    ) -> FittedRoof:
        """The best roof with an eave height for each of its slopes, sought from a roof with level eaves and from gable
        roofs; the roof itself if there is none. The points are in even order."""
        if not self.limits.uneven_eaves:
            return roof
        loss, eave, top, angle, outward = fit_eaves(*self._arguments(roof, point_m, effort, prior))
        if loss >= IMPOSSIBLE:
            return roof
        return replace(roof, angle_deg=angle, eave_z_m=eave, top_m=top, loss_m=loss, outward_m=outward)

    def _arguments(
        self, roof: FittedRoof, point_m: np.ndarray, effort: Effort, prior: Prior
    ) -> tuple[Any, ...]:
        """A roof with level eaves, its points and settings, as compiled code takes them."""
        xy_m, ring_offset = flat_rings(roof.rings)
        return (
            xy_m,
            ring_offset,
            *self._points(point_m, effort),
            np.array(roof.angle_deg, np.float64),
            float(roof.eave_z_m),
            float(roof.top_m),
            self.work(len(xy_m), len(point_m)),
            self.settings(effort),
            prior,
        )

    def loss(self, roof: FittedRoof, point_m: np.ndarray, prior: Prior = NO_PRIOR) -> float:
        """Loss of a roof on points (m, 3), metres."""
        xy_m, ring_offset = flat_rings(roof.slope_rings)
        return improve_roof(
            xy_m,
            ring_offset,
            *np.ascontiguousarray(point_m.T, np.float64),
            np.array(roof.angle_deg, np.float64),
            float(roof.eave_z_m),
            float(roof.top_m),
            0,
            self.work(len(xy_m), len(point_m)),
            self._loss_settings,
            prior,
        )

    def roof_over(self, roof: FittedRoof, point_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(height of a roof, z of its unit normal) over each point (m, 3); minus infinity and 1 outside its polygon."""
        if self.loss(roof, point_m) >= IMPOSSIBLE or not len(point_m):
            return np.full(len(point_m), -np.inf), np.ones(len(point_m))
        work = self._work
        face, rise = work.face[: len(point_m)], work.rise[: len(point_m)]
        is_outside = face == OUTSIDE
        if roof.outward_m is not None:
            # the kernel's roof reaches beyond the walls
            polygon = shapely.Polygon(roof.rings[0], roof.rings[1:])
            is_outside |= ~shapely.contains_xy(polygon, point_m[:, 0], point_m[:, 1])
        height = np.where(is_outside, -np.inf, roof.eave_z_m + rise)
        return height, np.where(face >= 0, work.cosine[face], 1.0)

    def settings(self, effort: Effort) -> Settings:
        """Effort and limits in the form that compiled code takes."""
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
            float(limits.separate_slope_gain_m),
            float(limits.rounding_m),
        )

    def work(self, num_edges: int, num_points: int) -> int:
        """The address of work arrays for at least this many edges and points."""
        if num_edges > len(self._work.tangent) or num_points > len(self._work.face):
            work = linked_work(max(num_edges, len(self._work.tangent)), max(num_points, len(self._work.face)))
            work.num_evaluations[:] = self._work.num_evaluations
            self._work = work
        return self._work.at

    @staticmethod
    def _points(point_m: np.ndarray, effort: Effort) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if len(point_m) > effort.num_points:
            point_m = point_m[every_kth(len(point_m), effort.num_points)]
        x, y, z = np.ascontiguousarray(point_m.T, np.float64)
        return x, y, z


def flat_rings(rings: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(vertices (n, 2), offsets of the rings) for compiled code."""
    xy_m = np.ascontiguousarray(np.concatenate(list(rings)) if len(rings) > 1 else rings[0], np.float64)
    return xy_m, np.array([0, *accumulate(map(len, rings))], np.int64)
