"""Which plane covers which cell: the least sum of residuals and of the prices of faces, edges and lines.

The search is that of Boykov, Veksler and Zabih (Fast Approximate Energy Minimization via Graph Cuts, 2001). Each plane
in turn takes all cells that it covers at less cost, by a minimum cut. Then whole faces are given to the faces around
them, and lines with short steps are dropped, where that lowers the cost. Such a move is a small problem of its own
(:func:`_part`): the cells that may change, and one fixed cell for each face around them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from p2wss.fit.planes.costs import Costs, Problem, beside, faces_of, is_step, side_m3, steps_m, total_m3
from p2wss.fit.settings import PlanePrices
from p2wss.skeleton.compiled import ZERO, allocating, entry, inner
from p2wss.skeleton.half_edges import find
from p2wss.skeleton.ordering import ascending, sorted_by

_MAX_ROUNDS = 4
_GAIN_M3 = 1e-6


def least_cost(costs: Costs, num_known: int = 0) -> np.ndarray:
    """int (c,): the plane over each cell. The last ``num_known`` planes are of a known roof: the search begins with
    them."""
    first_known = len(costs.problem.plane) - num_known if num_known else 0
    # the search bars lines, in a copy
    problem = costs.problem._replace(is_barred=costs.problem.is_barred.copy())
    return np.asarray(_least_cost(problem, costs.prices, costs.middle_m, first_known))


@entry
def _least_cost(problem: Problem, prices: PlanePrices, middle_m: np.ndarray, first_known: int) -> np.ndarray:
    """:func:`least_cost`, compiled. middle_m: (c, 2). first_known: the first known plane, 0 without a known roof."""
    choice = _relabelled(problem, prices, first_known)
    if first_known > 0:
        choice = _expanded(problem, prices, choice, ZERO)
    choice = _with_fewer_faces(problem, prices, choice)
    label, slots = problem.number[choice], _slots(problem)
    length_m, face = steps_m(problem, prices, label), np.zeros(len(label), np.int64)
    _find_faces(problem, label, face, np.zeros(1, np.int64))
    is_tried = length_m < 0
    begin, by_line = sorted_by(problem.line, len(length_m))
    while True:
        short = np.flatnonzero((length_m > 0) & (length_m < prices.short_line_m) & ~is_tried)
        if not len(short):
            return label
        line = short[length_m[short].argmin()]
        is_tried[line], sides = True, by_line[begin[line] : begin[line + 1]]
        cells = _around_steps(problem, prices, middle_m, label, face, sides)
        faces = _Faces(face, np.arange(len(face)), length_m)
        part, old, origin, lines, around = _part(problem, prices, choice, faces, cells, np.bool_(True), slots)
        before_m3 = total_m3(part, prices, old)
        part.is_barred[lines == line] = True
        new = _with_fewer_faces(part, prices, _relabelled(part, prices, ZERO))
        if total_m3(part, prices, new) < before_m3 - _GAIN_M3:
            choice[cells], problem.is_barred[line] = origin[new[: len(cells)]], True
            label[cells] = problem.number[choice[cells]]
            for each in lines:
                length_m[each] = 0.0
                for side in by_line[begin[each] : begin[each + 1]]:
                    one, other = label[problem.pair[side, 0]], label[problem.pair[side, 1]]
                    length_m[each] += problem.length_m[side] * is_step(problem, prices, side, one, other)
            _find_faces(problem, label, face, np.concatenate((cells, around)))


@allocating
def _find_faces(problem: Problem, label: np.ndarray, face: np.ndarray, cells: np.ndarray) -> None:
    """Finds anew the faces of ``cells``, in ``face`` (c,), in place. The number of a face is one of its cells."""
    is_old, queue = np.zeros(len(face), np.bool_), np.empty(len(face), np.int64)
    is_old[face[cells]] = True
    face[is_old[face]] = -1
    for first in range(len(face)):
        head, tail = 0, 0
        if face[first] < 0:
            face[first], queue[0], tail = first, first, 1
        while head < tail:
            cell, head = queue[head], head + 1
            for place in range(problem.side_first[cell], problem.side_first[cell + 1]):
                other = beside(problem, problem.side_end[place])
                if face[other] < 0 and label[other] == label[first]:
                    face[other], queue[tail], tail = first, other, tail + 1


@allocating
def _around_steps(
    problem: Problem,
    prices: PlanePrices,
    middle_m: np.ndarray,
    label: np.ndarray,
    face: np.ndarray,
    sides: np.ndarray,
) -> np.ndarray:
    """int (n,): the cells among which the steps on ``sides`` may move. They belong to the faces beside these steps, and
    their middles are within ``around_line_m`` of a cell at a step."""
    is_beside = np.zeros(len(label), np.bool_)
    cells, num, start = np.empty(len(label), np.int64), 0, np.full(len(label), -1)
    for side in sides:
        one, other = problem.pair[side]
        if is_step(problem, prices, side, label[one], label[other]):
            for cell in (one, other):
                is_beside[face[cell]] = True
                if start[cell] < 0:
                    start[cell], cells[num], num = cell, cell, num + 1
    reached = 0
    while reached < num:
        cell, reached = cells[reached], reached + 1
        for way in problem.side_end[problem.side_first[cell] : problem.side_first[cell + 1]]:
            other = beside(problem, way)
            if start[other] < 0 and is_beside[face[other]]:
                x, y = middle_m[other] - middle_m[start[cell]]
                if x * x + y * y < prices.around_line_m**2:
                    start[other], cells[num], num = start[cell], other, num + 1
    return cells[:num].copy()


class _Slots(NamedTuple):
    """Work space of :func:`_part`: the number within the part of each cell, face, line and plane of the whole problem,
    -1 for what the part does not have. is_around: (k,), whether a plane may be a candidate in the part. Between two
    parts, everything is -1 or False again."""

    cell: np.ndarray
    face: np.ndarray
    line: np.ndarray
    plane: np.ndarray
    is_around: np.ndarray


@allocating
def _slots(problem: Problem) -> _Slots:
    num_cells, num_planes = len(problem.first) - 1, len(problem.plane)
    return _Slots(
        np.full(num_cells, -1),
        np.full(num_cells, -1),
        np.full(len(problem.is_barred), -1),
        np.full(num_planes, -1),
        np.zeros(num_planes, np.bool_),
    )


class _Faces(NamedTuple):
    """The faces of a choice. of_cell: (c,), the face of each cell; if that face has been merged into another one since,
    :func:`find` in ``merged`` returns the present face. length_m: (l,), the length of the steps on each line."""

    of_cell: np.ndarray
    merged: np.ndarray
    length_m: np.ndarray


@allocating
def _part(
    problem: Problem,
    prices: PlanePrices,
    choice: np.ndarray,
    faces: _Faces,
    cells: np.ndarray,
    keeps_own: bool,
    slots: _Slots,
) -> tuple[Problem, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(part, old, origin, lines, around): the problem in which only ``cells`` may change.

    old: the present choice, in numbers of the part. origin, lines: the candidate and the line of the whole problem for
    each candidate and line of the part. around: a cell of each face around ``cells``; it is fixed. Candidates are the
    planes of the faces around; with ``keeps_own``, also the present planes of ``cells``.

    The present choice consists of extra candidates behind all others, since its planes need not be around.
    """
    num_free, num_sides = len(cells), len(problem.pair)
    num_ends = 0
    for k, cell in enumerate(cells):
        slots.cell[cell] = k
        num_ends += problem.side_first[cell + 1] - problem.side_first[cell]
    side, pair, num = np.empty(num_ends, np.int64), np.empty((num_ends, 2), np.int64), 0
    around, num_around = np.empty(num_ends, np.int64), 0
    for k, cell in enumerate(cells):
        for way in problem.side_end[problem.side_first[cell] : problem.side_first[cell + 1]]:
            outside = beside(problem, way)
            other = slots.cell[outside]
            if other < 0:
                number = find(faces.merged, faces.of_cell[outside])
                if slots.face[number] < 0:
                    slots.face[number], around[num_around], num_around = num_around, outside, num_around + 1
                other = num_free + slots.face[number]
            elif way >= num_sides:
                continue
            side[num], pair[num, 0], pair[num, 1], num = way % num_sides, k, other, num + 1
    side, pair, around = side[:num].copy(), pair[:num].copy(), around[:num_around].copy()
    for cell in cells:
        slots.cell[cell] = -1
        if keeps_own:
            slots.is_around[problem.number[choice[cell]]] = True
    for cell in around:
        slots.face[find(faces.merged, faces.of_cell[cell])] = -1
        slots.is_around[problem.number[choice[cell]]] = True
    # the present planes of all cells, then the planes that may be chosen
    everything = np.concatenate((cells, around))
    planes, num_planes, num_candidates = np.empty(len(slots.plane), np.int64), ZERO, num_around
    for cell in everything:
        number = problem.number[choice[cell]]
        if slots.plane[number] < 0:
            slots.plane[number], planes[num_planes], num_planes = 0, number, num_planes + 1
    for cell in cells:
        for number in problem.number[problem.first[cell] : problem.first[cell + 1]]:
            if slots.is_around[number]:
                num_candidates += 1
                if slots.plane[number] < 0:
                    slots.plane[number], planes[num_planes], num_planes = 0, number, num_planes + 1
    planes = ascending(planes[:num_planes])
    slots.plane[planes] = np.arange(num_planes)
    first, origin = np.zeros(len(everything) + 1, np.int64), np.empty(num_candidates + num_free, np.int64)
    of_cell, count = np.empty(num_candidates + num_free, np.int64), 0
    for k, cell in enumerate(everything):
        for t in range(problem.first[cell], problem.first[cell + 1]):
            is_own = t == choice[cell] if k >= num_free else slots.is_around[problem.number[t]]
            if is_own:
                origin[count], of_cell[count], count = t, k, count + 1
        first[k + 1] = count
    origin[count:], of_cell[count:] = choice[cells], np.arange(num_free)
    number, cell_m3 = slots.plane[problem.number[origin]], problem.cell_m3[origin]
    old = np.concatenate((np.arange(count, count + num_free), first[num_free:-1]))
    slots.plane[planes], slots.is_around[planes] = -1, False
    # lines, and the length of the steps that each has outside the part
    line, lines, outside_m, num_lines = problem.line[side], np.empty(num, np.int64), np.empty(num), 0
    for k in range(num):
        if slots.line[line[k]] < 0:
            slots.line[line[k]], lines[num_lines] = num_lines, line[k]
            outside_m[num_lines], num_lines = faces.length_m[line[k]], num_lines + 1
        line[k] = slots.line[line[k]]
        one, other = planes[number[old[pair[k, 0]]]], planes[number[old[pair[k, 1]]]]
        if is_step(problem, prices, side[k], one, other):
            outside_m[line[k]] -= problem.length_m[side[k]]
    lines = lines[:num_lines].copy()
    slots.line[lines] = -1
    plane_first, by_plane = sorted_by(number[:count], num_planes)
    ends = np.empty(2 * num, np.int64)
    ends[:num], ends[num:] = pair[:, 0], pair[:, 1]
    side_first, side_end = sorted_by(ends, len(everything))
    part = Problem(
        first,
        number,
        of_cell,
        cell_m3,
        plane_first,
        by_plane,
        num_free,
        pair,
        side_first,
        side_end,
        line,
        problem.length_m[side],
        problem.end_m[side],
        problem.plane[planes],
        problem.is_known[planes],
        np.maximum(outside_m[:num_lines], 0.0),
        problem.is_barred[lines],
    )
    return part, old, origin, lines, around


