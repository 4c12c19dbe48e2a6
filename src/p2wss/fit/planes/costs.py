"""What it costs to cover cells with planes: residuals, and prices of faces, edges and lines.

A plane is a candidate for the cells near its points, and further away where nothing is seen. What two planes cost side
by side follows from their heights at the ends of the side, and is computed only when it is needed. So memory and time
grow with the number of cells and of candidates per cell, not with the number of all planes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from p2wss.fit.planes.arrangement import Arrangement
from p2wss.fit.settings import PlanePrices
from p2wss.skeleton.compiled import allocating, both, entry, inner
from p2wss.skeleton.groups import grouped, groups
from p2wss.skeleton.nearest import nearest
from p2wss.skeleton.ordering import order_of
from p2wss.skeleton.types import distinct, numbered, writable

# metres above the ground: a lower roof is forbidden; cubic metres: its price, beyond all others
_LOWEST_M, FORBIDDEN_M3 = 0.3, 1e4
# a plane is a candidate within this distance of its points, in multiples of the distance within which planes have a
# border, plus ``_UNSEEN_REACH`` times the distance to the nearest point; at most so many planes, the nearest ones
_REACH, _MAX_CANDIDATES = 2.0, 32
_UNSEEN_REACH = 2.0
# metres: the longest side of the square over which a point counts; the middles of the quarters of a square
_LONGEST_M = 1.0
_QUARTERS = np.array([(-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25)])


class Problem(NamedTuple):
    """Cells, their candidates, and the sides between cells, for compiled code.

    A *candidate* is a pair of a cell and a plane. Cell c has the candidates ``first[c]:first[c + 1]``, planes
    ascending; plane p has ``by_plane[plane_first[p]:plane_first[p + 1]]``. A choice, int (c,), is a candidate of each
    cell.

    number, of_cell, cell_m3: (n,), plane, cell and cost of each candidate. num_free: the number of cells that may
    change, which are the first; each further cell stands for a face around these. pair: (s, 2), the cells side by side.
    side_end: (2 s,), the sides by cell; cell c has ``side_first[c]:side_first[c + 1]``. An element is the number of a
    side, plus s if c is the second cell of that side. line, length_m: (s,), the line and the length of each side.
    end_m: (s, 2, 2), ends of sides. plane: (k, 3). is_known: (k,), whether a plane is of a known roof. outside_m: (l,),
    the length of the steps that a line has elsewhere. is_barred: (l,), whether steps on a line are forbidden.
    """

    first: np.ndarray
    number: np.ndarray
    of_cell: np.ndarray
    cell_m3: np.ndarray
    plane_first: np.ndarray
    by_plane: np.ndarray
    num_free: int
    pair: np.ndarray
    side_first: np.ndarray
    side_end: np.ndarray
    line: np.ndarray
    length_m: np.ndarray
    end_m: np.ndarray
    plane: np.ndarray
    is_known: np.ndarray
    outside_m: np.ndarray
    is_barred: np.ndarray


@dataclass(frozen=True)
class Costs:
    """What planes over cells cost, cubic metres. middle_m: (c, 2), a place within each cell."""

    problem: Problem
    prices: PlanePrices
    middle_m: np.ndarray

    def total_m3(self, label: np.ndarray) -> float:
        """The cost of planes ``label`` (c,) over the cells. Each that is no candidate of its cell costs more than all
        else."""
        chosen = np.flatnonzero(self.problem.number == np.asarray(label)[self.problem.of_cell])
        choice = np.zeros(len(label), np.int64)
        choice[self.problem.of_cell[chosen]] = chosen
        of_candidates_m3 = float(total_m3(self.problem, self.prices, choice))
        return of_candidates_m3 + FORBIDDEN_M3 * (len(label) - len(chosen))

    def change_m3(self, label: np.ndarray, cell: int, number: int) -> float:
        """What it costs to give a cell the plane ``number``, without the prices of faces and lines."""
        return float(
            _change_m3(self.problem, self.prices, np.asarray(label, np.int64), int(cell), int(number))
        )

    def faces(self, label: np.ndarray) -> np.ndarray:
        """int (c,): numbers of the connected faces."""
        pair = self.problem.pair
        return groups(len(label), pair[label[pair[:, 0]] == label[pair[:, 1]]])

    def bodies(self, label: np.ndarray) -> np.ndarray:
        """int (c,): the number of the body of each cell. Cells without a step between them are in one body."""
        is_step = _steps_of(self.problem, self.prices, np.asarray(label, np.int64))
        return groups(len(label), self.problem.pair[~is_step])


def costs_of(
    cells: Arrangement,
    plane: np.ndarray,
    point_m: np.ndarray,
    of_cell: np.ndarray,
    stands_m2: np.ndarray,
    prices: PlanePrices,
    candidates: tuple[np.ndarray, np.ndarray],
    num_known: int = 0,
) -> Costs:
    """The costs of covering cells with planes (k, 3). of_cell: (m,), the cell of each point (m, 3), -1 for none.
    stands_m2: (m,), the area that each point stands for. candidates: see :func:`candidates_of`. num_known: how many of
    the planes, the last ones, are of a known roof."""
    point_m, of_cell, stands_m2 = _spread(cells, point_m, of_cell, stands_m2)
    order = np.argsort(of_cell, kind="stable")
    order = order[np.searchsorted(of_cell[order], 0) :]
    begin = np.searchsorted(of_cell[order], np.arange(len(cells.area_m2) + 1))
    first, number = candidates
    seen = _Points(
        point_m[order], stands_m2[order], begin, float(point_m[:, 2].min()), float(point_m[:, 2].max())
    )
    vertex, vertex_first = cells.vertices
    area_m2 = writable(cells.area_m2, np.float64)
    cell_m3 = _cell_costs(
        first, number, writable(plane, np.float64), seen, area_m2, cells.xy_m[vertex], vertex_first, prices
    )
    is_shared = (cells.pair >= 0).all(axis=1)
    end_m = cells.xy_m[cells.side[is_shared]]
    return Costs(
        problem_of(
            first,
            number,
            np.asarray(cell_m3),
            cells.pair[is_shared],
            cells.line[is_shared],
            np.hypot(*(end_m[:, 1] - end_m[:, 0]).T),
            end_m,
            plane,
            np.arange(len(plane)) >= len(plane) - num_known,
        ),
        prices,
        cells.middle_m,
    )


def _spread(
    cells: Arrangement, point_m: np.ndarray, of_cell: np.ndarray, stands_m2: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points, their cells, the areas that they stand for). A point that stands for more than the area of its cell is
    replaced by four. Each is in the cell at the middle of a quarter of the square that the point stands for, which is
    at most 1 m wide, or in the cell of the point if that middle is outside. So no single point of a sparse cloud pays
    for a tower of the width of a hand."""
    is_wide = (of_cell >= 0) & (stands_m2 > cells.area_m2[of_cell])
    side_m = np.minimum(np.sqrt(stands_m2[is_wide, None, None]), _LONGEST_M)
    quarter_m = point_m[is_wide, None, :2] + side_m * _QUARTERS
    place = cells.cells_at(quarter_m.reshape(-1, 2))
    own, four_m, quarter_m2 = (
        np.repeat(each[is_wide], len(_QUARTERS), axis=0)
        for each in (of_cell, point_m, stands_m2 / len(_QUARTERS))
    )
    return (
        np.concatenate([point_m[~is_wide], four_m]),
        np.concatenate([of_cell[~is_wide], np.where(place < 0, own, place)]),
        np.concatenate([stands_m2[~is_wide], quarter_m2]),
    )


