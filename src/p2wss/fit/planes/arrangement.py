"""The cells into which lines divide a footprint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from p2wss.fit.directions import edge_ends
from p2wss.fit.planes.detection import heights
from p2wss.fit.planes.lines import Line, as_arrays, edges_of, ends_of
from p2wss.mesh.topology import reverses
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.types import cross, writable

# metres: coordinates of the arrangement are multiples of this
GRID_M = 1e-3
# how many pairs of a segment and a place are looked at together
_TOGETHER = 200_000
# the sine of the angle between segments that cross nowhere
_PARALLEL = 1e-9


@dataclass(frozen=True)
class Arrangement:
    """xy_m: (v, 2), vertices. middle_m: (c, 2), a place within each cell. area_m2: (c,). pair: int (s, 2), the cells to
    the left and to the right of each side, -1 outside the footprint. side: int (s, 2), its vertices. line: int (s,),
    its line. lines: the ``num_edges`` edges of the footprint, then those that divide it; vertices are on them to
    :data:`GRID_M`."""

    xy_m: np.ndarray
    middle_m: np.ndarray
    area_m2: np.ndarray
    pair: np.ndarray
    side: np.ndarray
    line: np.ndarray
    lines: Sequence[Line]
    num_edges: int

    def extremes(self, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The least and the greatest height of planes (k, 3) over each cell, each (c, k)."""
        low_z = np.full((len(self.area_m2), len(plane)), np.inf)
        high_z = -low_z
        for beside in self.pair.T:
            cell, end = beside[beside >= 0], self.side[beside >= 0]
            height_m = heights(plane, self.xy_m[end.ravel()]).reshape(len(end), 2, len(plane))
            np.minimum.at(low_z, cell, height_m.min(axis=1))
            np.maximum.at(high_z, cell, height_m.max(axis=1))
        return low_z, high_z

    def cells_at(self, xy_m: np.ndarray) -> np.ndarray:
        """int (m,), the cell at each place (m, 2), -1 outside."""
        end_m, pair = writable(self.xy_m[self.side], np.float64), writable(self.pair, np.int64)
        return np.asarray(_cells_below(writable(xy_m, np.float64), end_m, pair))


def arrange(rings: Sequence[np.ndarray], lines: Sequence[Line]) -> Arrangement:
    """The cells of a footprint."""
    own_lines = [line for line, _ in edges_of(rings)]
    polygon = shapely.Polygon(rings[0], rings[1:])
    shapely.prepare(polygon)
    low, high = np.array(polygon.bounds).reshape(2, 2)
    far_m = float(np.abs([low, high]).sum() + np.hypot(*(high - low)))
    piece_m = _pieces(np.concatenate([edge_ends(rings), ends_of(lines, far_m)]) / GRID_M) * GRID_M
    beside = ((piece_m < low - GRID_M) | (piece_m > high + GRID_M)).any(axis=(1, 2))
    drawn = np.asarray(shapely.linestrings(piece_m[~beside]), object)
    cells = shapely.get_parts(shapely.polygonize(drawn))
    middle = shapely.point_on_surface(cells)
    inside = shapely.contains(polygon, middle)
    cells, middle = shapely.orient_polygons(cells[inside]), middle[inside]
    # in the order of their places, so that nothing depends on the order of the lines
    order = np.lexsort(shapely.get_coordinates(middle).T)
    cells, middle = cells[order], middle[order]
    all_rings, owner = shapely.get_rings(cells, return_index=True)
    xy_m, ring_of = shapely.get_coordinates(all_rings, return_index=True)
    # in the order of their first and then their second coordinate; numpy is slow with rows
    _, first, vertex = np.unique(np.round(xy_m / GRID_M) @ [1, 1j], return_index=True, return_inverse=True)
    # the last place of a ring is its first
    is_start = np.diff(ring_of) == 0
    start, end, cell = vertex[:-1][is_start], vertex[1:][is_start], owner[ring_of[:-1][is_start]]
    back = reverses(start, end)
    once = np.flatnonzero((back < 0) | (start < end))
    pair = np.column_stack([cell, np.where(back < 0, -1, cell[back])])[once]
    vertex_m, side, all_lines = xy_m[first], np.column_stack([start, end])[once], [*own_lines, *lines]
    return Arrangement(
        vertex_m,
        shapely.get_coordinates(middle),
        shapely.area(cells),
        pair,
        side,
        furthest_m(vertex_m[side], *as_arrays(all_lines)).argmin(axis=1),
        all_lines,
        len(own_lines),
    )


