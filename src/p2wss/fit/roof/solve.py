"""Height and slopes of one roof from points, by iteratively reweighted least squares.

While the face over every point stays the same, z = eave + tan(angle) * distance is linear in the unknowns. So
each round asks the kernel for the faces, solves for the unknowns, and keeps the step only if the true loss falls.
"""

from __future__ import annotations

import numpy as np

from p2wss.fit.roof.envelope import lower_envelope
from p2wss.fit.roof.work import FitWork, Polygon, Problem, fit_work_at
from p2wss.fit.settings import SOLVING
from p2wss.skeleton.compiled import ONE, ZERO, by_address, embedded, inner
from p2wss.skeleton.footprint import load_footprint, set_angles
from p2wss.skeleton.ordering import select
from p2wss.skeleton.queries import OUTSIDE, QueryPoints, assign
from p2wss.skeleton.status import Status

_OK = int(Status.OK)
IMPOSSIBLE = 1e9  # loss of a roof that the kernel refuses
_DEGREE = np.pi / 180.0


@inner
def load_polygon(polygon: Polygon, work: FitWork):
    """Whether the kernel takes the polygon of a new problem, which is loaded for :func:`_evaluate`."""
    work.last_count[0] = -1
    num_rings = len(polygon.ring_offset) - 1
    status, _ = load_footprint(polygon.xy_m, polygon.ring_offset, ZERO, num_rings, work.skeleton.edge)
    return status == _OK


@embedded
def _evaluate(problem: Problem, work: FitWork, angle_deg: np.ndarray, eave_m: float):
    """Loss of a roof: mean over the points of min(|distance to the roof|, cap), metres, distances measured at
    right angles to the face, plus the cost of the prior.

    Leaves face, distance and residual of every point in ``work``; the residual outside the roof is NaN. The polygon has
    been loaded by :func:`load_polygon`; faces and distances stay if only ``eave_m`` has changed since the last
    evaluation.
    """
    work.num_evaluations[0] += 1
    m = len(problem.x)
    is_same = work.last_count[0] == m
    slope_deg, slope_tangent, slope_cosine = 0.0, 0.0, 1.0
    for e in range(problem.num_edges):
        angle = angle_deg[e]
        if angle != work.last_deg[e]:
            is_same = False
            if not 0.0 < angle < 90.0:
                work.tangent[e], work.cosine[e] = 0.0, 1.0
            else:
                if angle != slope_deg:
                    slope_deg, slope_tangent = angle, np.tan(angle * _DEGREE)
                    slope_cosine = 1.0 / np.sqrt(1.0 + slope_tangent * slope_tangent)
                work.tangent[e], work.cosine[e] = slope_tangent, slope_cosine
            work.last_deg[e] = angle
    if is_same:
        return _loss(problem, work, eave_m) + prior_cost_m(problem, angle_deg, eave_m)
    work.last_count[0] = -1
    face, distance, rise, slant = work.face[:m], work.distance[:m], work.rise[:m], work.slant[:m]
    if len(problem.inward_m) > 0:
        if not lower_envelope(problem, work, angle_deg):
            return IMPOSSIBLE
    else:
        if set_angles(work.skeleton.edge, problem.num_edges, angle_deg) != _OK:
            return IMPOSSIBLE
        points = QueryPoints(problem.x, problem.y, face, distance)
        top = problem.max_roof_height_m
        status = assign(problem.num_edges, problem.num_rings, top, work.skeleton, work.query, points)
        if status != _OK:
            return IMPOSSIBLE
        for k in range(m):
            rise[k] = work.tangent[max(face[k], 0)] * distance[k] if face[k] >= 0 else distance[k]
            slant[k] = work.cosine[face[k]] if face[k] >= 0 else np.nan if face[k] == OUTSIDE else 1.0
    work.last_count[0] = m
    return _loss(problem, work, eave_m) + prior_cost_m(problem, angle_deg, eave_m)


@inner
def evaluate(problem: Problem, work_at: int, angle_deg: np.ndarray, eave_m: float):
    """Loss of a roof; see :func:`_evaluate`."""
    return _evaluate(problem, fit_work_at(work_at), angle_deg, eave_m)


evaluate_at = by_address(evaluate)


