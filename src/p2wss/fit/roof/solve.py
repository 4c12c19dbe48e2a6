"""Height and slopes of roofs over one polygon, by iteratively reweighted least squares, several roofs at a time.

While the face over every point stays the same, z = eave + tan(angle) * distance is linear in the unknowns. So
each round asks the kernel for the faces, solves for the unknowns, and keeps the step only if the true loss falls.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from p2wss.fit.settings import USUAL_SLOPE_DEG, Parametric
from p2wss.skeleton import Polygons, Status, roof_points
from p2wss.skeleton.angles import slope_angles, tangents


@dataclass(frozen=True)
class Problem:
    """A polygon and the points over it.

    polygon: a single one. point_m: (m, 3). direction: int (n,), edges with the same number share their slope.
    degree_cost_m: the cost of each degree by which a slope differs from the usual slope. max_roof_height_m: above the
    eave.
    """

    polygon: Polygons
    point_m: np.ndarray
    direction: np.ndarray
    degree_cost_m: float
    settings: Parametric
    max_roof_height_m: float


@dataclass(frozen=True)
class Roofs:
    """k roofs over the polygon of a problem, and how its m points relate to them.

    angle_deg: (k, n). eave_z_m, loss_m: (k,). edge: int (k, m), the edge of the face over each point, -1 where the face
    is level. rise_m: (k, m), the height of the roof above the eave, NaN outside. residual_m: (k, m), at right angles to
    the face.
    """

    angle_deg: np.ndarray
    eave_z_m: np.ndarray
    loss_m: np.ndarray
    edge: np.ndarray
    rise_m: np.ndarray
    residual_m: np.ndarray

    def of(self, chosen: np.ndarray | slice) -> Roofs:
        """The chosen roofs, by mask, indices or slice."""
        return Roofs(*(getattr(self, each.name)[chosen] for each in fields(self)))

    def best(self) -> Roofs:
        """The roof with the least loss."""
        number = int(np.argmin(self.loss_m))
        return self.of(slice(number, number + 1))

    def where(self, places: np.ndarray, others: Roofs) -> Roofs:
        """These roofs with the roofs ``others`` at ``places``, a mask or indices."""
        result = [getattr(self, each.name).copy() for each in fields(self)]
        for array, each in zip(result, fields(self), strict=True):
            array[places] = getattr(others, each.name)
        return Roofs(*result)


def evaluate(problem: Problem, angle_deg: np.ndarray, eave_z_m: np.ndarray | None = None) -> Roofs:
    """The roofs of angles (k, n) and eaves (k,). By default, half of the points are above a roof and half below.

    The loss is the mean distance of the points from the roof, each at most ``cap_m``, plus the cost of unusual slopes.
    It is infinite where the kernel refuses the roof.
    """
    (k, n), m, settings = angle_deg.shape, len(problem.point_m), problem.settings
    one = problem.polygon
    polygons = Polygons(
        np.tile(one.xy_m, (k, 1)),
        np.append((n * np.arange(k)[:, None] + one.ring_offset[:-1]).ravel(), k * n),
        np.arange(k + 1) * (len(one.ring_offset) - 1),
    )
    over = roof_points(
        polygons,
        angle_deg.ravel(),
        0.0,
        np.tile(problem.point_m[:, :2], (k, 1)),
        np.repeat(np.arange(k), m),
        max_roof_height_m=problem.max_roof_height_m,
    )
    rise_m, edge = over.z_m.reshape(k, m), over.edge.reshape(k, m)
    above_m = problem.point_m[:, 2] - rise_m
    if eave_z_m is None:
        eave_z_m = np.nan_to_num(
            [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else 0.0 for row in above_m]
        )
    residual_m = (eave_z_m[:, None] - above_m) * _cosine(angle_deg, edge)
    loss_m = np.fmin(np.abs(residual_m), settings.cap_m).mean(axis=1)
    off_deg = np.minimum(np.abs(angle_deg - USUAL_SLOPE_DEG), settings.max_off_deg)
    is_slope = (angle_deg > 0.0) & (angle_deg < 90.0)
    loss_m = loss_m + np.where(is_slope, problem.degree_cost_m * off_deg, 0.0).sum(axis=1)
    loss_m = np.where(over.status == Status.OK, loss_m, np.inf)
    return Roofs(angle_deg, eave_z_m, loss_m, edge, rise_m, residual_m)


def _cosine(angle_deg: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """(k, m): the cosine of the slope of the face over each point."""
    slope_deg = np.take_along_axis(angle_deg, np.maximum(edge, 0), axis=1)
    return np.where(edge >= 0, np.cos(np.radians(slope_deg)), 1.0)


def improved(problem: Problem, roofs: Roofs, num_rounds: int, only_eaves: bool = False) -> Roofs:
    """The roofs after up to ``num_rounds`` rounds of least squares, none of them worse. only_eaves: slopes stay."""
    settings = problem.settings
    active = np.isfinite(roofs.loss_m)
    for _ in range(num_rounds):
        if not active.any():
            break
        before = roofs.of(active)
        angle_deg, eave_z_m = _least_squares(problem, before, only_eaves)
        done, pending = before, np.ones(len(before.loss_m), bool)
        for step in settings.steps:
            trial = evaluate(
                problem,
                before.angle_deg[pending] + step * (angle_deg - before.angle_deg)[pending],
                before.eave_z_m[pending] + step * (eave_z_m - before.eave_z_m)[pending],
            )
            is_better = trial.loss_m < before.loss_m[pending] - settings.min_step_gain_m
            place = np.flatnonzero(pending)[is_better]
            done = done.where(place, trial.of(is_better))
            pending[place] = False
            if not pending.any():
                break
        roofs = roofs.where(active, done)
        active[active] = before.loss_m - done.loss_m >= settings.min_round_gain_m
    return roofs


def _least_squares(problem: Problem, roofs: Roofs, only_eaves: bool) -> tuple[np.ndarray, np.ndarray]:
    """Angles (k, n) and eaves (k,) that fit the points best if each point keeps its face. Points are weighted by the
    inverse of their residuals."""
    settings = problem.settings
    angle_deg, edge = roofs.angle_deg, roofs.edge
    k, m = edge.shape
    is_slope = (angle_deg > 0.0) & (angle_deg < 90.0)
    tangent = np.where(is_slope, tangents(angle_deg), 0.0)
    of_face = np.take_along_axis(tangent, np.maximum(edge, 0), axis=1)
    distance_m = np.where(edge >= 0, roofs.rise_m, 0.0) / np.where(edge >= 0, of_face, 1.0)
    # points outside have a residual of NaN
    size_m = np.abs(roofs.residual_m)
    weight = _cosine(angle_deg, edge) ** 2 / np.maximum(size_m, settings.noise_m)
    weight = np.where(size_m <= settings.reach_m, weight, 0.0)
    # one unknown is the eave, the others are the tangents of the directions
    num_slopes = 0 if only_eaves else int(problem.direction.max()) + 1
    in_direction = problem.direction == np.arange(num_slopes)[:, None]
    matrix = np.ones((k, m, 1 + num_slopes))
    of_point = in_direction[:, np.maximum(edge, 0)].transpose(1, 2, 0) & (edge >= 0)[:, :, None]
    matrix[:, :, 1:] = of_point * distance_m[:, :, None]
    fixed_m = roofs.rise_m if only_eaves else np.where(edge >= 0, 0.0, roofs.rise_m)
    right_m = problem.point_m[:, 2] - np.nan_to_num(fixed_m)
    transposed = (matrix * weight[:, :, None]).transpose(0, 2, 1)
    square, right = transposed @ matrix, (transposed @ right_m[:, :, None])[:, :, 0]
    diagonal = np.arange(1 + num_slopes)
    # a small weight of the present values keeps a step small where the points determine nothing
    count = is_slope @ in_direction.T
    mean = (tangent @ in_direction.T) / np.maximum(count, 1)
    keep = np.column_stack([np.full(k, settings.keep_eave), np.full((k, num_slopes), settings.keep_slope)])
    square[:, diagonal, diagonal] += keep
    right += keep * np.column_stack([roofs.eave_z_m, mean])
    per_tangent = 1.0 / np.radians(1.0 + tangent**2)
    off_deg = np.maximum(np.abs(angle_deg - USUAL_SLOPE_DEG), settings.least_deg)
    slope_weight = np.where(is_slope, m * problem.degree_cost_m * per_tangent**2 / off_deg, 0.0)
    square[:, diagonal[1:], diagonal[1:]] += slope_weight @ in_direction.T
    right[:, 1:] += (slope_weight * tangents(np.array(USUAL_SLOPE_DEG))) @ in_direction.T
    solution = np.linalg.solve(square, right[:, :, None])[:, :, 0]
    if only_eaves:
        return angle_deg, solution[:, 0]
    slope_deg = np.clip(slope_angles(solution[:, 1:]), *settings.slopes_deg)
    return np.where(is_slope, slope_deg[:, problem.direction], angle_deg), solution[:, 0]
