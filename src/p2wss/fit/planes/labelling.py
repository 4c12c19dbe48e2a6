"""Which plane covers which cell: the least sum of residuals and of the prices of faces and edges.

The search is that of Boykov, Veksler and Zabih (Fast Approximate Energy Minimization via Graph Cuts, 2001): each plane
in turn takes the cells that it covers at less cost, all at once, by a minimum cut. Faces then give way to those around
them, and lines with short steps to others, where that saves more than it costs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from p2wss.fit.planes.arrangement import Arrangement
from p2wss.fit.planes.detection import heights
from p2wss.fit.settings import PlanePrices
from p2wss.skeleton.compiled import allocating, both, entry, inner
from p2wss.skeleton.groups import grouped, groups

_MAX_ROUNDS = 4
# metres above the ground: no roof is lower, at a price beyond all others
_LOWEST_M, _FORBIDDEN_M3 = 0.3, 1e4
_GAIN_M3 = 1e-6
# steps to a cell that no path reaches
_NOT_REACHED = -1


@dataclass(frozen=True)
class Costs:
    """What a labelling costs, cubic metres. cell_m3: (c, k), of each plane over each cell. pair: int (s, 2), cells side
    by side. side_m3: (s, k, k), of planes to the left and the right of each side. is_step: bool (s, k, k), whether
    there is a step between them. line: int (s,), the line of each side. length_m: (s,)."""

    cell_m3: np.ndarray
    pair: np.ndarray
    side_m3: np.ndarray
    is_step: np.ndarray
    line: np.ndarray
    length_m: np.ndarray
    prices: PlanePrices

    def total_m3(self, label: np.ndarray) -> float:
        """Of planes ``label`` (c,) over the cells."""
        return float(_total_m3(self.graph, self.prices, label))

    def faces(self, label: np.ndarray) -> np.ndarray:
        """int (c,): numbers of the connected faces."""
        return np.asarray(_faces(self.graph, label))

    def bodies(self, label: np.ndarray) -> np.ndarray:
        """int (c,): numbers of the faces that no step divides."""
        is_step = self.is_step[np.arange(len(self.pair)), label[self.pair[:, 0]], label[self.pair[:, 1]]]
        return groups(len(label), self.pair[~is_step])

    @cached_property
    def graph(self) -> _Graph:
        """For compiled code."""
        end = np.concatenate([self.pair[:, 0], self.pair[:, 1]])
        order = np.argsort(end, kind="stable")
        first = np.searchsorted(end[order], np.arange(len(self.cell_m3) + 1))
        return _Graph(
            self.cell_m3, self.pair, self.side_m3, order, first, self.is_step, self.line, self.length_m
        )


def costs_of(
    cells: Arrangement,
    plane: np.ndarray,
    point_m: np.ndarray,
    of_cell: np.ndarray,
    stands_m2: np.ndarray,
    prices: PlanePrices,
    num_known: int = 0,
) -> Costs:
    """The costs of covering cells with planes (k, 3). of_cell: (m,), the cell of each point (m, 3), -1 for none.
    stands_m2: (m,), the area that each point stands for. num_known: the last planes, of a known roof."""
    num_planes, own_m, own_m2 = len(plane), point_m[of_cell >= 0], stands_m2[of_cell >= 0]
    off_m = np.minimum(np.abs(heights(plane, own_m[:, :2]) - own_m[:, 2:]), prices.cap_m)
    place = np.add.outer(of_cell[of_cell >= 0] * num_planes, np.arange(num_planes)).ravel()
    off_m3 = np.bincount(place, (off_m * own_m2[:, None]).ravel(), len(cells.area_m2) * num_planes)
    cell_m3 = np.asarray(off_m3, float).reshape(-1, num_planes)
    low_z, high_z = cells.extremes(plane)
    above_m, below_m = high_z - point_m[:, 2].max(), point_m[:, 2].min() - low_z
    unsupported_m = np.clip(np.maximum(above_m, below_m) - prices.support_m, 0.0, prices.cap_m)
    cell_m3 += cells.area_m2[:, None] * unsupported_m
    cell_m3[low_z < _LOWEST_M] += _FORBIDDEN_M3
    is_shared = (cells.pair >= 0).all(axis=1)
    pair, end_m = cells.pair[is_shared], cells.xy_m[cells.side[is_shared]]
    end_z = np.stack([heights(plane, end_m[:, end]) for end in (0, 1)])
    length_m = np.linalg.norm(end_m[:, 1] - end_m[:, 0], axis=1)
    meeting = np.full((num_planes, num_planes), prices.meet_share)
    meeting[num_planes - num_known :, num_planes - num_known :] = prices.known_share
    side_m3, is_step = _at_sides(end_z, length_m, meeting, prices)
    return Costs(cell_m3, pair, side_m3, is_step, cells.line[is_shared], length_m, prices)


@entry
def _at_sides(
    end_z: np.ndarray, length_m: np.ndarray, meeting: np.ndarray, prices: PlanePrices
) -> tuple[np.ndarray, np.ndarray]:
    """(what each pair of planes (k, 3) costs on the two hands of each side, (s, k, k); whether there is a step between
    them, bool). end_z: (2, s, k), heights of the planes at the ends of the sides. meeting: (k, k), the share of the
    price that planes have which meet."""
    num = len(meeting)
    side_m3, is_step = np.zeros((len(length_m), num, num)), np.zeros((len(length_m), num, num), np.bool_)
    for side in range(len(length_m)):
        for i in range(num):
            for j in range(i):
                first_m, last_m = (
                    abs(end_z[0, side, i] - end_z[0, side, j]),
                    abs(end_z[1, side, i] - end_z[1, side, j]),
                )
                share = meeting[i, j]
                if max(first_m, last_m) >= prices.meet_m:
                    is_step[side, i, j] = is_step[side, j, i] = True
                    share = prices.small_step_share if first_m + last_m < 2 * prices.small_step_m else 1.0
                side_m3[side, i, j] = side_m3[side, j, i] = prices.edge_m2 * length_m[side] * share
    return side_m3, is_step


class _Graph(NamedTuple):
    """Costs for compiled code, and the sides of each cell. order: the ends of sides, those of the first cells of all
    sides before those of the second, by cell; first: (c + 1,), where those of each cell begin."""

    cell_m3: np.ndarray
    pair: np.ndarray
    side_m3: np.ndarray
    order: np.ndarray
    first: np.ndarray
    is_step: np.ndarray
    line: np.ndarray
    length_m: np.ndarray


def least_cost(costs: Costs, num_known: int = 0) -> np.ndarray:
    """int (c,): the plane over each cell. If so many of the last planes are known, the search begins with these."""
    graph = costs.graph._replace(side_m3=costs.side_m3.copy())
    return np.asarray(_least_cost(graph, costs.side_m3, costs.prices, num_known))


@entry
def _least_cost(graph: _Graph, side_m3: np.ndarray, prices: PlanePrices, num_known: int) -> np.ndarray:
    """The same. side_m3: of all sides; in the graph, which has a copy, steps are forbidden on lines that are dispensed
    with."""
    label, every = np.zeros(len(graph.cell_m3), np.int64), np.ones(len(graph.cell_m3), np.bool_)
    number = np.arange(graph.cell_m3.shape[1])
    label = _relabelled(graph, label, every, number >= (len(number) - num_known) % len(number))
    if num_known > 0:
        label = _expanded(graph, label, every, number >= 0)
    label, total_m3 = _with_fewer_faces(graph, prices, label, every)
    is_tried = _steps_m(graph, label) < 0
    while True:
        steps_m = _steps_m(graph, label)
        short = np.flatnonzero((steps_m > 0) & (steps_m < prices.short_line_m) & ~is_tried)
        if not len(short):
            return label
        line = short[steps_m[short].argmin()]
        is_tried[line], on_line = True, np.flatnonzero(graph.line == line)
        face = _faces(graph, label)
        beside = np.zeros(len(label), np.bool_)
        for side in on_line:
            one, other = graph.pair[side]
            if graph.is_step[side, label[one], label[other]]:
                beside[face[one]] = beside[face[other]] = True
            graph.side_m3[side] += _FORBIDDEN_M3 * graph.is_step[side]
        other_label = _relabelled(graph, label, beside[face], number >= 0)
        other_label, other_m3 = _with_fewer_faces(graph, prices, other_label, beside[face])
        if other_m3 < total_m3 - _GAIN_M3:
            label, total_m3 = other_label, other_m3
        else:
            for side in on_line:
                graph.side_m3[side] = side_m3[side]


@allocating
def _with_fewer_faces(
    graph: _Graph, prices: PlanePrices, label: np.ndarray, is_inside: np.ndarray
) -> tuple[np.ndarray, float]:
    """The labels (c,) after some cells, bool (c,), have got the planes of least cost, and faces of such cells have
    given way to those around them, the smallest first; and what they cost."""
    every = np.ones(graph.cell_m3.shape[1], np.bool_)
    total_m3 = _total_m3(graph, prices, label)
    # the planes of faces that have been tried, -1 over other cells
    tried, num_tried = np.empty((8, len(label)), np.int64), 0
    while True:
        face, is_better = _faces(graph, label), False
        size = np.bincount(face)
        is_open = np.bincount(face[is_inside], minlength=len(size)) == size
        while is_open.any() and not is_better:
            number = np.where(is_open, size, len(label) + 1).argmin()
            is_open[number], is_new = False, True
            if num_tried == len(tried):
                tried = np.concatenate((tried, np.empty_like(tried)))
            tried[num_tried] = np.where(face == number, label, -1)
            for t in range(num_tried):
                is_new &= (tried[t] != tried[num_tried]).any()
            if is_new:
                num_tried += 1
                simpler = _relabelled(graph, label, face == number, ~every)
                simpler_m3 = _total_m3(graph, prices, simpler)
                if simpler_m3 < total_m3 - _GAIN_M3:
                    label, total_m3, is_better = simpler, simpler_m3, True
        if not is_better:
            return label, total_m3


@both
def _total_m3(graph: _Graph, prices: PlanePrices, label: np.ndarray) -> float:
    """What planes over the cells cost."""
    num_faces = _faces(graph, label).max() + 1
    num_lines = np.minimum(_steps_m(graph, label) / prices.whole_line_m, 1.0).sum()
    total_m3 = _sum(graph.cell_m3, graph.pair, graph.side_m3, label)
    return total_m3 + prices.face_m3 * num_faces + prices.line_m3 * num_lines


@allocating
def _steps_m(graph: _Graph, label: np.ndarray) -> np.ndarray:
    """(l,): how much of each line has steps."""
    result = np.zeros(graph.line.max() + 1 if len(graph.line) else 0)
    for side, line in enumerate(graph.line):
        if graph.is_step[side, label[graph.pair[side, 0]], label[graph.pair[side, 1]]]:
            result[line] += graph.length_m[side]
    return result


@both
def _faces(graph: _Graph, label: np.ndarray) -> np.ndarray:
    """int (c,): numbers of the connected faces, in the order of their first cells."""
    link = graph.pair.copy()
    for side in range(len(link)):
        if label[link[side, 0]] != label[link[side, 1]]:
            link[side, 1] = link[side, 0]
    return grouped(len(label), link)


@allocating
def _relabelled(graph: _Graph, label: np.ndarray, is_inside: np.ndarray, is_used: np.ndarray) -> np.ndarray:
    """The labels (c,) after some cells, bool (c,), have got planes that are used, bool (k,), or around them."""
    cell_m3, pair, side_m3 = graph.cell_m3, graph.pair, graph.side_m3
    least_m3, is_around, result = cell_m3.copy(), is_used.copy(), label.copy()
    for side in range(len(pair)):
        one, other = pair[side, 0], pair[side, 1]
        if is_inside[one] and not is_inside[other]:
            least_m3[one] += side_m3[side, :, label[other]]
            is_around[label[other]] = True
        elif is_inside[other] and not is_inside[one]:
            least_m3[other] += side_m3[side, label[one]]
            is_around[label[one]] = True
    for cell in np.flatnonzero(is_inside):
        best_m3 = np.inf
        for number in np.flatnonzero(is_around):
            if least_m3[cell, number] < best_m3:
                best_m3, result[cell] = least_m3[cell, number], number
    return _expanded(graph, result, is_inside, is_around)


@allocating
def _expanded(graph: _Graph, label: np.ndarray, is_free: np.ndarray, is_used: np.ndarray) -> np.ndarray:
    """The labels (c,) after planes, those of bool (k,), have taken cells in turn, those of bool (c,), as long as that
    saves something, without the prices of faces."""
    cell_m3, pair, side_m3 = graph.cell_m3, graph.pair, graph.side_m3
    label, candidate = label.copy(), label.copy()
    total_m3 = _sum(cell_m3, pair, side_m3, label)
    for _ in range(_MAX_ROUNDS):
        before_m3 = total_m3
        for number in np.flatnonzero(is_used):
            is_taken = _taken(graph, label, is_free, number)
            candidate[:] = np.where(is_taken, number, label)
            candidate_m3 = _sum(cell_m3, pair, side_m3, candidate)
            if candidate_m3 < total_m3 - _GAIN_M3:
                label[:], total_m3 = candidate, candidate_m3
        if total_m3 == before_m3:
            break
    return label


@inner
def _sum(cell_m3: np.ndarray, pair: np.ndarray, side_m3: np.ndarray, label: np.ndarray) -> float:
    """What labels cost, without the prices of faces."""
    total_m3 = 0.0
    for cell in range(len(label)):
        total_m3 += cell_m3[cell, label[cell]]
    for side in range(len(pair)):
        total_m3 += side_m3[side, label[pair[side, 0]], label[pair[side, 1]]]
    return total_m3


@allocating
def _taken(graph: _Graph, label: np.ndarray, is_free: np.ndarray, number: int) -> np.ndarray:
    """bool (c,): the cells, of those that are free, that plane ``number`` takes at least cost in all.

    This is a minimum cut by blocking flows (Dinic, 1970); those cells are taken that a path still reaches in the end.
    """
    cell_m3, pair, side_m3, order, first = graph.cell_m3, graph.pair, graph.side_m3, graph.order, graph.first
    num_cells, num_sides = len(label), len(pair)
    # steps from the nearest start; which of its sides a cell tries next
    level, place = np.empty(num_cells, np.int64), np.empty(num_cells, np.int64)
    queue, path = np.empty(num_cells, np.int64), np.empty(num_cells, np.int64)
    # what a cell still costs if it is taken; below 0, what it saves
    need_m3 = np.empty(num_cells)
    # what remains of the capacity of a side, in both directions
    rest_m3 = np.zeros(2 * num_sides)
    for cell in range(num_cells):
        need_m3[cell] = cell_m3[cell, number] - cell_m3[cell, label[cell]] if is_free[cell] else 0.0
    for side in range(num_sides):
        one, other = pair[side, 0], pair[side, 1]
        neither = side_m3[side, label[one], label[other]]
        only_other, only_one = side_m3[side, label[one], number], side_m3[side, number, label[other]]
        if is_free[one]:
            need_m3[one] += only_one - neither
            if is_free[other]:
                need_m3[other] -= only_one
                # a bound where two planes side by side cost more than both by way of a third one
                rest_m3[side + num_sides] = max(only_other + only_one - neither, 0.0)
        elif is_free[other]:
            need_m3[other] += only_other - neither
    while True:
        head, tail, meets = 0, 0, False
        for cell in range(num_cells):
            level[cell], place[cell] = _NOT_REACHED, first[cell]
            if need_m3[cell] < -_GAIN_M3:
                level[cell], queue[tail], tail = 0, cell, tail + 1
        num_starts = tail
        while head < tail:
            cell, head = queue[head], head + 1
            meets |= need_m3[cell] > _GAIN_M3
            for way in order[first[cell] : first[cell + 1]]:
                beside = pair[way, 1] if way < num_sides else pair[way - num_sides, 0]
                if level[beside] == _NOT_REACHED and rest_m3[way] > _GAIN_M3:
                    level[beside], queue[tail], tail = level[cell] + 1, beside, tail + 1
        if not meets:
            return level != _NOT_REACHED
        for start in queue[:num_starts]:
            cell, depth = start, 0
            while need_m3[start] < -_GAIN_M3:
                if need_m3[cell] > _GAIN_M3:
                    flow_m3 = min(need_m3[cell], -need_m3[start])
                    for way in path[:depth]:
                        flow_m3 = min(flow_m3, rest_m3[way])
                    for way in path[:depth]:
                        rest_m3[way] -= flow_m3
                        rest_m3[way + num_sides if way < num_sides else way - num_sides] += flow_m3
                    need_m3[cell] -= flow_m3
                    need_m3[start] += flow_m3
                    cell, depth = start, 0
                elif place[cell] < first[cell + 1]:
                    way = order[place[cell]]
                    beside = pair[way, 1] if way < num_sides else pair[way - num_sides, 0]
                    if rest_m3[way] > _GAIN_M3 and level[beside] == level[cell] + 1:
                        cell, path[depth], depth = beside, way, depth + 1
                    else:
                        place[cell] += 1
                elif depth:
                    depth -= 1
                    way = path[depth]
                    cell = pair[way, 0] if way < num_sides else pair[way - num_sides, 1]
                    place[cell] += 1
                else:
                    break