@embedded
def prior_cost_m(problem: Problem, angle_deg: np.ndarray, eave_m: float):
    """Cost of a roof by the prior, in metres of loss."""
    prior = problem.prior
    cost = 0.0
    if len(prior.slope_deg) > 0:
        for e in range(problem.num_edges):
            angle = angle_deg[e]
            if angle == 0.0:
                cost += prior.class_cost_m[e, 0]
            elif angle == 90.0:
                cost += prior.class_cost_m[e, 1]
            else:
                difference_deg = min(abs(angle - prior.slope_deg[e]), SOLVING.max_difference_deg)
                cost += prior.class_cost_m[e, 2] + prior.degree_cost_m * difference_deg
    if len(prior.eave_z_m) > 0:
        cost += prior.eave_cost * min(abs(eave_m - prior.eave_z_m[0]), SOLVING.max_difference_m)
    return cost


@embedded
def _loss(problem: Problem, work: FitWork, eave_m: float):
    """The loss without the prior, from the roof over every point that is in ``work``."""
    m, cap_m = len(problem.z), problem.cap_m
    rise, slant, residual, cost = work.rise[:m], work.slant[:m], work.residual[:m], work.sort_buffer[:m]
    # without branches, so that several points are evaluated at once
    for k in range(m):
        r = (eave_m + rise[k] - problem.z[k]) * slant[k]
        residual[k] = r
        # that of a point outside is NaN
        cost[k] = abs(r) if abs(r) < cap_m else cap_m
    total = 0.0
    for k in range(m):
        total += cost[k]
    return total / max(m, 1)