@allocating
def _with_fewer_faces(problem: Problem, prices: PlanePrices, choice: np.ndarray) -> np.ndarray:
    """The choice (c,) after faces of free cells have been divided among the faces around them, where that lowers the
    cost. The smallest face is first. A face that stays is tried again only when it has changed."""
    num_cells, choice, slots = len(choice), choice.copy(), _slots(problem)
    number_of = faces_of(problem, problem.number[choice])
    # the number of a face is one of its cells; the cells of a face are a circular list
    following, first = np.arange(num_cells), np.full(num_cells, -1)
    of_cell, size = np.empty(num_cells, np.int64), np.zeros(num_cells, np.int64)
    is_open, is_fixed = np.zeros(num_cells, np.bool_), np.zeros(num_cells, np.bool_)
    for cell in range(num_cells):
        if first[number_of[cell]] < 0:
            first[number_of[cell]] = cell
        face = first[number_of[cell]]
        of_cell[cell], is_open[face] = face, True
        size[face] += 1
        is_fixed[face] |= cell >= problem.num_free
        following[cell], following[face] = (following[face], cell) if cell != face else (cell, cell)
    faces = _Faces(of_cell, np.arange(num_cells), steps_m(problem, prices, problem.number[choice]))
    while True:
        pending = np.flatnonzero(is_open & ~is_fixed)
        if not len(pending):
            return choice
        for face in pending[sorted_by(size[pending], num_cells + 1)[1]]:
            is_alive = is_open[face] and not is_fixed[face]
            is_open[face] = False
            if not is_alive or of_cell[face] != face or faces.merged[face] != face:
                continue
            cells, cell = np.empty(size[face], np.int64), face
            for k in range(len(cells)):
                cells[k], cell = cell, following[cell]
            part, old, origin, lines, around = _part(
                problem, prices, choice, faces, cells, np.bool_(False), slots
            )
            if (part.first[1 : len(cells) + 1] == part.first[: len(cells)]).any():
                continue
            new = _relabelled(part, prices, ZERO)
            if total_m3(part, prices, new) >= total_m3(part, prices, old) - _GAIN_M3:
                continue
            choice[cells] = origin[new[: len(cells)]]
            faces.length_m[lines] = steps_m(part, prices, part.number[new])
            group = faces_of(part, part.number[new])
            head = np.full(len(new), -1)
            for k, cell in enumerate(around):
                one, other = head[group[len(cells) + k]], find(faces.merged, of_cell[cell])
                if one < 0:
                    head[group[len(cells) + k]] = other
                elif one != other:
                    faces.merged[other], is_fixed[one] = one, is_fixed[one] or is_fixed[other]
                    following[one], following[other] = following[other], following[one]
                    size[one] += size[other]
            for k, cell in enumerate(cells):
                whole = head[group[k]]
                if whole < 0:
                    whole = head[group[k]] = cell
                    faces.merged[cell], is_fixed[cell], size[cell] = cell, False, 0
                of_cell[cell], is_open[whole] = whole, True
                size[whole] += 1
                following[cell], following[whole] = (
                    (following[whole], cell) if cell != whole else (cell, cell)
                )


