"""The class of every edge, flat, gable or slope: coordinate descent from several starts."""

from __future__ import annotations

import numpy as np

from p2wss.refine.solve import IMPOSSIBLE, evaluate, improve
from p2wss.skeleton.compiled import entry, inner
from p2wss.skeleton.footprint import load_footprint
from p2wss.skeleton.status import Status

_OK = int(Status.OK)
_ALTERNATIVES_DEG = (0.0, 90.0, 18.0, 38.0, 57.0)
_NUM_CLASSES = 2  # of the alternatives, those that are no slope
_ROUNDS_FIRST, _ROUNDS_CANDIDATE, _ROUNDS_LAST = 4, 3, 8
# a candidate within this of the present loss gets a second look with its height freed
_SECOND_LOOK_M = 0.15
_HOPELESS_M = 0.3


@inner
def _is_slope(angle):
    return 0.0 < angle < 90.0


@inner
def _propose(problem, angle_deg, unit, alternative, proposed):
    """The angles with one edge, or all edges of one direction, changed. False: nothing new."""
    n = problem.num_edges
    angle = _ALTERNATIVES_DEG[alternative]
    for e in range(n):
        proposed[e] = angle_deg[e]
    if unit < n:
        if abs(angle_deg[unit] - angle) < (1e-9 if alternative < _NUM_CLASSES else 9.0):
            return False
        if alternative >= _NUM_CLASSES:
            for e in range(n):
                if problem.angle_group[e] == problem.angle_group[unit] and _is_slope(proposed[e]):
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


@inner
def _descend(problem, work, angle_deg, eave, top, loss, max_rounds, tolerance):
    """Change edges and directions while that lowers the loss by more than ``tolerance``; ``angle_deg`` is
    changed in place. Returns (loss, eave, top)."""
    n = problem.num_edges
    proposed, best = work.trial[1], work.trial[2]
    for _ in range(max_rounds):
        changed = False
        for unit in range(n + problem.num_directions):
            best_loss, best_eave, best_top = loss - tolerance, eave, top
            found = False
            for alternative in range(len(_ALTERNATIVES_DEG)):
                if not _propose(problem, angle_deg, unit, alternative, proposed):
                    continue
                new_loss, new_eave, new_top = improve(
                    problem, work, proposed, eave, top, _ROUNDS_CANDIDATE, False, True, loss + _HOPELESS_M
                )
                if best_loss <= new_loss < loss + _SECOND_LOOK_M:
                    new_loss, new_eave, new_top = improve(
                        problem, work, proposed, new_eave, new_top, _ROUNDS_CANDIDATE, True, True, IMPOSSIBLE
                    )
                if new_loss < best_loss:
                    best_loss, best_eave, best_top, found = new_loss, new_eave, new_top, True
                    for e in range(n):
                        best[e] = proposed[e]
            if found:
                loss, eave, top, changed = best_loss, best_eave, best_top, True
                for e in range(n):
                    angle_deg[e] = best[e]
        if not changed:
            break
    return loss, eave, top


@entry
def search(
    xy_m, ring_offset, problem, work, start_deg, start_top_m, num_descents, max_rounds, tolerance, descend_below
):  # fmt: skip
    """The best roof from the starts: a row of (loss, eave, top) and its angles are written to row 0 of
    ``start_deg``. All starts are improved; the best ``num_descents`` that differ descend.

    xy_m, ring_offset: the polygon. start_deg: (num_starts, num_edges), overwritten. start_top_m:
    (num_starts,). tolerance: metres of loss that a change of class has to gain. descend_below: only starts
    with less loss than this descend.
    """
    status, _ = load_footprint(xy_m, ring_offset, 0, problem.num_rings, work.skeleton.edge)
    if status != _OK:
        return IMPOSSIBLE, 0.0, np.inf
    k = len(start_deg)
    losses, eaves, tops = np.full(k, IMPOSSIBLE), np.zeros(k), start_top_m.copy()
    for i in range(k):
        losses[i], eaves[i], tops[i] = improve(
            problem, work, start_deg[i], 0.0, tops[i], _ROUNDS_FIRST, True, True, IMPOSSIBLE
        )
    order = np.argsort(losses)
    best = order[0]
    best_loss, best_eave, best_top = losses[best], eaves[best], tops[best]
    used, last = 0, -1.0
    for i in order:
        if used >= num_descents or losses[i] >= descend_below:
            break
        if abs(losses[i] - last) < 1e-3:
            continue
        last = losses[i]
        used += 1
        loss, eave, top = _descend(
            problem, work, start_deg[i], eaves[i], tops[i], losses[i], max_rounds, tolerance
        )
        if used == 1 or loss < best_loss - tolerance:
            best, best_loss, best_eave, best_top = i, loss, eave, top
    if used > 0:
        best_loss, best_eave, best_top = improve(
            problem, work, start_deg[best], best_eave, best_top, _ROUNDS_LAST, False, True, IMPOSSIBLE
        )
    for e in range(problem.num_edges):
        start_deg[0, e] = start_deg[best, e]
    return best_loss, best_eave, best_top


@entry
def polish(xy_m, ring_offset, problem, work, angle_deg, eave, top, from_median, free_angles, num_rounds):
    """Improve one roof without changing a class; ``angle_deg`` is changed in place. Returns
    (loss, eave, top)."""
    status, _ = load_footprint(xy_m, ring_offset, 0, problem.num_rings, work.skeleton.edge)
    if status != _OK:
        return IMPOSSIBLE, eave, top
    if num_rounds == 0:
        return evaluate(problem, work, angle_deg, eave, top), eave, top
    return improve(problem, work, angle_deg, eave, top, num_rounds, from_median, free_angles, IMPOSSIBLE)
