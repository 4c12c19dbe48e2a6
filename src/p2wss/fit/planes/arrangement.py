"""The cells into which lines divide a footprint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from p2wss.fit.planes.detection import heights
from p2wss.fit.planes.lines import Line, as_arrays, edges_of, ends_of
from p2wss.mesh.topology import reverses

# metres: coordinates of the arrangement are multiples of this
GRID_M = 1e-3


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
    tree: shapely.STRtree
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
        place, cell = self.tree.query(shapely.points(xy_m), predicate="intersects")
        result = np.full(len(xy_m), -1)
        # a place on a side belongs to the cell with the smaller number
        result[place[::-1]] = cell[::-1]
        return result


def arrange(rings: Sequence[np.ndarray], lines: Sequence[Line]) -> Arrangement:
    """The cells of a footprint."""
    edges = [edge for edge, _ in edges_of(rings)]
    polygon = shapely.Polygon(rings[0], rings[1:])
    shapely.prepare(polygon)
    low, high = np.array(polygon.bounds).reshape(2, 2)
    far_m = float(np.abs([low, high]).sum() + np.hypot(*(high - low)))
    drawn = np.asarray(shapely.linestrings(ends_of(lines, far_m)), object)
    network = shapely.union_all([polygon.boundary, *drawn], grid_size=GRID_M)
    cells = shapely.get_parts(shapely.polygonize(shapely.get_parts(network)))
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
    vertex_m, side, all_lines = xy_m[first], np.column_stack([start, end])[once], [*edges, *lines]
    return Arrangement(
        vertex_m,
        shapely.get_coordinates(middle),
        shapely.area(cells),
        pair,
        side,
        furthest_m(vertex_m[side], *as_arrays(all_lines)).argmin(axis=1),
        shapely.STRtree(cells),
        all_lines,
        len(edges),
    )


def furthest_m(end_m: np.ndarray, normal: np.ndarray, offset_m: np.ndarray) -> np.ndarray:
    """How far the further end of each piece (s, 2, 2) is from each line (:func:`as_arrays`), (s, l)."""
    return np.asarray(np.abs(end_m @ normal.T - offset_m).max(axis=1))
