"""Which plane covers which cell: the least sum of residuals and of the prices of faces and edges.

The search is that of Boykov, Veksler and Zabih (Fast Approximate Energy Minimization via Graph Cuts, 2001): each plane
in turn takes the cells that it covers at less cost, all at once, by a minimum cut. Faces then give way to those around
them, and lines with short steps to others, where that saves more than it costs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from p2wss.fit.planes.arrangement import Arrangement
from p2wss.fit.planes.detection import heights
from p2wss.fit.settings import PlanePrices
from p2wss.skeleton.compiled import allocating, entry
from p2wss.skeleton.groups import groups

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
        num_faces, num_lines = self.faces(label).max(initial=-1) + 1, np.count_nonzero(self.steps_m(label))
        total_m3 = _sum(self.cell_m3, self.pair, self.side_m3, label)
        return float(total_m3 + self.prices.face_m3 * num_faces + self.prices.line_m3 * num_lines)

    def is_step_at(self, label: np.ndarray) -> np.ndarray:
        """bool (s,): whether there is a step at each side."""
        return self.is_step[np.arange(len(self.pair)), label[self.pair[:, 0]], label[self.pair[:, 1]]]

    def steps_m(self, label: np.ndarray) -> np.ndarray:
        """(l,): how much of each line has steps."""
        return np.bincount(self.line, self.length_m * self.is_step_at(label))

    def faces(self, label: np.ndarray) -> np.ndarray:
        """int (c,): numbers of the connected faces."""
        same = label[self.pair[:, 0]] == label[self.pair[:, 1]]
        return groups(len(label), self.pair[same])

    def bodies(self, label: np.ndarray) -> np.ndarray:
        """int (c,): numbers of the faces that no step divides."""
        return groups(len(label), self.pair[~self.is_step_at(label)])

    def without(self, line: int) -> Costs:
        """The costs if there is no step along a line."""
        side_m3 = self.side_m3.copy()
        on_line = self.line == line
        side_m3[on_line] += _FORBIDDEN_M3 * self.is_step[on_line]
        return replace(self, side_m3=side_m3)

    def of(self, cells: np.ndarray, planes: np.ndarray, label: np.ndarray) -> Costs:
        """The costs of some cells and planes, while all other cells keep their labels."""
        number = np.full(len(label), -1)
        number[cells] = np.arange(len(cells))
        cell_m3 = self.cell_m3[np.ix_(cells, planes)].copy()
        inside = number[self.pair] >= 0
        for side in (0, 1):
            rows = np.flatnonzero(inside[:, side] & ~inside[:, 1 - side])
            fixed = label[self.pair[rows, 1 - side]]
            own = self.side_m3[rows[:, None], planes[None], fixed[:, None]]
            np.add.at(cell_m3, number[self.pair[rows, side]], own)
        rows = np.flatnonzero(inside.all(axis=1))
        within = np.ix_(rows, planes, planes)
        return Costs(
            cell_m3,
            number[self.pair[rows]],
            self.side_m3[within],
            self.is_step[within],
            self.line[rows],
            self.length_m[rows],
            self.prices,
        )


def costs_of(
    cells: Arrangement,
    plane: np.ndarray,
    label: np.ndarray,
    point_m: np.ndarray,
    of_cell: np.ndarray,
    density: float,
    prices: PlanePrices,
) -> Costs:
    """The costs of covering cells with planes (k, 3). label: (m,), the plane of each point (m, 3). of_cell: (m,),
    its cell, -1 for none. density: points per square metre, each of which stands for an area."""
    num_planes = len(plane)
    off_m = np.minimum(np.abs(heights(plane, point_m[:, :2]) - point_m[:, 2:]), prices.cap_m)
    cell_m3 = np.zeros((len(cells.area_m2), num_planes))
    np.add.at(cell_m3, of_cell[of_cell >= 0], off_m[of_cell >= 0] / density)
    low_z, high_z = cells.extremes(plane)
    steep = np.hypot(plane[:, 0], plane[:, 1])
    for number in range(num_planes):
        beyond_m, _ = cKDTree(point_m[label == number, :2]).query(cells.middle_m)
        expected_m = np.minimum(np.maximum(beyond_m - 1, 0) * prices.beyond_share, prices.max_beyond_m)
        # between the last point and the end of a roof
        gap_m = steep[number] / (2 * density**0.5)
        above_m = high_z[:, number] - point_m[:, 2].max() - gap_m - prices.support_m
        below_m = point_m[:, 2].min() - gap_m - prices.support_m - low_z[:, number]
        unsupported_m = np.clip(np.maximum(above_m, below_m), 0.0, prices.cap_m)
        cell_m3[:, number] += cells.area_m2 * (expected_m + unsupported_m)
    cell_m3[low_z < _LOWEST_M] += _FORBIDDEN_M3
    is_shared = (cells.pair >= 0).all(axis=1)
    pair, end_m = cells.pair[is_shared], cells.xy_m[cells.side[is_shared]]
    end_z = np.stack([heights(plane, end_m[:, end]) for end in (0, 1)])
    step_m = np.abs(end_z[:, :, :, None] - end_z[:, :, None, :])
    fold = np.linalg.norm(plane[:, None, :2] - plane[None, :, :2], axis=2)
    meeting = np.where(fold < prices.shallow, prices.shallow_share, prices.meet_share)
    stepping = np.where(step_m.mean(axis=0) < prices.small_step_m, prices.small_step_share, 1.0)
    is_step = step_m.max(axis=0) >= prices.meet_m
    share = np.where(is_step, stepping, meeting)
    share[:, np.arange(num_planes), np.arange(num_planes)] = 0.0
    length_m = np.linalg.norm(end_m[:, 1] - end_m[:, 0], axis=1)
    side_m3 = prices.edge_m2 * length_m[:, None, None] * share
    return Costs(cell_m3, pair, side_m3, is_step, cells.line[is_shared], length_m, prices)


def least_cost(costs: Costs) -> np.ndarray:
    """int (c,): the plane over each cell."""
    label, total_m3 = _with_fewer_faces(costs)
    tried: set[int] = set()
    while True:
        steps_m = costs.steps_m(label)
        is_short = (steps_m > 0) & (steps_m < costs.prices.short_line_m)
        is_short[list(tried)] = False
        if not is_short.any():
            return label
        line = int(np.where(is_short, steps_m, np.inf).argmin())
        tried.add(line)
        face = costs.faces(label)
        beside = face[costs.pair[(costs.line == line) & costs.is_step_at(label)]]
        cells = np.flatnonzero(np.isin(face, beside))
        planes = np.unique(np.append(label[cells], _around(costs, label, cells)))
        own, other = costs.of(cells, planes, label).without(line), label.copy()
        other[cells] = planes[_with_fewer_faces(own)[0]]
        other_m3 = costs.total_m3(other)
        if other_m3 < total_m3 - _GAIN_M3:
            label, total_m3, costs = other, other_m3, costs.without(line)


def _with_fewer_faces(costs: Costs) -> tuple[np.ndarray, float]:
    """The labels (c,) of least cost from which faces have given way to those around them, and what they cost."""
    label = _expanded(costs, costs.cell_m3.argmin(axis=1))
    total_m3, tried = costs.total_m3(label), set()
    while True:
        face = costs.faces(label)
        for number in np.argsort(np.bincount(face), kind="stable"):
            cells = np.flatnonzero(face == number)
            key = (label[cells[0]], *cells.tolist())
            if key in tried:
                continue
            tried.add(key)
            around = _around(costs, label, cells)
            around = around[around != label[cells[0]]]
            if not len(around):
                continue
            own, simpler = costs.of(cells, around, label), label.copy()
            simpler[cells] = around[_expanded(own, own.cell_m3.argmin(axis=1))]
            simpler_m3 = costs.total_m3(simpler)
            if simpler_m3 < total_m3 - _GAIN_M3:
                label, total_m3 = simpler, simpler_m3
                break
        else:
            return label, total_m3


def _around(costs: Costs, label: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """The planes of the cells beside some cells."""
    inside = np.zeros(len(label), bool)
    inside[cells] = True
    is_inside = inside[costs.pair]
    return np.unique(label[costs.pair[~is_inside & is_inside[:, ::-1]]])


def _expanded(costs: Costs, label: np.ndarray) -> np.ndarray:
    """The labels after planes have taken cells as long as that saves something, without the prices of faces."""
    end = np.concatenate([costs.pair[:, 0], costs.pair[:, 1]])
    order = np.argsort(end, kind="stable")
    first = np.searchsorted(end[order], np.arange(len(label) + 1))
    return np.asarray(_expand(_Graph(costs.cell_m3, costs.pair, costs.side_m3, order, first), label))


class _Graph(NamedTuple):
    """Costs for compiled code, and the sides of each cell. order: the ends of sides, those of the first cells of all
    sides before those of the second, by cell; first: (c + 1,), where those of each cell begin."""

    cell_m3: np.ndarray
    pair: np.ndarray
    side_m3: np.ndarray
    order: np.ndarray
    first: np.ndarray


@entry
def _expand(graph: _Graph, label: np.ndarray) -> np.ndarray:
    """The labels (c,) after planes have taken cells in turn."""
    cell_m3, pair, side_m3 = graph.cell_m3, graph.pair, graph.side_m3
    label, candidate = label.copy(), label.copy()
    total_m3 = _sum(cell_m3, pair, side_m3, label)
    for _ in range(_MAX_ROUNDS):
        before_m3 = total_m3
        for number in range(cell_m3.shape[1]):
            is_taken = _taken(graph, label, number)
            candidate[:] = np.where(is_taken, number, label)
            candidate_m3 = _sum(cell_m3, pair, side_m3, candidate)
            if candidate_m3 < total_m3 - _GAIN_M3:
                label[:], total_m3 = candidate, candidate_m3
        if total_m3 == before_m3:
            break
    return label


@entry
def _sum(cell_m3: np.ndarray, pair: np.ndarray, side_m3: np.ndarray, label: np.ndarray) -> float:
    """What labels cost, without the prices of faces."""
    total_m3 = 0.0
    for cell in range(len(label)):
        total_m3 += cell_m3[cell, label[cell]]
    for side in range(len(pair)):
        total_m3 += side_m3[side, label[pair[side, 0]], label[pair[side, 1]]]
    return total_m3


@allocating
def _taken(graph: _Graph, label: np.ndarray, number: int) -> np.ndarray:
    """bool (c,): the cells that plane ``number`` takes at least cost in all.

    This is a minimum cut by blocking flows (Dinic, 1970); those cells are taken that a path still reaches in the end.
    """
    cell_m3, pair, side_m3, order, first = graph
    num_cells, num_sides = len(label), len(pair)
    # steps from the nearest start; which of its sides a cell tries next
    level, place = np.empty(num_cells, np.int64), np.empty(num_cells, np.int64)
    queue, path = np.empty(num_cells, np.int64), np.empty(num_cells, np.int64)
    # what a cell still costs if it is taken; below 0, what it saves
    need_m3 = np.empty(num_cells)
    # what remains of the capacity of a side, in both directions
    rest_m3 = np.empty(2 * num_sides)
    for cell in range(num_cells):
        need_m3[cell] = cell_m3[cell, number] - cell_m3[cell, label[cell]]
    for side in range(num_sides):
        one, other = pair[side, 0], pair[side, 1]
        neither = side_m3[side, label[one], label[other]]
        only_other, only_one = side_m3[side, label[one], number], side_m3[side, number, label[other]]
        need_m3[one] += only_one - neither
        need_m3[other] -= only_one
        # where planes to the left and right of a side cost more than both by way of a third one, this is a bound
        rest_m3[side], rest_m3[side + num_sides] = 0.0, max(only_other + only_one - neither, 0.0)
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