def problem_of(
    first: np.ndarray,
    number: np.ndarray,
    cell_m3: np.ndarray,
    pair: np.ndarray,
    line: np.ndarray,
    length_m: np.ndarray,
    end_m: np.ndarray,
    plane: np.ndarray,
    is_known: np.ndarray,
) -> Problem:
    """The :class:`Problem` of all cells of a roof, all of them free."""
    num_cells, num_lines = len(first) - 1, int(line.max(initial=-1)) + 1
    end = np.concatenate([pair[:, 0], pair[:, 1]])
    return Problem(
        first,
        number,
        np.repeat(np.arange(num_cells), np.diff(first)),
        cell_m3,
        np.searchsorted(np.sort(number), np.arange(len(plane) + 1)),
        np.argsort(number, kind="stable"),
        num_cells,
        writable(pair, np.int64),
        np.searchsorted(np.sort(end), np.arange(num_cells + 1)),
        np.argsort(end, kind="stable"),
        writable(line, np.int64),
        writable(length_m, np.float64),
        writable(end_m, np.float64),
        writable(plane, np.float64),
        is_known,
        np.zeros(num_lines),
        np.zeros(num_lines, bool),
    )


def candidates_of(
    cells: Arrangement,
    seen_m: np.ndarray,
    label: np.ndarray,
    point_m: np.ndarray,
    of_cell: np.ndarray,
    near_m: float,
) -> tuple[np.ndarray, np.ndarray]:
    """(first (c + 1,), number (n,)): the planes ``number[first[c]:first[c + 1]]``, ascending, may cover cell c.

    seen_m: (m, 2), places where planes are seen. label: (m,), the plane of each. point_m: (p, 2), points in the cells
    ``of_cell``, -1 for none. near_m: planes this near to each other have a border.

    Candidates are found for the squares of a grid. A cell gets the candidates of the squares of its middle, its
    corners and its points.
    """
    size_m = near_m / 2
    vertex, vertex_first = cells.vertices
    in_cell = of_cell >= 0
    place_m = np.concatenate([cells.middle_m, cells.xy_m[vertex], point_m[in_cell]])
    owner = np.concatenate(
        [
            np.arange(len(cells.middle_m)),
            np.repeat(np.arange(len(cells.middle_m)), np.diff(vertex_first)),
            of_cell[in_cell],
        ]
    )
    low_m = np.minimum(place_m.min(axis=0), seen_m.min(axis=0))
    shape = ((np.maximum(place_m.max(axis=0), seen_m.max(axis=0)) - low_m) / size_m).astype(int) + 1
    square = ((place_m - low_m) / size_m).astype(int) @ [shape[1], 1]
    seen_square = ((seen_m - low_m) / size_m).astype(int) @ [shape[1], 1]
    num_planes = int(label.max()) + 1
    seen = distinct(seen_square * num_planes + label)
    wanted, wanted_of = numbered(square)
    middle_m = low_m + size_m * (np.column_stack(np.divmod(wanted, shape[1])) + 0.5)
    to_seen_m = nearest(seen_m, middle_m)[0][:, 0]
    square_first, square_plane = _candidates_at(
        wanted,
        _REACH * near_m + _UNSEEN_REACH * to_seen_m,
        *np.divmod(seen, num_planes),
        shape,
        size_m,
        num_planes,
    )
    cell, part = np.divmod(distinct(owner * len(wanted) + wanted_of), len(wanted))
    size = np.diff(square_first)[part]
    row = np.arange(size.sum()) + np.repeat(square_first[part + 1] - np.cumsum(size), size)
    pairs = distinct(np.repeat(cell, size) * num_planes + square_plane[row])
    return np.searchsorted(pairs, num_planes * np.arange(len(cells.middle_m) + 1)), pairs % num_planes


