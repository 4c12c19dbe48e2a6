"""Fits the paper's building to points: one eave height and an angle per edge."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from p2wss.fit.directions import edge_ends, turn_between
from p2wss.fit.points import even_order, every_kth
from p2wss.fit.roof.solve import Problem, Roofs, evaluate, improved
from p2wss.fit.settings import PARAMETRIC, Parametric
from p2wss.skeleton import Polygons
from p2wss.skeleton.angles import bearings, tangents

# fewer points show no roof
MIN_NUM_POINTS = 3


@dataclass(frozen=True)
class FittedRoof:
    """A roof of the kernel over a polygon.

    rings: each (n, 2), exterior first. angle_deg: one per edge, rings in order: 0, 90 or 5 to 75. eave_z_m: height of
    the eaves. loss_m: mean residual of the points, with what slopes cost.
    """

    rings: Sequence[np.ndarray]
    angle_deg: np.ndarray
    eave_z_m: float
    loss_m: float


def fit_roof(
    rings: Sequence[np.ndarray],
    point_m: np.ndarray,
    settings: Parametric = PARAMETRIC,
    max_roof_height_m: float = np.inf,
) -> FittedRoof | None:
    """The best roof over a polygon for the points (m, 3) inside it, with whole degrees where that costs little. There
    is at least one point, and points are in the frame of the rings. None if the kernel refuses the polygon. The result
    does not depend on the order of the points.

    max_roof_height_m: above the eave.

    The loss is never above the loss of a flat roof.
    """
    ordered_m = point_m[even_order(point_m)]
    polygon = Polygons.from_rings([list(rings)])
    direction, axis = edge_groups(rings)
    degree_cost_m = settings.degree_cost_m / len(point_m)
    whole = Problem(polygon, ordered_m, direction, degree_cost_m, settings, max_roof_height_m)
    sample, last = (
        replace(whole, point_m=ordered_m[every_kth(len(ordered_m), count)])
        for count in (settings.num_search_points, settings.num_points)
    )
    starts = improved(sample, evaluate(sample, _starts(axis, settings)), settings.num_start_rounds)
    if not np.isfinite(starts.loss_m).any():
        return None
    found = _descended(sample, starts.best())
    roof = _tidied(
        last, improved(last, evaluate(last, found.angle_deg, found.eave_z_m), settings.num_last_rounds)
    )
    at_end = evaluate(whole, roof.angle_deg, roof.eave_z_m)
    return FittedRoof(rings, at_end.angle_deg[0], float(at_end.eave_z_m[0]), float(at_end.loss_m[0]))


def edge_groups(rings: Sequence[np.ndarray], same_deg: float = 12.0) -> tuple[np.ndarray, np.ndarray]:
    """(direction (n,), axis (n,)) of the edges. Edges that face the same way have the same direction, parallel edges
    the same axis. Number 0 has the greatest total length."""
    edge = np.diff(edge_ends(rings), axis=1)[:, 0]
    bearing_deg = np.degrees(bearings(edge))
    # lengths are compared in whole millimetres, so that rounding errors decide nothing
    length_mm = np.rint(1000.0 * np.hypot(*edge.T))
    groups = []
    for period_deg in (360.0, 180.0):
        group = np.full(len(edge), -1)
        for first in np.argsort(-length_mm, kind="stable"):
            if group[first] < 0:
                is_same = np.abs(turn_between(bearing_deg, bearing_deg[first], period_deg)) < same_deg
                group[is_same & (group < 0)] = group.max() + 1
        rank = np.argsort(np.argsort(-np.bincount(group, length_mm), kind="stable"))
        groups.append(rank[group])
    return groups[0], groups[1]


def _starts(axis: np.ndarray, settings: Parametric) -> np.ndarray:
    """Angles (k, n) of the roofs that a search starts from: a flat one, a hip roof, and gable roofs along the two main
    axes."""
    steep = np.full(len(axis), settings.start_deg)
    gables = [np.where(axis == number, steep, 90.0) for number in range(min(axis.max() + 1, 2))]
    return np.array([np.zeros(len(axis)), steep, *gables])


def _descended(problem: Problem, roof: Roofs) -> Roofs:
    """The roof after changes of single edges and of whole directions. The best change is made, as long as one lowers
    the loss enough."""
    settings = problem.settings
    num_edges = len(problem.direction)
    num_directions = int(problem.direction.max()) + 1
    units = problem.direction == np.arange(num_directions)[:, None]
    if num_edges <= settings.many_edges:
        units = np.vstack([np.eye(num_edges, dtype=bool), units])
    elif num_edges > settings.too_many_edges:
        return roof
    tolerance_m = _class_gain_m(problem)
    while True:
        changed = _changed(roof.angle_deg[0], units, problem.direction, settings)
        trial = improved(problem, evaluate(problem, changed), settings.num_trial_rounds)
        best = trial.best()
        if best.loss_m[0] >= roof.loss_m[0] - tolerance_m:
            return roof
        roof = improved(problem, best, settings.num_last_rounds)


def _class_gain_m(problem: Problem) -> float:
    """The least gain for which an edge changes its class, metres; more with few points."""
    settings = problem.settings
    return settings.class_gain_m * max(1.0, settings.full_num_points / len(problem.point_m))


def _changed(
    angle_deg: np.ndarray, units: np.ndarray, direction: np.ndarray, settings: Parametric
) -> np.ndarray:
    """Angles (k, n) to try: every other class and slope for each set of edges. Edges that face the same way keep a
    common slope."""
    rows = []
    is_slope = (angle_deg > 0.0) & (angle_deg < 90.0)
    for unit in units:
        for angle in settings.tried_deg:
            row = np.where(unit, angle, angle_deg)
            if 0.0 < angle < 90.0:
                row = np.where(is_slope & np.isin(direction, direction[unit]), angle, row)
            rows.append(row)
    different = np.unique(rows, axis=0)
    return different[(np.abs(different - angle_deg) > settings.same_slope_deg).any(axis=1)]


def _tidied(problem: Problem, roof: Roofs) -> Roofs:
    """The roof with whole degrees where that costs little; a flat roof if that is about as good."""
    settings, n = problem.settings, len(problem.direction)
    tolerance_m = _class_gain_m(problem)
    flat = improved(problem, evaluate(problem, np.zeros((1, n))), settings.num_last_rounds)
    if flat.loss_m[0] <= roof.loss_m[0] + tolerance_m:
        return flat
    if n <= settings.many_edges:
        apart = replace(problem, direction=np.arange(n))
        separate = _descended(apart, improved(apart, roof, settings.num_last_rounds))
        if separate.loss_m[0] < roof.loss_m[0] - max(tolerance_m, settings.separate_slope_gain_m):
            problem, roof = apart, separate
    for number in range(int(problem.direction.max()) + 1):
        # At the end of a gable roof hardly any point distinguishes a steep face from a vertical one, and returns from
        # a wall that stands back below its eave look like a steep face.
        angle_deg = roof.angle_deg[0]
        is_steep = (
            (problem.direction == number) & (angle_deg > settings.nearly_gable_deg) & (angle_deg < 90.0)
        )
        if is_steep.any():
            on = np.isin(roof.edge[0], np.flatnonzero(is_steep))
            depth_m = np.max(roof.rise_m[0, on], initial=0.0) / tangents(angle_deg[is_steep].max())
            gables = evaluate(problem, np.where(is_steep, 90.0, roof.angle_deg), roof.eave_z_m)
            gables = improved(problem, gables, settings.num_trial_rounds)
            most_m = settings.wall_hits_m if depth_m < settings.min_slope_width_m else settings.rounding_m
            if gables.loss_m[0] <= roof.loss_m[0] + max(tolerance_m, most_m):
                roof = gables
    whole = evaluate(problem, np.rint(roof.angle_deg), roof.eave_z_m)
    whole = improved(problem, whole, settings.num_trial_rounds, only_eaves=True)
    return whole if whole.loss_m[0] <= roof.loss_m[0] + settings.rounding_m else roof