def _pieces(end: np.ndarray) -> np.ndarray:
    """The pieces (p, 2, 2) of segments (s, 2, 2) from each place where one ends or two cross to the next, each once.

    By snap rounding (Hobby 1999, Practical segment intersection with finite precision output): places are rounded to
    integers, and a segment goes through all those whose square it touches. So pieces have no more than ends in common.
    GEOS, which can do the same, takes four times as long for a roof.
    """
    start, step = end[:, 0], end[:, 1] - end[:, 0]
    length = np.hypot(*step.T)[:, None]
    along, apart, found = step / length, start - start[:, None], []
    turn = cross(along[:, None], along)
    share = cross(apart, along) / np.where(np.abs(turn) < _PARALLEL, np.nan, turn * length)
    meets = (share >= 0) & (share <= 1)
    one, other = np.nonzero(np.triu(meets & meets.T))
    crossing = start[one] + share[one, other, None] * step[one]
    node = np.unique(np.rint(np.concatenate([*end, crossing])) @ [1, 1j])
    place = np.column_stack([node.real, node.imag])
    # half of what a square measures across a segment
    half = np.abs(along).sum(axis=1, keepdims=True) / 2
    for some in np.array_split(np.arange(len(end)), 1 + len(end) * len(place) // _TOGETHER):
        from_start = place - start[some, None]
        at = (from_start @ along[some, :, None])[..., 0]
        is_at = (np.abs(at - length[some] / 2) <= length[some] / 2 + half[some]) & (
            np.abs(cross(from_start, along[some, None])) <= half[some]
        )
        segment, number = np.nonzero(is_at)
        order = np.lexsort((at[is_at], segment))
        segment, number = segment[order], number[order]
        link = np.column_stack([number[:-1], number[1:]])[np.diff(segment) == 0]
        found.append(np.sort(link, axis=1) @ [len(place), 1])
    pairs = np.unique(np.concatenate(found))
    return place[np.column_stack(np.divmod(pairs, len(place)))]


@entry
def _cells_below(xy_m: np.ndarray, end_m: np.ndarray, pair: np.ndarray) -> np.ndarray:
    """The cell (m,) below the side next above each place (m, 2), -1 outside. end_m: (s, 2, 2), the ends of sides. pair:
    (s, 2), the cells to their left and right."""
    result = np.full(len(xy_m), -1)
    for i in range(len(xy_m)):
        # no vertex has such a coordinate
        x, nearest_m = xy_m[i, 0] + GRID_M / 2, np.inf
        for k in range(len(pair)):
            (from_x, from_y), (to_x, to_y) = end_m[k]
            if (from_x < x) != (to_x < x):
                above_m = from_y + (to_y - from_y) * (x - from_x) / (to_x - from_x) - xy_m[i, 1]
                if 0 <= above_m < nearest_m:
                    nearest_m, result[i] = above_m, pair[k, 1 if from_x < x else 0]
    return result


def furthest_m(end_m: np.ndarray, normal: np.ndarray, offset_m: np.ndarray) -> np.ndarray:
    """How far the further end of each piece (s, 2, 2) is from each line (:func:`as_arrays`), (s, l)."""
    return np.asarray(np.abs(end_m @ normal.T - offset_m).max(axis=1))