@entry
def _candidates_at(
    wanted: np.ndarray,
    reach_m: np.ndarray,
    seen_square: np.ndarray,
    seen_plane: np.ndarray,
    shape: np.ndarray,
    size_m: float,
    num_planes: int,
) -> tuple[np.ndarray, np.ndarray]:
    """(first, planes): the planes ``first[k]:first[k + 1]`` are seen within reach of the wanted square k. If these are
    too many, they are the nearest. seen_square, seen_plane: the squares in which planes are seen, ascending, and the
    planes."""
    begin = np.searchsorted(seen_square, np.arange(shape[0] * shape[1] + 1))
    first, result, num = np.zeros(len(wanted) + 1, np.int64), np.empty(1024, np.int64), 0
    least_m, found = np.full(num_planes, np.inf), np.empty(num_planes, np.int64)
    for k, square in enumerate(wanted):
        row, column = square // shape[1], square % shape[1]
        span, num_found = int(reach_m[k] / size_m) + 1, 0
        for i in range(max(row - span, 0), min(row + span + 1, shape[0])):
            for j in range(max(column - span, 0), min(column + span + 1, shape[1])):
                away_m = size_m * np.sqrt((i - row) ** 2 + (j - column) ** 2)
                if away_m > reach_m[k]:
                    continue
                for t in range(begin[i * shape[1] + j], begin[i * shape[1] + j + 1]):
                    plane = seen_plane[t]
                    if least_m[plane] == np.inf:
                        found[num_found], num_found = plane, num_found + 1
                    least_m[plane] = min(least_m[plane], away_m)
        near = found[:num_found]
        if num_found > _MAX_CANDIDATES:
            near = near[order_of(least_m[near])][:_MAX_CANDIDATES]
        if num + len(near) > len(result):
            result = np.concatenate((result, np.empty_like(result)))
        result[num : num + len(near)], num = near, num + len(near)
        first[k + 1] = num
        least_m[found[:num_found]] = np.inf
    return first, result[:num].copy()


