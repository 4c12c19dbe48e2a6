"""What the points say for a fitted roof: how far they are off, and of every edge what the next best answer costs.

That is the least by which the sum of the residuals grows if the class of the edge, or its slope by ten degrees, is
another and all else stays. What a network says of the classes counts as so much of that sum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2wss.fit.envelope import inward_distances
from p2wss.fit.one_height import Fitter, OneHeight, flat_rings
from p2wss.fit.points import every_kth
from p2wss.fit.solve import IMPOSSIBLE, evaluate_at
from p2wss.fit.starts import edge_groups
from p2wss.fit.work import NO_PRIOR, Problem
from p2wss.skeleton.compiled import ZERO, entry, inner
from p2wss.skeleton.footprint import load_footprint
from p2wss.skeleton.status import Status

# of the sum of residuals, for a class that a network takes for e times more probable
_CLASS_WORTH_M = 0.1
_LEAST_PROBABILITY = 1e-3
# points and edges that are looked at; of more every k-th
_NUM_POINTS, _NUM_EDGES = 64, 24
_STEP_DEG, _LOWEST_DEG, _STEEPEST_DEG, _USUAL_DEG = 10.0, 5.0, 85.0, 38.0
_DEGREE = np.pi / 180.0
_OK = int(Status.OK)


@dataclass(frozen=True)
class Evidence:
    """What points tell of a roof.

    num_points: on it, all of them. residual_m: their mean distance, counted up to 1 m. margin_m: (k,) of the edges
    that were looked at, what the next best answer adds to the sum of the distances. level: no edge has a slope or
    a gable.
    """

    num_points: int
    residual_m: float
    margin_m: np.ndarray
    level: bool


def evidence(
    fitter: Fitter, one: OneHeight, point_m: np.ndarray, class_probability: np.ndarray | None = None
) -> Evidence:
    """What points (m, 3), any number of them, tell of a roof; class_probability: what a
    network said of its edges, (n, 3): 0 degrees, 90 degrees and a slope."""
    xy_m, ring_offset = flat_rings(one.rings)
    x, y, z = np.ascontiguousarray(point_m[every_kth(len(point_m), _NUM_POINTS)].T, np.float64)
    held_m = np.zeros((len(xy_m), 3))
    if class_probability is not None:
        held_m = _CLASS_WORTH_M * np.log(np.maximum(class_probability, _LEAST_PROBABILITY))
    angle_deg, limits = np.array(one.angle_deg, np.float64), fitter.limits
    residual_m, margin_m = _evidence(
        xy_m, ring_offset, x, y, z, angle_deg, float(one.eave_z_m), float(one.top_m), len(point_m), held_m,
        fitter.work(len(xy_m), len(x)), float(limits.cap_m), float(limits.max_roof_height_m),
    )  # fmt: skip
    return Evidence(len(point_m), residual_m, margin_m, not angle_deg.any())


@inner
def _slope_margin(problem, work, angle_deg, eave, e):
    """What the sum of the residuals grows by at least if the slope of edge e is ten degrees off and every point keeps
    its face; infinite for an edge that is no slope. Faces: of the last evaluation."""
    best = np.inf
    own = angle_deg[e]
    if own == 0.0 or own == 90.0:
        return best
    tangent = np.tan(own * _DEGREE)
    for sign in (-1.0, 1.0):
        other = np.tan(min(max(own + sign * _STEP_DEG, _LOWEST_DEG), _STEEPEST_DEG) * _DEGREE)
        more = 0.0
        for k in range(len(problem.z)):
            if work.face[k] == e:
                off = eave + tangent * work.distance[k] - problem.z[k]
                turned = eave + other * work.distance[k] - problem.z[k]
                more += min(abs(turned) / np.sqrt(1.0 + other * other), problem.cap_m)
                more -= min(abs(off) / np.sqrt(1.0 + tangent * tangent), problem.cap_m)
        best = min(best, more)
    return best


@entry
def _evidence(
    xy_m, ring_offset, x, y, z, angle_deg, eave, top, num_points, held_m, work, cap_m, max_roof_height_m
):
    """(mean residual, margins of the edges) of a roof on a sample x, y, z of its ``num_points``.

    held_m: (n, 3), what a network holds for each class of the edges."""
    n, m = len(xy_m), len(z)
    direction, _, _, _ = edge_groups(xy_m, ring_offset)
    own_x, own_y = x - xy_m[0, 0], y - xy_m[0, 1]
    num_directions = 0
    for e in range(n):
        num_directions = max(num_directions, direction[e] + 1)
    problem = Problem(
        n, len(ring_offset) - 1, own_x, own_y, z - 0.0, direction, num_directions, cap_m,
        max_roof_height_m, NO_PRIOR, inward_distances(xy_m, ring_offset, own_x, own_y),
    )  # fmt: skip
    step = (n + _NUM_EDGES - 1) // _NUM_EDGES
    margin = np.zeros((n + step - 1) // step)
    status, _ = load_footprint(xy_m, ring_offset, ZERO, len(ring_offset) - 1, work.skeleton.edge)
    if status != _OK or m == 0:
        return cap_m, margin
    loss = evaluate_at(work.code, problem, work, angle_deg, eave, top)
    if loss >= IMPOSSIBLE:
        return cap_m, margin
    level = True
    for e in range(n):
        level = level and angle_deg[e] == 0.0
    for k in range(len(margin)):
        margin[k] = num_points / m * _slope_margin(problem, work, angle_deg, eave, k * step)
    trial = angle_deg.copy()
    for k in range(len(margin)):
        e = k * step
        kind = 0 if angle_deg[e] == 0.0 else 1 if angle_deg[e] == 90.0 else 2
        # a level edge is hardly ever the next best, and the wall below a level roof is the same with 90 degrees
        for other in (1, 2):
            if other == kind or (level and other == 1):
                continue
            trial[e] = 90.0 if other == 1 else _USUAL_DEG
            if other == 2:
                for j in range(n):
                    if direction[j] == direction[e] and 0.0 < angle_deg[j] < 90.0:
                        trial[e] = angle_deg[j]
            worse = evaluate_at(work.code, problem, work, trial, eave, top)
            if worse < IMPOSSIBLE:
                more = (worse - loss) * num_points + held_m[e, kind] - held_m[e, other]
                margin[k] = min(margin[k], more)
        trial[e] = angle_deg[e]
        margin[k] = min(margin[k], num_points * cap_m)
    return loss, margin
