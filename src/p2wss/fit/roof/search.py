"""The class of every edge, flat, gable or slope: coordinate descent from several starts."""

from __future__ import annotations

import numpy as np

from p2wss.fit.roof.solve import IMPOSSIBLE, evaluate_at, improve_at
from p2wss.fit.roof.work import FitWork, Problem, fit_work_at
from p2wss.fit.settings import SEARCHING, USUAL_SLOPE_DEG, Effort
from p2wss.skeleton.compiled import ZERO, allocating, by_address, embedded, inner
from p2wss.skeleton.ordering import stable_order

# degrees that are tried for an edge; the first two are no slopes
_ALTERNATIVES_DEG = (0.0, 90.0, 18.0, USUAL_SLOPE_DEG, 57.0)
_NUM_CLASSES = 2
# a slope that differs by less is the same
_SAME_SLOPE_DEG = 9.0


@inner
def _is_slope(angle):
    return 0.0 < angle < 90.0


@embedded
def _propose(problem: Problem, angle_deg: np.ndarray, unit: int, alternative: int, proposed: np.ndarray):
    """Writes to ``proposed`` the angles with an alternative for one edge (unit below num_edges) or for all edges
    of one direction. Returns False if that changes nothing."""
    n = problem.num_edges
    angle = _ALTERNATIVES_DEG[alternative]
    for e in range(n):
        proposed[e] = angle_deg[e]
    if unit < n:
        if abs(angle_deg[unit] - angle) < (1e-9 if alternative < _NUM_CLASSES else _SAME_SLOPE_DEG):
            return False
        if alternative >= _NUM_CLASSES:
            for e in range(n):
                if problem.direction[e] == problem.direction[unit] and _is_slope(proposed[e]):
                    proposed[e] = angle
        proposed[unit] = angle
        return True
    count, changed = 0, False
    for e in range(n):
        if problem.direction[e] == unit - n:
            changed = changed or abs(proposed[e] - angle) >= 1e-9
            proposed[e] = angle
            count += 1
    return count > 1 and changed


@embedded
def is_tried(problem: Problem, work: FitWork, edge: int, other: float, min_excess: float, num_tried: int):
    """Whether the class of an edge is tried by itself: a better roof around it might gain ``min_excess``, and no more
    than ``SEARCHING.many_edges``, or with more edges in proportion fewer, have been tried. other: of
    :func:`set_excess`."""
    n, many = problem.num_edges, SEARCHING.many_edges
    if n > many and num_tried * n >= many * many:
        return False
    before, after = work.skeleton.edge[edge].prev, work.skeleton.edge[edge].next
    return work.excess[edge] + work.excess[before] + work.excess[after] + other >= min_excess


@embedded
def set_excess(problem: Problem, work: FitWork):
    """The most that a better roof might take off the loss. Writes it to ``work.excess`` for the face of each edge;
    returns (the sum over all points, the sum over the points on faces of no edge). Faces and residuals are those of
    the last evaluation."""
    for e in range(problem.num_edges):
        work.excess[e] = 0.0
    total, other = 0.0, 0.0
    m = len(problem.z)
    for k in range(m):
        r = abs(work.residual[k])
        more = (min(r, problem.cap_m) if r == r else problem.cap_m) - SEARCHING.noise_m
        if more > 0.0:
            total += more / m
            if work.face[k] >= 0:
                work.excess[work.face[k]] += more / m
            else:
                other += more / m
    return total, other


@embedded
def _level_loss(problem: Problem, work: FitWork):
    """The least loss of a level roof, without the prior. Between heights at which the residual of a point is 0 or the
    cap the loss is linear, and only at those where it is 0 may it be least."""
    m, z, cap_m = len(problem.z), problem.z, problem.cap_m
    total = work.sort_buffer[:m]
    for i in range(m):
        total[i] = 0.0
    for k in range(m):
        for i in range(m):
            residual = abs(z[i] - z[k])
            total[i] += residual if residual < cap_m else cap_m
    least = np.inf
    for i in range(m):
        least = min(least, total[i])
    return least / m


@inner
def _is_level(problem: Problem, angle_deg: np.ndarray):
    """Whether a roof is level whatever its slopes: see :mod:`p2wss.fit.roof.envelope`. False for polygons that are not
    convex."""
    is_flat, has_slope = False, False
    for e in range(problem.num_edges):
        is_flat = is_flat or angle_deg[e] == 0.0
        has_slope = has_slope or angle_deg[e] != 90.0
    return len(problem.inward_m) > 0 and (is_flat or not has_slope)


