"""The class of every edge, flat, gable or slope: coordinate descent from several starts."""

from __future__ import annotations

import numpy as np

from p2wss.fit.roof.solve import IMPOSSIBLE, evaluate_at, improve_at
from p2wss.fit.roof.work import fit_work_at
from p2wss.skeleton.compiled import ZERO, allocating, by_address, embedded, inner
from p2wss.skeleton.ordering import stable_order

_ALTERNATIVES_DEG = (0.0, 90.0, 18.0, 38.0, 57.0)
_NUM_CLASSES = 2  # the first alternatives, which are not slopes
_ROUNDS_FIRST, _ROUNDS_NEXT, _ROUNDS_CANDIDATE, _ROUNDS_LAST = 1, 3, 3, 8
# starts that are this much worse than the best after the first round are dropped
_FOLLOW_M = 0.2
# a candidate within this of the present loss is tried again, beginning with the median height
_SECOND_LOOK_M = 0.05
# a candidate that is this much worse than the present roof after a round is dropped
_GIVE_UP_M = 0.12
# With more edges, fewer of them are tried by themselves; directions always are.
MANY_EDGES = 40
# residuals that no better roof would lower
_NOISE_M = 0.04


@inner
def _is_slope(angle):
    return 0.0 < angle < 90.0


@embedded
def _propose(problem, angle_deg, unit, alternative, proposed):
    """Writes to ``proposed`` the angles with an alternative for one edge (unit below num_edges) or for all edges
    of one direction. Returns False if that changes nothing."""
    n = problem.num_edges
    angle = _ALTERNATIVES_DEG[alternative]
    for e in range(n):
        proposed[e] = angle_deg[e]
    if unit < n:
        if abs(angle_deg[unit] - angle) < (1e-9 if alternative < _NUM_CLASSES else 9.0):
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
def is_tried(problem, work, edge, other, min_excess, num_tried):
    """Whether the class of an edge is tried by itself: a better roof around it might gain ``min_excess``, and no more
    than ``MANY_EDGES``, or with more edges in proportion fewer, have been tried. other: of :func:`set_excess`."""
    if problem.num_edges > MANY_EDGES and num_tried * problem.num_edges >= MANY_EDGES * MANY_EDGES:
        return False
    before, after = work.skeleton.edge[edge].prev, work.skeleton.edge[edge].next
    return work.excess[edge] + work.excess[before] + work.excess[after] + other >= min_excess


@embedded
def set_excess(problem, work):
    """The most that a better roof might take off the loss. Writes it to ``work.excess`` for the face of each edge;
    returns (the sum over all points, the sum over the points on faces of no edge). Faces and residuals are those of
    the last evaluation."""
    for e in range(problem.num_edges):
        work.excess[e] = 0.0
    total, other = 0.0, 0.0
    m = len(problem.z)
    for k in range(m):
        r = abs(work.residual[k])
        more = (min(r, problem.cap_m) if r == r else problem.cap_m) - _NOISE_M
        if more > 0.0:
            total += more / m
            if work.face[k] >= 0:
                work.excess[work.face[k]] += more / m
            else:
                other += more / m
    return total, other


@embedded
def _level_loss(problem, work):
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
def _is_level(problem, angle_deg):
    """Whether a roof is level whatever its slopes: see :mod:`p2wss.fit.roof.envelope`. False for polygons that are not
    convex."""
    is_flat, has_slope = False, False
    for e in range(problem.num_edges):
        is_flat = is_flat or angle_deg[e] == 0.0
        has_slope = has_slope or angle_deg[e] != 90.0
    return len(problem.inward_m) > 0 and (is_flat or not has_slope)