@allocating
def _relabelled(problem: Problem, prices: PlanePrices, first_plane: int) -> np.ndarray:
    """The choice (c,) that is best for each free cell on its own, then expanded (:func:`_expanded`). A cell with
    candidates among the planes from ``first_plane`` on takes one of these."""
    result = problem.first[:-1].copy()
    for cell in range(problem.num_free):
        begin, end = problem.first[cell], problem.first[cell + 1]
        if problem.number[end - 1] >= first_plane:
            while problem.number[begin] < first_plane:
                begin += 1
        least_m3 = np.inf
        for t in range(begin, end):
            m3 = problem.cell_m3[t]
            for way in problem.side_end[problem.side_first[cell] : problem.side_first[cell + 1]]:
                other = beside(problem, way)
                if other >= problem.num_free:
                    fixed = problem.number[problem.first[other]]
                    m3 += side_m3(problem, prices, way % len(problem.pair), problem.number[t], fixed)
            if m3 < least_m3:
                least_m3, result[cell] = m3, t
    return _expanded(problem, prices, result, first_plane)


@allocating
def _expanded(problem: Problem, prices: PlanePrices, choice: np.ndarray, first_plane: int) -> np.ndarray:
    """The choice (c,) after each plane from ``first_plane`` on has taken free cells in turn (:func:`_taken`), for up to
    ``_MAX_ROUNDS`` rounds or until none saves anything. The prices of faces and lines do not count."""
    choice, work = choice.copy(), _work(problem)
    # when a cell, or a cell beside it, has last changed
    changed, time = np.zeros(len(choice), np.int64), 1
    tried = np.full(len(problem.plane), -1)
    for _ in range(_MAX_ROUNDS):
        before = time
        for plane in range(first_plane, len(problem.plane)):
            own = problem.by_plane[problem.plane_first[plane] : problem.plane_first[plane + 1]]
            cells, num, is_new = work.cells, ZERO, False
            for t in own:
                cell = problem.of_cell[t]
                if cell < problem.num_free:
                    is_new |= changed[cell] > tried[plane]
                    if choice[cell] != t:
                        work.candidate[cell], cells[num], num = t, cell, num + 1
            if not is_new or num == 0:
                continue
            num = _taken(problem, prices, choice, plane, num, work)
            # what it takes now, it cannot add to afterwards
            time += num > 0
            tried[plane] = time
            for cell in cells[:num]:
                choice[cell], changed[cell] = work.candidate[cell], time
                for way in problem.side_end[problem.side_first[cell] : problem.side_first[cell + 1]]:
                    changed[beside(problem, way)] = time
        if time == before:
            break
    return choice


