"""The cells into which lines divide a footprint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from p2wss.fit.directions import edge_ends
from p2wss.fit.planes.lines import Line, edges_of, ends_of
from p2wss.fit.planes.ring_kernels import rings_around
from p2wss.mesh.topology import reverses
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.ordering import order_of
from p2wss.skeleton.types import distinct, next_in_ring, numbered, writable

# metres: coordinates of the arrangement are multiples of this
GRID_M = 1e-3
# multiples of the grid: the width of columns in which places are sought
_STRIP = 1000.0
# multiples of the grid: rounding of places that are on the border of a square
_TOUCH = 1e-6
# the sine of the angle between segments that cross nowhere
_PARALLEL = 1e-9


@dataclass(frozen=True)
class Arrangement:
    """xy_m: (v, 2), vertices. middle_m: (c, 2), a place within each cell. area_m2: (c,). pair: int (s, 2), the cells to
    the left and to the right of each side, -1 outside the footprint. side: int (s, 2), the vertices of each side. line:
    int (s,), the line of each side. lines: the ``num_edges`` edges of the footprint, then the lines that divide it;
    vertices are on them to :data:`GRID_M`."""

    xy_m: np.ndarray
    middle_m: np.ndarray
    area_m2: np.ndarray
    pair: np.ndarray
    side: np.ndarray
    line: np.ndarray
    lines: Sequence[Line]
    num_edges: int

    @cached_property
    def vertices(self) -> tuple[np.ndarray, np.ndarray]:
        """(vertices of all cells, cell by cell, each one twice or more; the first of each cell, (c + 1,))."""
        owner, vertex = np.tile(self.pair.T.ravel(), 2), self.side.T.repeat(2, axis=0).ravel()
        order = np.argsort(owner, kind="stable")
        order = order[np.searchsorted(owner[order], 0) :]
        return vertex[order], np.searchsorted(owner[order], np.arange(len(self.area_m2) + 1))

    def cells_at(self, xy_m: np.ndarray) -> np.ndarray:
        """int (m,), the cell at each place (m, 2), -1 outside."""
        end_m, pair = writable(self.xy_m[self.side], np.float64), writable(self.pair, np.int64)
        return np.asarray(_cells_below(writable(xy_m, np.float64), end_m, pair))


class TooManyPlacesError(ValueError):
    """Lines end or cross in more places than may be."""


def arrange(
    rings: Sequence[np.ndarray], lines: Sequence[Line], max_num_places: float = np.inf
) -> Arrangement:
    """The cells into which lines divide a footprint. Raises :class:`TooManyPlacesError` if lines end or cross in more
    than ``max_num_places`` places."""
    polygon = shapely.Polygon(rings[0], rings[1:])
    shapely.prepare(polygon)
    low, high = np.array(polygon.bounds).reshape(2, 2)
    far_m = float(np.abs([low, high]).sum() + np.hypot(*(high - low)))
    # lines that end before the footprint are of roofs around it
    lines = [line for line in lines if line.low_m < far_m and line.high_m > -far_m]
    own_lines = [line for line, _ in edges_of(rings)]
    all_lines = [*own_lines, *lines]
    # an edge of the footprint and what goes on beyond it are one line
    first: dict[tuple[float, ...], int] = {}
    same = np.array([first.setdefault((*each.normal, each.offset_m), k) for k, each in enumerate(all_lines)])
    end_m = np.concatenate([edge_ends(rings), ends_of(lines, far_m)])
    place, link, line = _pieces(end_m / GRID_M, max_num_places)
    place_m = place * GRID_M
    is_beside = np.any((place_m < low - GRID_M) | (place_m > high + GRID_M), axis=1)
    is_drawn = ~is_beside[link].any(axis=1)
    link, line = link[is_drawn], line[is_drawn]
    corner, size, doubled_m2 = _rings_between(place_m, link)
    ring = np.repeat(np.arange(len(size)), size)
    outline = np.asarray(shapely.linearrings(place_m[corner], indices=ring), object)
    is_hole, of_cell = doubled_m2 < 0, _cells_around(outline, doubled_m2)
    order = np.lexsort((is_hole, of_cell))
    order = order[of_cell[order] >= 0]
    cells = np.asarray(shapely.polygons(outline[order], indices=np.cumsum(~is_hole[order]) - 1), object)
    middle = shapely.point_on_surface(cells)
    inside = np.flatnonzero(shapely.contains(polygon, middle))
    # in the order of their places, so that nothing depends on the order of the lines
    inside = inside[np.lexsort(shapely.get_coordinates(middle[inside]).T)]
    rank = np.full(len(size) + 1, -1)
    rank[order[~is_hole[order]][inside]] = np.arange(len(inside))
    cell, after = rank[of_cell[ring]], corner[next_in_ring(np.cumsum([0, *size]))]
    # sides sorted by cell, without the outside
    rows = np.argsort(cell, kind="stable")
    rows = rows[np.searchsorted(cell[rows], 0) :]
    used, start = numbered(corner[rows])
    end, cell = np.searchsorted(used, after[rows]), cell[rows]
    back = reverses(start, end)
    once = np.flatnonzero((back < 0) | (start < end))
    side = np.column_stack([start, end])[once]
    of_piece = np.searchsorted(link @ [len(place), 1], np.sort(used[side], axis=1) @ [len(place), 1])
    return Arrangement(
        place_m[used],
        shapely.get_coordinates(middle[inside]),
        shapely.area(cells[inside]),
        np.column_stack([cell, np.where(back < 0, -1, cell[back])])[once],
        side,
        same[line[of_piece]],
        all_lines,
        len(own_lines),
    )


@entry
def _rings_between(place_m: np.ndarray, link: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(places (k,) of the rings of the faces between links, ring after ring; the length of each ring, (r,); twice its
    area, (r,), negative for a ring around cells). place_m: (v, 2). link: (p, 2), places. A face is to the left of its
    ring."""
    num = len(link)
    vertex_m, half = np.zeros((len(place_m), 3)), np.empty((2 * num, 2), np.int64)
    vertex_m[:, :2], half[:num], half[num:] = place_m, link, link[:, ::-1]
    ring, size, _, doubled_m2 = rings_around(
        vertex_m, half, np.zeros(2 * num, np.int64), np.eye(3)[:2].copy().reshape(1, 2, 3)
    )
    return ring, size, doubled_m2