@inner
def _descend(
    problem: Problem,
    work: FitWork,
    angle_deg: np.ndarray,
    eave: float,
    loss: float,
    max_rounds: int,
    tolerance: float,
):
    """Changes edges and directions while that lowers the loss by more than ``tolerance``; ``angle_deg`` is
    changed in place. Returns (loss, eave)."""
    n = problem.num_edges
    proposed, best = work.trial[1], work.trial[2]
    # What comes after the last change has been tried since. (With many edges a try depends on those before it, but
    # then there is one round only.)
    last_change = n + problem.num_directions
    # rounding aside, no level roof is better than this
    least_level_loss = _level_loss(problem, work) - 1e-9
    for _ in range(max_rounds):
        changed = False
        evaluate_at(work.code, problem, work.at, angle_deg, eave)
        total, other = set_excess(problem, work)
        num_tried = ZERO
        for unit in range(n + problem.num_directions):
            if total < tolerance or (unit > last_change and not changed):
                break
            if unit < n:
                if not is_tried(problem, work, unit, other, tolerance, num_tried):
                    continue
                num_tried += 1
            best_loss, best_eave, is_better = loss - tolerance, eave, False
            for alternative in range(len(_ALTERNATIVES_DEG)):
                if not _propose(problem, angle_deg, unit, alternative, proposed):
                    continue
                if least_level_loss >= best_loss and _is_level(problem, proposed):
                    continue
                new_loss, new_eave = improve_at(
                    work.code, problem, work.at, proposed, eave, SEARCHING.num_candidate, True,
                    loss + SEARCHING.give_up_m,
                )  # fmt: skip
                if best_loss <= new_loss < loss + SEARCHING.second_look_m:
                    new_loss, new_eave = improve_at(
                        work.code,
                        problem,
                        work.at,
                        proposed,
                        np.nan,
                        SEARCHING.num_candidate,
                        True,
                        IMPOSSIBLE,
                    )
                if new_loss < best_loss:
                    best_loss, best_eave, is_better = new_loss, new_eave, True
                    for e in range(n):
                        best[e] = proposed[e]
            if is_better:
                loss, eave, changed, last_change = best_loss, best_eave, True, unit
                for e in range(n):
                    angle_deg[e] = best[e]
                evaluate_at(work.code, problem, work.at, angle_deg, eave)
                total, other = set_excess(problem, work)
        if not changed:
            break
    return loss, eave


@allocating
def search(
    problem: Problem, work_at: int, effort: Effort, start_deg: np.ndarray, max_rounds: int, tolerance: float
):
    """The best roof from several starts: (loss, eave, row), with its angles in that row of ``start_deg``.

    All starts get a first round, the best ``effort.num_followed`` of them are improved, and the classes are
    searched from the best ``effort.num_descents`` that differ. The footprint must have been loaded into
    ``work.skeleton.edge``.

    start_deg: (num_starts, num_edges), overwritten. tolerance: metres of loss that a change of class has to gain.
    """
    work = fit_work_at(work_at)
    k = len(start_deg)
    losses, eaves = np.empty(k), np.empty(k)
    for i in range(k):
        losses[i], eaves[i] = improve_at(
            work.code, problem, work.at, start_deg[i], np.nan, SEARCHING.num_first, True, IMPOSSIBLE
        )
    order = stable_order(losses)
    follow_below = losses[order[0]] + SEARCHING.follow_m
    num_followed = effort.num_followed if problem.num_edges <= SEARCHING.too_many_edges else 1
    for i in order[:num_followed]:
        if losses[i] < min(follow_below, IMPOSSIBLE):
            losses[i], eaves[i] = improve_at(
                work.code, problem, work.at, start_deg[i], eaves[i], SEARCHING.num_next, True, IMPOSSIBLE
            )
    order = stable_order(losses)
    best = order[0]
    best_loss, best_eave = losses[best], eaves[best]
    num_searched, last_loss = 0, -1.0
    for i in order:
        if num_searched >= effort.num_descents or losses[i] >= IMPOSSIBLE:
            break
        if abs(losses[i] - last_loss) < 1e-3:
            continue
        last_loss = losses[i]
        num_searched += 1
        loss, eave = _descend(problem, work, start_deg[i], eaves[i], losses[i], max_rounds, tolerance)
        if num_searched == 1 or loss < best_loss - tolerance:
            best, best_loss, best_eave = i, loss, eave
    if num_searched > 0:
        best_loss, best_eave = improve_at(
            work.code, problem, work.at, start_deg[best], best_eave, SEARCHING.num_last, True, IMPOSSIBLE
        )
    return best_loss, best_eave, best


search_at = by_address(search)