class _Work(NamedTuple):
    """Work space of :func:`_taken`. cells: first the cells that may be taken, then the cells that are. candidate: the
    candidate of the plane for each cell. is_in: bool (c,), whether a cell may be taken. need_m3: what a cell still
    costs if it is taken; below 0, what it saves. level: see :func:`_measure`. queue: cells.

    The last three have an element for each place in ``side_end``, (2 s,). other: the cell on the other hand. back: the
    place of the way back. rest_m3: the residual capacity of the way.
    """

    cells: np.ndarray
    candidate: np.ndarray
    is_in: np.ndarray
    need_m3: np.ndarray
    level: np.ndarray
    queue: np.ndarray
    other: np.ndarray
    back: np.ndarray
    rest_m3: np.ndarray


@allocating
def _work(problem: Problem) -> _Work:
    num, num_ways = len(problem.first) - 1, len(problem.side_end)
    other, place_of = np.empty(num_ways, np.int64), np.empty(num_ways, np.int64)
    for place, way in enumerate(problem.side_end):
        other[place], place_of[way] = beside(problem, way), place
    return _Work(
        np.empty(num, np.int64),
        np.empty(num, np.int64),
        np.zeros(num, np.bool_),
        np.empty(num),
        np.empty(num, np.int64),
        np.empty(num, np.int64),
        other,
        place_of[(problem.side_end + num_ways // 2) % num_ways],
        np.empty(num_ways),
    )


@inner
def _taken(
    problem: Problem, prices: PlanePrices, choice: np.ndarray, plane: int, num: int, work: _Work
) -> int:
    """The number of cells that a plane takes, out of the first ``num`` of ``work.cells``, so that the cost is least; 0
    if that saves nothing. The taken cells are the first of ``work.cells`` afterwards.

    This is a minimum cut. After the flow, a path still reaches the taken cells from a cell that saves.
    """
    num_sides, number, cells, is_in = len(problem.pair), problem.number, work.cells, work.is_in
    need_m3, rest_m3, level = work.need_m3, work.rest_m3, work.level
    for cell in cells[:num]:
        is_in[cell] = True
        need_m3[cell] = problem.cell_m3[work.candidate[cell]] - problem.cell_m3[choice[cell]]
    for cell in cells[:num]:
        for place in range(problem.side_first[cell], problem.side_first[cell + 1]):
            way, other, own = problem.side_end[place], work.other[place], number[choice[cell]]
            if is_in[other] and way >= num_sides:
                continue
            side, theirs = way % num_sides, number[choice[other]]
            only_one = side_m3(problem, prices, side, plane, theirs)
            neither = side_m3(problem, prices, side, own, theirs)
            if not is_in[other]:
                need_m3[cell] += only_one - neither
                rest_m3[place] = 0.0
            else:
                only_other = only_one if own == theirs else side_m3(problem, prices, side, own, plane)
                # what the two cells cost more apart than together, half of it as capacity in each direction. It would
                # be below 0 where two planes side by side cost more than both beside a third plane
                apart_m3 = max(only_other + only_one - neither, 0.0) / 2
                need_m3[cell] += only_one - neither - apart_m3
                need_m3[other] += apart_m3 - only_one
                rest_m3[place] = rest_m3[work.back[place]] = apart_m3
    _cut(problem, num, work)
    gain_m3, num_taken = 0.0, 0
    for cell in cells[:num]:
        is_in[cell] = level[cell] <= num
    for cell in cells[:num]:
        if not is_in[cell]:
            continue
        cells[num_taken], num_taken = cell, num_taken + 1
        gain_m3 += problem.cell_m3[choice[cell]] - problem.cell_m3[work.candidate[cell]]
        for way in problem.side_end[problem.side_first[cell] : problem.side_first[cell + 1]]:
            side, other, own = way % num_sides, beside(problem, way), number[choice[cell]]
            theirs = number[choice[other]]
            if not is_in[other]:
                gain_m3 -= side_m3(problem, prices, side, plane, theirs)
            elif way >= num_sides:
                continue
            gain_m3 += side_m3(problem, prices, side, own, theirs)
    for cell in cells[:num_taken]:
        is_in[cell] = False
    return num_taken if gain_m3 > _GAIN_M3 else 0


@inner
def _cut(problem: Problem, num: int, work: _Work) -> None:
    """Sends as much flow as possible from cells that save to cells that cost. Afterwards, ``level`` exceeds ``num`` for
    cells that no residual path reaches from a cell that still saves.

    Goldberg and Tarjan (A New Approach to the Maximum-Flow Problem, 1988): a cell sends what it saves to cells beside
    it that are a step nearer to a cell that costs. From time to time the steps are measured anew. Paths are short, as
    most cells that save are beside cells that cost. Searching for augmenting paths from all cells takes twice as long.
    """
    first, level, queue, cells = problem.side_first, work.level, work.queue, work.cells
    need_m3, rest_m3, others, back = work.need_m3, work.rest_m3, work.other, work.back
    far, num_raised = num + 1, num
    for cell in cells[:num]:
        # a lower bound of the steps to a cell that costs
        level[cell] = 0 if need_m3[cell] > _GAIN_M3 else 1
    while num_raised >= num:
        num_raised, head, num_waiting = 0, 0, 0
        for cell in cells[:num]:
            if need_m3[cell] < -_GAIN_M3 and level[cell] < far:
                queue[num_waiting], num_waiting = cell, num_waiting + 1
        while num_waiting and num_raised < num:
            cell = queue[head]
            head, num_waiting = (head + 1) % num, num_waiting - 1
            while need_m3[cell] < -_GAIN_M3 and level[cell] < far:
                nearest = far
                for way in range(first[cell], first[cell + 1]):
                    other = others[way]
                    if rest_m3[way] > _GAIN_M3 and level[other] < level[cell]:
                        flow_m3, has_none = min(rest_m3[way], -need_m3[cell]), need_m3[other] >= -_GAIN_M3
                        rest_m3[way] -= flow_m3
                        rest_m3[back[way]] += flow_m3
                        need_m3[cell] += flow_m3
                        need_m3[other] -= flow_m3
                        if has_none and need_m3[other] < -_GAIN_M3:
                            queue[(head + num_waiting) % num], num_waiting = other, num_waiting + 1
                        if need_m3[cell] >= -_GAIN_M3:
                            break
                    if rest_m3[way] > _GAIN_M3:
                        nearest = min(nearest, level[other] + 1)
                else:
                    level[cell], num_raised = nearest, num_raised + 1
        if num_raised >= num:
            _measure(problem, num, work, np.bool_(False))
    _measure(problem, num, work, np.bool_(True))


@inner
def _measure(problem: Problem, num: int, work: _Work, is_from_start: bool) -> None:
    """Sets the level of each cell: with ``is_from_start``, the number of steps to it from the nearest cell that saves,
    otherwise from it to the nearest cell that costs. It is more than ``num`` where there is no path."""
    first, level, queue, sign = problem.side_first, work.level, work.queue, -1.0 if is_from_start else 1.0
    head, tail = 0, 0
    for cell in work.cells[:num]:
        level[cell] = num + 1
        if sign * work.need_m3[cell] > _GAIN_M3:
            level[cell], queue[tail], tail = 0, cell, tail + 1
    while head < tail:
        cell, head = queue[head], head + 1
        for place in range(first[cell], first[cell + 1]):
            other, way = work.other[place], place if is_from_start else work.back[place]
            if work.is_in[other] and level[other] > num and work.rest_m3[way] > _GAIN_M3:
                level[other], queue[tail], tail = level[cell] + 1, other, tail + 1
