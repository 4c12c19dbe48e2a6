"""How well the points support a fitted roof: their mean residual, and for each edge the cost of the next best answer.

That cost, the margin, is the smallest growth of the sum of the residuals if the class of the edge changes, or its
slope by ten degrees, and all else stays. The probabilities of a network enter that sum as a distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2wss.fit.points import every_kth
from p2wss.fit.roof.fitter import FittedRoof, Fitter, as_columns, flat_rings
from p2wss.fit.roof.rounds import make_problem
from p2wss.fit.roof.solve import IMPOSSIBLE, evaluate_at, load_polygon
from p2wss.fit.roof.starts import edge_groups
from p2wss.fit.roof.work import Context, FitWork, Polygon, Problem, fit_work_at
from p2wss.fit.settings import USUAL_SLOPE_DEG
from p2wss.skeleton.compiled import entry, inner

# added to the sum of the residuals for a class that is e times less probable by the network
_CLASS_COST_M = 0.1
_MIN_PROBABILITY = 1e-3
# at most this many points and edges are evaluated, evenly spaced
_NUM_POINTS, _NUM_EDGES = 64, 24
_STEP_DEG, _LOWEST_DEG, _STEEPEST_DEG = 10.0, 5.0, 85.0
_DEGREE = np.pi / 180.0


@dataclass(frozen=True)
class Evidence:
    """How well the points support a roof.

    num_points: all points on the roof. residual_m: their mean distance to it, each counted up to 1 m. margin_m: (k,),
    for each edge that was evaluated what the next best answer adds to the sum of the distances. is_level: every edge
    has 0 degrees.
    """

    num_points: int
    residual_m: float
    margin_m: np.ndarray
    is_level: bool


def roof_evidence(
    fitter: Fitter, roof: FittedRoof, point_m: np.ndarray, class_probability: np.ndarray | None = None
) -> Evidence:
    """The evidence of points (m, 3) for a roof. class_probability: of a network, (n, 3), that an edge has 0 degrees,
    90 degrees or a slope."""
    polygon = flat_rings(roof.rings)
    sample = point_m[every_kth(len(point_m), _NUM_POINTS)]
    class_bonus_m = np.zeros((len(polygon.xy_m), 3))
    if class_probability is not None:
        class_bonus_m = _CLASS_COST_M * np.log(np.maximum(class_probability, _MIN_PROBABILITY))
    residual_m, margin_m = _residual_and_margins(
        polygon,
        as_columns(sample),
        np.array(roof.angle_deg, np.float64),
        float(roof.eave_z_m),
        len(point_m),
        class_bonus_m,
        fitter.context(polygon, len(sample)),
    )
    return Evidence(len(point_m), residual_m, margin_m, not roof.angle_deg.any())


@inner
def _slope_margin(problem: Problem, work: FitWork, angle_deg: np.ndarray, eave: float, e: int):
    """The smallest growth of the sum of the residuals if the slope of edge e changes by ten degrees and every point
    keeps its face, that of the last evaluation; infinite for an edge that is not a slope."""
    best = np.inf
    angle = angle_deg[e]
    if angle == 0.0 or angle == 90.0:
        return best
    tangent = np.tan(angle * _DEGREE)
    for sign in (-1.0, 1.0):
        other = np.tan(min(max(angle + sign * _STEP_DEG, _LOWEST_DEG), _STEEPEST_DEG) * _DEGREE)
        growth = 0.0
        for k in range(len(problem.z)):
            if work.face[k] == e:
                residual = eave + tangent * work.distance[k] - problem.z[k]
                new_residual = eave + other * work.distance[k] - problem.z[k]
                growth += min(abs(new_residual) / np.sqrt(1.0 + other * other), problem.cap_m)
                growth -= min(abs(residual) / np.sqrt(1.0 + tangent * tangent), problem.cap_m)
        best = min(best, growth)
    return best


@entry
def _residual_and_margins(
    polygon: Polygon,
    points: np.ndarray,
    angle_deg: np.ndarray,
    eave: float,
    num_points: int,
    class_bonus_m: np.ndarray,
    context: Context,
):
    """(mean residual, margins of the edges) of a roof on a sample (3, m) of its ``num_points``.

    class_bonus_m: (n, 3), what the network's probability of each class takes off the sum of the residuals."""
    work, cap_m = fit_work_at(context.work_at), context.settings.limits.cap_m
    n, m = len(polygon.xy_m), points.shape[1]
    direction, _, _, _ = edge_groups(polygon)
    problem = make_problem(polygon, points, m, direction, context)
    step = (n + _NUM_EDGES - 1) // _NUM_EDGES
    margin = np.zeros((n + step - 1) // step)
    if m == 0 or not load_polygon(polygon, work):
        return cap_m, margin
    loss = evaluate_at(work.code, problem, work.at, angle_deg, eave)
    if loss >= IMPOSSIBLE:
        return cap_m, margin
    is_level = True
    for e in range(n):
        is_level = is_level and angle_deg[e] == 0.0
    for k in range(len(margin)):
        margin[k] = num_points / m * _slope_margin(problem, work, angle_deg, eave, k * step)
    trial = angle_deg.copy()
    for k in range(len(margin)):
        e = k * step
        kind = 0 if angle_deg[e] == 0.0 else 1 if angle_deg[e] == 90.0 else 2
        # 0 degrees is hardly ever the next best answer, and 90 degrees leaves a level roof as it is
        for other in (1, 2):
            if other == kind or (is_level and other == 1):
                continue
            trial[e] = 90.0 if other == 1 else USUAL_SLOPE_DEG
            if other == 2:
                for j in range(n):
                    if direction[j] == direction[e] and 0.0 < angle_deg[j] < 90.0:
                        trial[e] = angle_deg[j]
            new_loss = evaluate_at(work.code, problem, work.at, trial, eave)
            if new_loss < IMPOSSIBLE:
                growth = (new_loss - loss) * num_points + class_bonus_m[e, kind] - class_bonus_m[e, other]
                margin[k] = min(margin[k], growth)
        trial[e] = angle_deg[e]
        margin[k] = min(margin[k], num_points * cap_m)
    return loss, margin