class _Points(NamedTuple):
    """Points, cell by cell. stands_m2: (m,), the area that each stands for. begin: (c + 1,), the first point of each
    cell. bottom_m, top_m: heights of the lowest and the highest of all points, with the points in no cell."""

    point_m: np.ndarray
    stands_m2: np.ndarray
    begin: np.ndarray
    bottom_m: float
    top_m: float


@entry
def _cell_costs(
    first: np.ndarray,
    number: np.ndarray,
    plane: np.ndarray,
    seen: _Points,
    area_m2: np.ndarray,
    corner_m: np.ndarray,
    corner_first: np.ndarray,
    prices: PlanePrices,
) -> np.ndarray:
    """(n,): what each candidate costs. corner_m: (v, 2), the corners of all cells, cell by cell. corner_first:
    (c + 1,), the first corner of each cell."""
    point_m, begin = seen.point_m, seen.begin
    result = np.zeros(len(number))
    for cell in range(len(area_m2)):
        for t in range(first[cell], first[cell + 1]):
            a, b, c = plane[number[t]]
            for k in range(begin[cell], begin[cell + 1]):
                off_m = abs(a * point_m[k, 0] + b * point_m[k, 1] + c - point_m[k, 2])
                result[t] += min(off_m, prices.cap_m) * seen.stands_m2[k]
            low_z, high_z = np.inf, -np.inf
            for k in range(corner_first[cell], corner_first[cell + 1]):
                z = a * corner_m[k, 0] + b * corner_m[k, 1] + c
                low_z, high_z = min(low_z, z), max(high_z, z)
            beyond_m = max(high_z - seen.top_m, seen.bottom_m - low_z) - prices.support_m
            result[t] += area_m2[cell] * min(max(beyond_m, 0.0), prices.cap_m)
            if low_z < _LOWEST_M:
                result[t] += FORBIDDEN_M3
    return result


@inner
def ends_apart_m(problem: Problem, side: int, one: int, other: int) -> tuple[float, float]:
    """The differences in height between two planes at the ends of a side."""
    end_m, plane = problem.end_m, problem.plane
    a, b = plane[one, 0] - plane[other, 0], plane[one, 1] - plane[other, 1]
    c = plane[one, 2] - plane[other, 2]
    first_m = abs(a * end_m[side, 0, 0] + b * end_m[side, 0, 1] + c)
    return first_m, abs(a * end_m[side, 1, 0] + b * end_m[side, 1, 1] + c)