@embedded
def _median_eave(problem: Problem, work: FitWork):
    """The eave height for which half of the points lie above the roof."""
    count = ZERO
    for k in range(len(problem.z)):
        f = work.face[k]
        if f != OUTSIDE:
            work.sort_buffer[count] = problem.z[k] - work.rise[k]
            count += 1
    if count > SOLVING.max_counted:
        return select(work.sort_buffer, count, count // 2)
    # of few values the median is the one with so many less than it: counting has no branches that are hard to predict
    for i in range(count):
        value, num_less, num_least = work.sort_buffer[i], ZERO, ZERO
        for k in range(count):
            num_less += int(work.sort_buffer[k] < value)
            num_least += int(work.sort_buffer[k] <= value)
        if num_less <= count // 2 < num_least:
            return value
    return 0.0


@embedded
def _solve_positive(matrix: np.ndarray, right_side: np.ndarray, size: int):
    """Solves a positive definite system by Cholesky factors in place; the solution replaces ``right_side``."""
    for i in range(size):
        for j in range(i + 1):
            s = matrix[i, j]
            for k in range(j):
                s -= matrix[i, k] * matrix[j, k]
            if i == j:
                matrix[i, i] = np.sqrt(max(s, 1e-12))
            else:
                matrix[i, j] = s / matrix[j, j]
    for i in range(size):
        s = right_side[i]
        for k in range(i):
            s -= matrix[i, k] * right_side[k]
        right_side[i] = s / matrix[i, i]
    for i in range(size - 1, -1, -1):
        s = right_side[i]
        for k in range(i + 1, size):
            s -= matrix[k, i] * right_side[k]
        right_side[i] = s / matrix[i, i]


@embedded
def _add_prior(problem: Problem, work: FitWork, angle_deg: np.ndarray, eave_m: float, num_groups: int):
    """Adds the costs of the prior to the equations, reweighted as the residuals are."""
    prior, a, b = problem.prior, work.matrix, work.right_side
    # the loss is a mean, the equations are a sum
    m = len(problem.z)
    if len(prior.eave_z_m) > 0:
        w = m * prior.eave_cost / max(abs(eave_m - prior.eave_z_m[0]), SOLVING.min_difference_m)
        a[0, 0] += w
        b[0] += w * prior.eave_z_m[0]
    if num_groups > 0 and len(prior.slope_deg) > 0:
        for e in range(problem.num_edges):
            if work.tangent[e] > 0.0:
                per_tangent = 1.0 / (_DEGREE * (1.0 + work.tangent[e] ** 2))
                difference_deg = max(abs(angle_deg[e] - prior.slope_deg[e]), SOLVING.min_difference_deg)
                w = m * prior.degree_cost_m * per_tangent * per_tangent / difference_deg
                g = work.group_row[problem.direction[e]]
                a[g, g] += w
                b[g] += w * np.tan(prior.slope_deg[e] * _DEGREE)


@embedded
def _least_squares(
    problem: Problem, work: FitWork, angle_deg: np.ndarray, eave_m: float, reach_m: float, free_angles: bool
):
    """One weighted step from the faces and residuals of up to ``reach_m`` in ``work``: new angles in
    ``work.solution_deg``; returns the eave."""
    n = problem.num_edges
    groups = problem.num_directions if free_angles else 0
    for g in range(groups):
        work.group_tangent[g], work.group_count[g] = 0.0, 0.0
    for e in range(n):
        if groups > 0 and work.tangent[e] > 0.0:
            work.group_tangent[problem.direction[e]] += work.tangent[e]
            work.group_count[problem.direction[e]] += 1.0
    # the eave is the first unknown, then the slopes of the directions that have any
    size = ONE
    for g in range(groups):
        if work.group_count[g] > 0.0:
            work.group_row[g] = size
            size += 1
    a, b = work.matrix, work.right_side
    for i in range(size):
        b[i] = 0.0
        for j in range(size):
            a[i, j] = 0.0
    weight, weighted_z = 0.0, 0.0
    for k in range(len(problem.z)):
        f = work.face[k]
        size_of_residual = abs(work.residual[k])
        if f == OUTSIDE or not size_of_residual <= reach_m:
            continue
        w = 1.0 / max(size_of_residual, SOLVING.noise_m)
        z = problem.z[k]
        if f < 0:
            # the height of a level cap depends on the slopes, but seldom much
            weight += w
            weighted_z += w * (z - work.distance[k])
        else:
            t, d = work.tangent[f], work.distance[k]
            w *= work.cosine[f] * work.cosine[f]
            weight += w
            if groups > 0:
                g = work.group_row[problem.direction[f]]
                a[g, 0] += w * d
                a[g, g] += w * d * d
                weighted_z += w * z
                b[g] += w * d * z
            else:
                weighted_z += w * (z - t * d)
    a[0, 0] = weight + SOLVING.keep_eave
    b[0] = weighted_z + SOLVING.keep_eave * eave_m
    _add_prior(problem, work, angle_deg, eave_m, groups)
    for g in range(groups):
        if work.group_count[g] > 0.0:
            row = work.group_row[g]
            a[row, row] += SOLVING.keep_slope
            b[row] += SOLVING.keep_slope * work.group_tangent[g] / work.group_count[g]
    _solve_positive(a, b, size)
    for g in range(groups):
        if work.group_count[g] > 0.0:
            angle = np.arctan(b[work.group_row[g]]) / _DEGREE
            work.group_deg[g] = min(max(angle, SOLVING.min_angle_deg), SOLVING.max_angle_deg)
    for e in range(n):
        is_free = groups > 0 and work.tangent[e] > 0.0
        work.solution_deg[e] = work.group_deg[problem.direction[e]] if is_free else angle_deg[e]
    return b[0]


@inner
def improve(
    problem: Problem,
    work_at: int,
    angle_deg: np.ndarray,
    eave_m: float,
    num_rounds: int,
    free_angles: bool,
    give_up_at: float,
):
    """Rounds of assigning points to faces and solving; ``angle_deg`` is changed in place. Returns (loss, eave).

    eave_m: where to begin; NaN for the median height of the points. free_angles: solve for the slopes too. give_up_at:
    a loss above this ends the search after a round.
    """
    work = fit_work_at(work_at)
    loss = _evaluate(problem, work, angle_deg, eave_m)
    if loss >= IMPOSSIBLE:
        return loss, eave_m
    from_median = np.isnan(eave_m)
    if from_median:
        eave_m = _median_eave(problem, work)
        loss = _loss(problem, work, eave_m) + prior_cost_m(problem, angle_deg, eave_m)
    n = problem.num_edges
    trial = work.trial[0]
    # if only the eave can change, every point keeps its face
    keeps_faces = True
    for e in range(n):
        keeps_faces = keeps_faces and not (free_angles and 0.0 < angle_deg[e] < 90.0)
    for number in range(num_rounds):
        is_first = from_median and number < SOLVING.num_first_rounds
        reach_m = problem.cap_m * (SOLVING.first_reach if is_first else 1.0)
        new_eave = _least_squares(problem, work, angle_deg, eave_m, reach_m, free_angles)
        step, is_accepted, trial_loss, eave = 1.0, False, loss, eave_m
        for _ in range(SOLVING.num_steps):
            for e in range(n):
                trial[e] = angle_deg[e] + step * (work.solution_deg[e] - angle_deg[e])
            eave = eave_m + step * (new_eave - eave_m)
            if keeps_faces:
                trial_loss = _loss(problem, work, eave) + prior_cost_m(problem, trial, eave)
            else:
                trial_loss = _evaluate(problem, work, trial, eave)
            if trial_loss < loss - SOLVING.min_step_gain_m:
                is_accepted = True
                break
            step *= SOLVING.shorter_step
        if not is_accepted:
            break
        gain = loss - trial_loss
        loss, eave_m = trial_loss, eave
        for e in range(n):
            angle_deg[e] = trial[e]
        if gain < SOLVING.min_round_gain_m or loss > give_up_at:
            break
    return loss, eave_m


improve_at = by_address(improve)