def _cells_around(outline: np.ndarray, doubled_m2: np.ndarray) -> np.ndarray:
    """int (r,): for each ring, the outer ring of the cell that it borders. A ring around cells borders the smallest
    cell around it, or none, -1."""
    result = np.where(doubled_m2 < 0, -1, np.arange(len(outline)))
    hole, cell = np.flatnonzero(doubled_m2 < 0), np.flatnonzero(doubled_m2 >= 0)
    if len(hole) > 1:
        polygon = np.asarray(shapely.polygons(outline), object)
        at, around = shapely.STRtree(polygon[cell]).query(
            shapely.point_on_surface(polygon[hole]), predicate="within"
        )
        at, around = hole[at], cell[around]
        # not a cell within the hole; of the cells around it, the smallest, which comes last
        is_larger = doubled_m2[around] > -doubled_m2[at] * (1 + _TOUCH)
        at, around = at[is_larger], around[is_larger]
        order = np.argsort(-doubled_m2[around], kind="stable")
        result[at[order]] = around[order]
    return result


def _pieces(end: np.ndarray, max_num_places: float = np.inf) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(places (v, 2), by their first and then their second coordinate; the two places of each piece, (p, 2), ascending;
    the segment that each piece is nearest to, (p,)).

    Segments (s, 2, 2) are cut where one ends or two cross. A piece goes from one such place to the next; pieces of
    several segments between the same places are one.

    By snap rounding (Hobby 1999, Practical segment intersection with finite precision output): places are rounded to
    integers, and a segment goes through every place whose square it touches. So pieces have no more than ends in
    common. GEOS, which can do the same, takes four times as long for a roof.
    """
    start, step = writable(end[:, 0], np.float64), writable(end[:, 1] - end[:, 0], np.float64)
    along = step / np.hypot(*step.T)[:, None]
    node = distinct(np.rint(np.concatenate([*end, _crossings(start, step, along)])) @ [1, 1j])
    # before the search for the places that segments pass through, which are many more
    if len(node) > max_num_places:
        raise TooManyPlacesError
    place = np.column_stack([node.real, node.imag])
    segment, number, at, off = _passed(start, step, along, place)
    order = np.lexsort((number, at, segment))
    segment, number, off = segment[order], number[order], off[order]
    is_next = np.diff(segment) == 0
    link = np.sort(np.column_stack([number[:-1], number[1:]])[is_next], axis=1)
    pair = link @ [len(place), 1]
    best = np.lexsort((segment[:-1][is_next], np.maximum(off[:-1], off[1:])[is_next], pair))
    best = best[np.append(True, np.diff(pair[best]) > 0)]
    return place, link[best], segment[:-1][is_next][best]


@entry
def _crossings(start: np.ndarray, step: np.ndarray, along: np.ndarray) -> np.ndarray:
    """The places (k, 2) where segments (s, 2) cross."""
    low, high = (
        np.minimum(start[:, 0], start[:, 0] + step[:, 0]),
        np.maximum(start[:, 0], start[:, 0] + step[:, 0]),
    )
    result, num, order = np.empty((1024, 2)), 0, order_of(low)
    for t in range(len(order)):
        for u in range(t + 1, len(order)):
            if low[order[u]] > high[order[t]]:
                break
            i, j = min(order[t], order[u]), max(order[t], order[u])
            turn = along[i, 0] * along[j, 1] - along[i, 1] * along[j, 0]
            if abs(turn) < _PARALLEL:
                continue
            x, y = start[j, 0] - start[i, 0], start[j, 1] - start[i, 1]
            share = (x * along[j, 1] - y * along[j, 0]) / turn
            other = (x * along[i, 1] - y * along[i, 0]) / turn
            one_m = np.hypot(step[i, 0], step[i, 1])
            if 0.0 <= share <= one_m and 0.0 <= other <= np.hypot(step[j, 0], step[j, 1]):
                if num == len(result):
                    result = np.concatenate((result, np.empty_like(result)))
                result[num] = start[i] + share / one_m * step[i]
                num += 1
    return result[:num].copy()


@entry
def _passed(
    start: np.ndarray, step: np.ndarray, along: np.ndarray, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(segment, place, distance along the segment, distance beside it), each (n,): a segment passes through a place if
    it touches the square of size 1 around it. place: (v, 2), ascending in the first coordinate."""
    left = place[:, 0].min()
    num_columns = int((place[:, 0].max() - left) / _STRIP) + 1
    # columns of a grid, and the places of each by their second coordinate
    begin = np.searchsorted(place[:, 0], left + _STRIP * np.arange(num_columns + 1))
    order = np.arange(len(place))
    for column in range(num_columns):
        own = order[begin[column] : begin[column + 1]]
        own[:] = own[order_of(place[own, 1])]
    height = place[order, 1]
    segment, number, num = np.empty(1024, np.int64), np.empty(1024, np.int64), 0
    at, off = np.empty(1024), np.empty(1024)
    for i in range(len(start)):
        # a segment between two rows of squares touches both
        length, half = np.hypot(step[i, 0], step[i, 1]), (abs(along[i, 0]) + abs(along[i, 1])) / 2 + _TOUCH
        from_x = min(start[i, 0], start[i, 0] + step[i, 0]) - 1.0
        to_x = max(start[i, 0], start[i, 0] + step[i, 0]) + 1.0
        first, last = (
            int(max((from_x - left) / _STRIP, 0.0)),
            int(min((to_x - left) / _STRIP, num_columns - 1.0)),
        )
        for column in range(first, last + 1):
            # how far along the segment this column begins and ends
            one, other = 0.0, length
            if abs(along[i, 0]) > _PARALLEL:
                one = (left + column * _STRIP - 1.0 - start[i, 0]) / along[i, 0]
                other = (left + (column + 1) * _STRIP + 1.0 - start[i, 0]) / along[i, 0]
            one_y = start[i, 1] + min(max(one, 0.0), length) * along[i, 1]
            other_y = start[i, 1] + min(max(other, 0.0), length) * along[i, 1]
            k = begin[column] + np.searchsorted(
                height[begin[column] : begin[column + 1]], min(one_y, other_y) - 1.0
            )
            while k < begin[column + 1] and height[k] <= max(one_y, other_y) + 1.0:
                x, y = place[order[k], 0] - start[i, 0], place[order[k], 1] - start[i, 1]
                way, beside = x * along[i, 0] + y * along[i, 1], abs(x * along[i, 1] - y * along[i, 0])
                if abs(way - length / 2) <= length / 2 + half and beside <= half:
                    if num == len(segment):
                        segment = np.concatenate((segment, np.empty_like(segment)))
                        number = np.concatenate((number, np.empty_like(number)))
                        at, off = (
                            np.concatenate((at, np.empty_like(at))),
                            np.concatenate((off, np.empty_like(off))),
                        )
                    segment[num], number[num], at[num], off[num] = i, order[k], way, beside
                    num += 1
                k += 1
    return segment[:num].copy(), number[:num].copy(), at[:num].copy(), off[:num].copy()