@inner
def is_step(problem: Problem, prices: PlanePrices, side: int, one: int, other: int) -> bool:
    """Whether there is a step between two planes along a side."""
    first_m, last_m = ends_apart_m(problem, side, one, other)
    return one != other and max(first_m, last_m) >= prices.meet_m


@inner
def side_m3(problem: Problem, prices: PlanePrices, side: int, one: int, other: int) -> float:
    """What it costs to have one plane to the left and the other to the right of a side."""
    if one == other:
        return 0.0
    first_m, last_m = ends_apart_m(problem, side, one, other)
    share, barred_m3 = prices.meet_share, 0.0
    if max(first_m, last_m) >= prices.meet_m:
        share = prices.small_step_share if first_m + last_m < 2 * prices.small_step_m else 1.0
        barred_m3 = FORBIDDEN_M3 if problem.is_barred[problem.line[side]] else 0.0
    elif problem.is_known[one] and problem.is_known[other]:
        share = prices.known_share
    return prices.edge_m2 * problem.length_m[side] * share + barred_m3


@inner
def beside(problem: Problem, way: int) -> int:
    """The cell across a side. way: the element of ``side_end`` for the cell on this hand."""
    num_sides = len(problem.pair)
    return problem.pair[way, 1] if way < num_sides else problem.pair[way - num_sides, 0]


@entry
def _change_m3(problem: Problem, prices: PlanePrices, label: np.ndarray, cell: int, number: int) -> float:
    """:meth:`Costs.change_m3`."""
    old_m3 = new_m3 = FORBIDDEN_M3
    for t in range(problem.first[cell], problem.first[cell + 1]):
        if problem.number[t] == label[cell]:
            old_m3 = problem.cell_m3[t]
        if problem.number[t] == number:
            new_m3 = problem.cell_m3[t]
    for way in problem.side_end[problem.side_first[cell] : problem.side_first[cell + 1]]:
        side, theirs = way % len(problem.pair), label[beside(problem, way)]
        old_m3 += side_m3(problem, prices, side, label[cell], theirs)
        new_m3 += side_m3(problem, prices, side, number, theirs)
    return new_m3 - old_m3


@entry
def _steps_of(problem: Problem, prices: PlanePrices, label: np.ndarray) -> np.ndarray:
    """bool (s,): the sides with steps between planes over the cells."""
    result = np.zeros(len(problem.pair), np.bool_)
    for side, (one, other) in enumerate(problem.pair):
        result[side] = is_step(problem, prices, side, label[one], label[other])
    return result


@both
def total_m3(problem: Problem, prices: PlanePrices, choice: np.ndarray) -> float:
    """What a choice costs."""
    label, total = problem.number[choice], problem.cell_m3[choice].sum()
    for side, (one, other) in enumerate(problem.pair):
        total += side_m3(problem, prices, side, label[one], label[other])
    total += prices.face_m3 * (faces_of(problem, label).max() + 1)
    for length_m in steps_m(problem, prices, label):
        total += prices.line_m3 * min(length_m / prices.whole_line_m, 1.0)
    return total


@allocating
def steps_m(problem: Problem, prices: PlanePrices, label: np.ndarray) -> np.ndarray:
    """(l,): the length of the steps on each line."""
    result = problem.outside_m.copy()
    for side, (one, other) in enumerate(problem.pair):
        if is_step(problem, prices, side, label[one], label[other]):
            result[problem.line[side]] += problem.length_m[side]
    return result


@allocating
def faces_of(problem: Problem, label: np.ndarray) -> np.ndarray:
    """int (c,): numbers of the connected faces, in the order of their first cells."""
    link = problem.pair.copy()
    for side in range(len(link)):
        if label[link[side, 0]] != label[link[side, 1]]:
            link[side, 1] = link[side, 0]
    return grouped(len(label), link)