@inner
def _descend(problem, work, angle_deg, eave, top, loss, max_rounds, tolerance):
    """Changes edges and directions while that lowers the loss by more than ``tolerance``; ``angle_deg`` is
    changed in place. Returns (loss, eave, top)."""
    n = problem.num_edges
    proposed, best = work.trial[1], work.trial[2]
    # What comes after the last change has been tried since. (With many edges a try depends on those before it, but
    # then there is one round only.)
    last_change = n + problem.num_directions
    # rounding aside, no level roof is better than this
    least_level_loss = _level_loss(problem, work) - 1e-9
    for _ in range(max_rounds):
        changed = False
        evaluate_at(work.code, problem, work.at, angle_deg, eave, top)
        total, other = set_excess(problem, work)
        num_tried = ZERO
        for unit in range(n + problem.num_directions):
            if total < tolerance or (unit > last_change and not changed):
                break
            if unit < n:
                if not is_tried(problem, work, unit, other, tolerance, num_tried):
                    continue
                num_tried += 1
            best_loss, best_eave, best_top = loss - tolerance, eave, top
            is_better = False
            for alternative in range(len(_ALTERNATIVES_DEG)):
                if not _propose(problem, angle_deg, unit, alternative, proposed):
                    continue
                if least_level_loss >= best_loss and _is_level(problem, proposed):
                    continue
                new_loss, new_eave, new_top = improve_at(
                    work.code, problem, work.at, proposed, eave, top, _ROUNDS_CANDIDATE, False, True,
                    loss + _GIVE_UP_M,
                )  # fmt: skip
                if best_loss <= new_loss < loss + _SECOND_LOOK_M:
                    new_loss, new_eave, new_top = improve_at(
                        work.code, problem, work.at, proposed, new_eave, new_top, _ROUNDS_CANDIDATE, True, True,
                        IMPOSSIBLE,
                    )  # fmt: skip
                if new_loss < best_loss:
                    best_loss, best_eave, best_top, is_better = new_loss, new_eave, new_top, True
                    for e in range(n):
                        best[e] = proposed[e]
            if is_better:
                loss, eave, top, changed, last_change = best_loss, best_eave, best_top, True, unit
                for e in range(n):
                    angle_deg[e] = best[e]
                evaluate_at(work.code, problem, work.at, angle_deg, eave, top)
                total, other = set_excess(problem, work)
        if not changed:
            break
    return loss, eave, top


@allocating
def search(problem, work_at, settings, start_deg, start_top_m, max_rounds, tolerance, descend_below):
    """The best roof from several starts: (loss, eave, top, row), with its angles in that row of ``start_deg``.

    All starts get a first round, the best ``settings.num_followed`` of them are improved, and the classes are
    searched from the best ``settings.num_descents`` that differ. The footprint must have been loaded into
    ``work.skeleton.edge``.

    start_deg: (num_starts, num_edges), overwritten. start_top_m: (num_starts,). tolerance: metres of loss that
    a change of class has to gain. descend_below: only from starts with less loss than this are classes searched.
    """
    work = fit_work_at(work_at)
    k = len(start_deg)
    losses, eaves, tops = np.empty(k), np.empty(k), start_top_m.copy()
    for i in range(k):
        losses[i], eaves[i], tops[i] = improve_at(
            work.code, problem, work.at, start_deg[i], 0.0, tops[i], _ROUNDS_FIRST, True, True, IMPOSSIBLE
        )
    order = stable_order(losses)
    follow_below = losses[order[0]] + _FOLLOW_M
    for i in order[: settings.num_followed]:
        if losses[i] < min(follow_below, IMPOSSIBLE):
            losses[i], eaves[i], tops[i] = improve_at(
                work.code, problem, work.at, start_deg[i], eaves[i], tops[i], _ROUNDS_NEXT, False, True,
                IMPOSSIBLE,
            )  # fmt: skip
    order = stable_order(losses)
    best = order[0]
    best_loss, best_eave, best_top = losses[best], eaves[best], tops[best]
    num_searched, last_loss = 0, -1.0
    for i in order:
        if num_searched >= settings.num_descents or losses[i] >= descend_below:
            break
        if abs(losses[i] - last_loss) < 1e-3:
            continue
        last_loss = losses[i]
        num_searched += 1
        loss, eave, top = _descend(
            problem, work, start_deg[i], eaves[i], tops[i], losses[i], max_rounds, tolerance
        )
        if num_searched == 1 or loss < best_loss - tolerance:
            best, best_loss, best_eave, best_top = i, loss, eave, top
    if num_searched > 0:
        best_loss, best_eave, best_top = improve_at(
            work.code, problem, work.at, start_deg[best], best_eave, best_top, _ROUNDS_LAST, False, True,
            IMPOSSIBLE,
        )  # fmt: skip
    return best_loss, best_eave, best_top, best


search_at = by_address(search)