def by_member(group: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """A function that returns, for an array of members, the groups with one of them, ascending. group: (n, 2), the
    members of each group, such as the two cells beside each side."""
    member = group.ravel()
    order = np.argsort(member, kind="stable")
    begin = np.searchsorted(member[order], np.arange(member.max(initial=-1) + 2))
    return lambda numbers: distinct(np.concatenate([order[begin[k] : begin[k + 1]] for k in numbers]) // 2)


@entry
def _cells_below(xy_m: np.ndarray, end_m: np.ndarray, pair: np.ndarray) -> np.ndarray:
    """int (m,): the cell at each place (m, 2), -1 outside; it is the cell below the first side above the place. end_m:
    (s, 2, 2), the ends of sides. pair: (s, 2), the cells to their left and right."""
    result = np.full(len(xy_m), -1)
    left, right = np.minimum(end_m[:, 0, 0], end_m[:, 1, 0]), np.maximum(end_m[:, 0, 0], end_m[:, 1, 0])
    top = np.maximum(end_m[:, 0, 1], end_m[:, 1, 1])
    # the sides of each column of a grid, by their upper ends
    from_x, num_columns = left.min(), int(len(pair) ** 0.5) + 1
    width_m = (right.max() - from_x) / num_columns * (1 + 1e-9) + GRID_M
    begin, tallest_m = np.zeros(num_columns + 1, np.int64), np.zeros(num_columns)
    for k in range(len(pair)):
        height_m = abs(end_m[k, 0, 1] - end_m[k, 1, 1])
        for column in range(int((left[k] - from_x) / width_m), int((right[k] - from_x) / width_m) + 1):
            begin[column + 1] += 1
            tallest_m[column] = max(tallest_m[column], height_m)
    begin = np.cumsum(begin)
    free, member = begin.copy(), np.empty(begin[-1], np.int64)
    for k in order_of(top):
        for column in range(int((left[k] - from_x) / width_m), int((right[k] - from_x) / width_m) + 1):
            member[free[column]] = k
            free[column] += 1
    upper = top[member]
    for i in range(len(xy_m)):
        # no vertex has such a coordinate
        x, nearest_m = xy_m[i, 0] + GRID_M / 2, np.inf
        column = int((x - from_x) // width_m)
        if column < 0 or column >= num_columns:
            continue
        start = begin[column] + np.searchsorted(upper[begin[column] : begin[column + 1]], xy_m[i, 1])
        for k in member[start : begin[column + 1]]:
            if top[k] - tallest_m[column] > xy_m[i, 1] + nearest_m:
                break
            (start_x, start_y), (to_x, to_y) = end_m[k]
            if (start_x < x) != (to_x < x):
                above_m = start_y + (to_y - start_y) * (x - start_x) / (to_x - start_x) - xy_m[i, 1]
                if 0 <= above_m < nearest_m:
                    nearest_m, result[i] = above_m, pair[k, 1 if start_x < x else 0]
    return result
