"""Fits the paper's building to points: one eave height and an angle per edge; also eaves at different heights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, pairwise

import manifold3d
import numpy as np
import shapely

from p2wss.fit.linkage import linked_work
from p2wss.fit.mesh.parametric import kernel_mesh
from p2wss.fit.parts.roofs import Roof
from p2wss.fit.points import every_kth
from p2wss.fit.roof.eaves import fit_eaves, moved_walls
from p2wss.fit.roof.rounds import fit_roof, improve_roof, tidy_roof
from p2wss.fit.roof.solve import IMPOSSIBLE
from p2wss.fit.roof.work import NO_PRIOR, Context, FitWork, Polygon, Prior
from p2wss.fit.settings import EFFORT, Effort, Limits, Settings
from p2wss.mesh.planes import snap_vertices
from p2wss.skeleton.queries import OUTSIDE

# fewer points show no roof
MIN_NUM_POINTS = 3


@dataclass(frozen=True)
class FittedRoof(Roof):
    """A roof of the kernel, cut off at its rings. outward_m: (n,), how far outside its edge each slope begins, so that
    its eave is higher than ``eave_z_m``; None: all eaves have that height."""

    outward_m: np.ndarray | None = None

    @cached_property
    def slope_rings(self) -> Sequence[np.ndarray]:
        if self.outward_m is None:
            return self.rings
        polygon = flat_rings(self.rings)
        return rings_of(polygon._replace(xy_m=moved_walls(polygon, self.outward_m)))

    @property
    def is_level_at_eaves(self) -> bool:
        return self.outward_m is None

    @property
    def num_slopes(self) -> int:
        """Eaves at different heights cost as much as one more slope."""
        is_slope = (self.angle_deg > 0) & (self.angle_deg < 90)
        return int(is_slope.sum()) + (self.outward_m is not None)

    def height_over(self, point_m: np.ndarray, fitter: Fitter) -> tuple[np.ndarray, np.ndarray]:
        return fitter.roof_over(self, point_m)

    def solid(self, min_eave_height_m: float, max_roof_height_m: float) -> manifold3d.Manifold | None:
        eave_m = max(self.eave_z_m, min_eave_height_m)
        solid = kernel_solid(self.slope_rings, self.angle_deg, eave_m, max_roof_height_m)
        if solid is None or self.outward_m is None:
            return solid
        flat_deg, high_m = np.zeros(len(self.angle_deg)), float(solid.bounding_box()[5]) + 1.0
        walls = kernel_solid(self.rings, flat_deg, high_m, max_roof_height_m)
        return None if walls is None else solid ^ walls


def kernel_solid(
    rings: Sequence[np.ndarray], angle_deg: np.ndarray, eave_m: float, max_roof_height_m: float
) -> manifold3d.Manifold | None:
    """The kernel's solid over a polygon, with exactly its coordinates; None if the kernel refuses it."""
    mesh = kernel_mesh(rings, angle_deg, eave_m, max_roof_height_m)
    if mesh is None:
        return None
    vertex_m = snap_vertices(mesh.vertex_m, np.concatenate(list(rings)))
    return manifold3d.Manifold(manifold3d.Mesh64(vertex_m, mesh.triangle.astype(np.uint64)))


class Fitter:
    """Fits roofs to points, one polygon at a time; keeps its work arrays from one polygon to the next."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._work: FitWork = linked_work(32, 1024)

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
        polygon = flat_rings(rings)
        guess_deg = np.array(guesses, np.float64).reshape(-1, len(polygon.xy_m))
        context = self.context(polygon, len(point_m), effort, prior)
        loss, eave, angle = fit_roof(polygon, _sample(point_m, effort), guess_deg, context)
        return None if loss >= IMPOSSIBLE else FittedRoof(rings, angle, eave, loss, len(point_m))

    def tidy(
        self, roof: FittedRoof, point_m: np.ndarray, effort: Effort, prior: Prior = NO_PRIOR
    ) -> FittedRoof:
        """A result of :meth:`fit` with whole degrees where that costs little; the points are in even order."""
        loss, eave, angle = tidy_roof(*self._arguments(roof, point_m, effort, prior))
        return replace(roof, angle_deg=angle, eave_z_m=eave, loss_m=loss)

    def fit_eaves(
        self, roof: FittedRoof, point_m: np.ndarray, effort: Effort, prior: Prior = NO_PRIOR
    ) -> FittedRoof | None:
        """The best roof with an eave height for each of its slopes, sought from a roof with level eaves and from gable
        roofs; None if there is none. The points are in even order."""
        if not self.limits.uneven_eaves:
            return None
        loss, eave, angle, outward = fit_eaves(*self._arguments(roof, point_m, effort, prior))
        if loss >= IMPOSSIBLE:
            return None
        return replace(roof, angle_deg=angle, eave_z_m=eave, loss_m=loss, outward_m=outward)

    def _arguments(
        self, roof: FittedRoof, point_m: np.ndarray, effort: Effort, prior: Prior
    ) -> tuple[Polygon, np.ndarray, np.ndarray, float, Context]:
        """A roof with level eaves, its points and settings, as compiled code takes them."""
        polygon = flat_rings(roof.rings)
        context = self.context(polygon, len(point_m), effort, prior)
        angle_deg = np.array(roof.angle_deg, np.float64)
        return polygon, _sample(point_m, effort), angle_deg, float(roof.eave_z_m), context

    def loss(self, roof: FittedRoof, point_m: np.ndarray, prior: Prior = NO_PRIOR) -> float:
        """Loss of a roof on points (m, 3), metres."""
        polygon = flat_rings(roof.slope_rings)
        angle_deg = np.array(roof.angle_deg, np.float64)
        context = self.context(polygon, len(point_m), prior=prior)
        return improve_roof(polygon, as_columns(point_m), angle_deg, float(roof.eave_z_m), 0, context)

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


def _sample(point_m: np.ndarray, effort: Effort) -> np.ndarray:
    """The points (3, k) of the last rounds."""
    if len(point_m) > effort.num_points:
        point_m = point_m[every_kth(len(point_m), effort.num_points)]
    return as_columns(point_m)


def as_columns(point_m: np.ndarray) -> np.ndarray:
    """Points (m, 3) as compiled code takes them: (3, m), contiguous."""
    return np.ascontiguousarray(point_m.T, np.float64)


def flat_rings(rings: Sequence[np.ndarray]) -> Polygon:
    """The rings, each (n, 2), as compiled code takes them."""
    xy_m = np.ascontiguousarray(np.concatenate(list(rings)) if len(rings) > 1 else rings[0], np.float64)
    return Polygon(xy_m, np.array([0, *accumulate(map(len, rings))], np.int64))


def rings_of(polygon: Polygon) -> list[np.ndarray]:
    """The rings, each (n, 2), of a polygon in the form of :func:`flat_rings`."""
    return [polygon.xy_m[first:last] for first, last in pairwise(polygon.ring_offset.tolist())]
