"""Crop points by footprints, with the exact distance of each point to each polygon nearby.

A point belongs to a polygon if it is inside, or at most the buffer away; a courtyard is outside. A point may belong
to several polygons. Distances are computed as in GEOS, so that the result equals that of ``shapely.dwithin``, ties
included.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
import shapely

from p2wss.skeleton.compiled import ZERO, entry, inlined, inner
from p2wss.skeleton.ordering import median, sorted_by
from p2wss.skeleton.rings import crosses
from p2wss.skeleton.types import Polygons

_CELL_M = 4.0
_MAX_CELLS = 1 << 22


class _Grid(NamedTuple):
    """Square cells from (low_x_m, low_y_m) on."""

    low_x_m: float
    low_y_m: float
    cell_m: float
    columns: int
    rows: int


class _Sorted(NamedTuple):
    """Points sorted by cell, row by row. Only cells that a polygon needs have a number, from 1 on: the cell with the
    number c has the points ``start[c - 1]:start[c]``. number: int32 (rows, columns), 0 for cells that no polygon needs.
    order: indices of the points. x, y: float64, coordinates in this order."""

    number: np.ndarray
    start: np.ndarray
    order: np.ndarray
    x: np.ndarray
    y: np.ndarray


def crop_points(
    x_m: np.ndarray,
    y_m: np.ndarray,
    polygons: Polygons,
    buffer_m: float,
    among: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points inside or within ``buffer_m`` of each polygon, as pairs of a polygon and a point.

    x_m, y_m: float64 (num_points,), in the coordinates of ``polygons``. among: bool (num_points,), mask of the
    points to consider; None for all.

    Returns (point, inside, offset). point: int32 (num_pairs,), index of the point. inside: bool (num_pairs,), false
    for a point in the buffer. offset: int64 (num_polygons + 1,), polygon p has the pairs ``offset[p]:offset[p + 1]``,
    in an order that depends only on the points and the polygons.
    """
    count = len(polygons)
    if not len(polygons.xy_m) or not len(x_m):
        return np.zeros(0, np.int32), np.zeros(0, bool), np.zeros(count + 1, np.int64)
    low = polygons.xy_m.min(axis=0) - buffer_m
    extent = polygons.xy_m.max(axis=0) + buffer_m - low
    cell_m = max(_CELL_M, sqrt(float(extent[0] * extent[1]) / _MAX_CELLS))
    if cell_m > _CELL_M:
        axis = int(extent.argmax())
        is_present = np.diff(polygons.vertex_offset) > 0
        first_m = polygons.xy_m[np.minimum(polygons.vertex_offset[:-1], len(polygons.xy_m) - 1), axis]
        is_far = is_present & (first_m > low[axis] + extent[axis] / 2)
        if is_far.any() and (is_present & ~is_far).any():
            return _in_halves(x_m, y_m, polygons, buffer_m, among, is_far)
    columns, rows = (int(length / cell_m) + 1 for length in extent)
    grid = _Grid(float(low[0]), float(low[1]), cell_m, columns, rows)
    boxes = _cell_boxes(polygons.xy_m, polygons.vertex_offset, grid, buffer_m)
    cells = _sort_points(x_m, y_m, grid, boxes, np.zeros(0, bool) if among is None else among)
    rings = polygons.xy_m, polygons.ring_offset, polygons.polygon_offset
    return _crop(cells, grid, boxes, rings, float(buffer_m))


def _in_halves(
    x_m: np.ndarray,
    y_m: np.ndarray,
    polygons: Polygons,
    buffer_m: float,
    among: np.ndarray | None,
    is_far: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The result of :func:`crop_points`, first for the polygons that are not ``is_far``, then for those that are.

    With one grid around distant groups of polygons, cells would be so large that each polygon of a town is compared
    with all points of the town.
    """
    pieces = []
    for rows in (np.flatnonzero(~is_far), np.flatnonzero(is_far)):
        some = Polygons.from_rings([polygons.rings(row) for row in rows.tolist()])
        # a metre more, in case of rounding
        low, high = some.xy_m.min(axis=0) - buffer_m - 1, some.xy_m.max(axis=0) + buffer_m + 1
        near = np.flatnonzero((x_m >= low[0]) & (x_m <= high[0]) & (y_m >= low[1]) & (y_m <= high[1]))
        chosen = None if among is None else among[near]
        point, inside, offset = crop_points(x_m[near], y_m[near], some, buffer_m, chosen)
        pieces.append((np.repeat(rows, np.diff(offset)), near[point].astype(np.int32), inside))
    polygon, point, inside = (np.concatenate(each) for each in zip(*pieces, strict=True))
    order = np.argsort(polygon, kind="stable")
    offset = np.searchsorted(polygon[order], np.arange(len(polygons) + 1))
    return point[order], inside[order], offset


def _cell_boxes(xy: np.ndarray, vertex_offset: np.ndarray, grid: _Grid, buffer_m: float) -> np.ndarray:
    """First and last column and row of the cells around each polygon, int64 (num_polygons, 4).

    (0, -1, 0, -1) for a polygon without vertices.
    """
    boxes, is_present = np.tile([0, -1, 0, -1], (len(vertex_offset) - 1, 1)), np.diff(vertex_offset) > 0
    first, low_m = vertex_offset[:-1][is_present], np.array([grid.low_x_m, grid.low_y_m])
    from_m, to_m = np.minimum.reduceat(xy, first) - buffer_m, np.maximum.reduceat(xy, first) + buffer_m
    low, high = (((each - low_m) / grid.cell_m).astype(np.int64) for each in (from_m, to_m))
    boxes[is_present, ::2] = np.maximum(low, 0)
    boxes[is_present, 1::2] = np.minimum(high, [grid.columns - 1, grid.rows - 1])
    return boxes


@entry
def _sort_points(x: np.ndarray, y: np.ndarray, grid: _Grid, boxes: np.ndarray, among: np.ndarray) -> _Sorted:
    """Counting sort of the points by cell, row by row, without the points in cells that no polygon needs.

    among: bool (num_points,), mask of the points to consider; empty for all.
    """
    rows, columns = grid.rows, grid.columns
    # only cells near a polygon get a number: a valley has few houses and many cells
    number = np.zeros((rows, columns), np.int32)
    for p in range(len(boxes)):
        for row in range(boxes[p, 2], boxes[p, 3] + 1):
            for column in range(boxes[p, 0], boxes[p, 1] + 1):
                number[row, column] = 1
    num_cells = ZERO
    for row in range(rows):
        for column in range(columns):
            if number[row, column]:
                num_cells += 1
                number[row, column] = num_cells
    cell = np.full(len(x), -1)
    for i in range(len(x)):
        if len(among) and not among[i]:
            continue
        u, v = (x[i] - grid.low_x_m) / grid.cell_m, (y[i] - grid.low_y_m) / grid.cell_m
        if 0 <= u < columns and 0 <= v < rows and number[int(v), int(u)]:
            cell[i] = number[int(v), int(u)] - 1
    start, order = sorted_by(cell, num_cells)
    return _Sorted(number, start, order, x[order], y[order])


@entry
def _crop(
    cells: _Sorted,
    grid: _Grid,
    boxes: np.ndarray,
    rings: tuple[np.ndarray, np.ndarray, np.ndarray],
    buffer_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What :func:`crop_points` returns. rings: the arrays of :class:`Polygons`."""
    number, start, order, x, y = cells
    xy, ring_offset, polygon_offset = rings
    num_polygons = len(polygon_offset) - 1
    room, most_edges = 0, 1
    for p in range(num_polygons):
        for row in range(boxes[p, 2], boxes[p, 3] + 1):
            room += start[number[row, boxes[p, 1]]] - start[number[row, boxes[p, 0]] - 1]
        most_edges = max(most_edges, ring_offset[polygon_offset[p + 1]] - ring_offset[polygon_offset[p]])
    point, inside = np.empty(room, np.int32), np.empty(room, np.bool_)
    offset = np.zeros(num_polygons + 1, np.int64)
    edge = np.empty((most_edges, 4))  # ends of the edges that reach the row of cells: ax, ay, bx, by
    n = 0
    for p in range(num_polygons):
        for row in range(boxes[p, 2], boxes[p, 3] + 1):
            first, last = start[number[row, boxes[p, 0]] - 1], start[number[row, boxes[p, 1]]]
            if first == last:
                continue
            # one cell more than needed on each side, in case of rounding at the borders of cells
            y_min = grid.low_y_m + (row - 1) * grid.cell_m - buffer_m
            y_max = grid.low_y_m + (row + 2) * grid.cell_m + buffer_m
            num_edges = 0
            for ring in range(polygon_offset[p], polygon_offset[p + 1]):
                before = ring_offset[ring + 1] - 1
                for here in range(ring_offset[ring], ring_offset[ring + 1]):
                    ay, by = xy[before, 1], xy[here, 1]
                    if max(ay, by) >= y_min and min(ay, by) <= y_max:
                        edge[num_edges, 0], edge[num_edges, 1] = xy[before, 0], ay
                        edge[num_edges, 2], edge[num_edges, 3] = xy[here, 0], by
                        num_edges += 1
                    before = here
            for k in range(first, last):
                within, near = _locate(x[k], y[k], edge, num_edges, buffer_m)
                if within or near:
                    point[n], inside[n] = order[k], within
                    n += 1
        offset[p + 1] = n
    return point[:n].copy(), inside[:n].copy(), offset


@inlined
def _locate(px: float, py: float, edge: np.ndarray, num_edges: int, buffer_m: float) -> tuple[bool, bool]:
    """Whether the point is inside (even-odd rule), and whether it is within the buffer of an edge."""
    inside, near = False, False
    for i in range(num_edges):
        ax, ay, bx, by = edge[i, 0], edge[i, 1], edge[i, 2], edge[i, 3]
        if crosses(ax, ay, bx, by, px, py):
            inside = not inside
        if (
            not near
            and min(ax, bx) - buffer_m <= px <= max(ax, bx) + buffer_m
            and min(ay, by) - buffer_m <= py <= max(ay, by) + buffer_m
        ):
            near = _distance(px, py, ax, ay, bx, by) <= buffer_m
    return inside, near


@inner
def _distance(px: float, py: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Distance from a point to a segment, in the operations of GEOS (``Distance::pointToSegment``)."""
    length2 = (bx - ax) * (bx - ax) + (by - ay) * (by - ay)
    if length2 == 0:
        return sqrt((px - ax) ** 2 + (py - ay) ** 2)
    along = ((px - ax) * (bx - ax) + (py - ay) * (by - ay)) / length2
    if along <= 0:
        return sqrt((px - ax) ** 2 + (py - ay) ** 2)
    if along >= 1:
        return sqrt((px - bx) ** 2 + (py - by) ** 2)
    return abs(((ay - py) * (bx - ax) - (ax - px) * (by - ay)) / length2) * sqrt(length2)


@entry
def ring_medians(
    value: np.ndarray, among: np.ndarray, point: np.ndarray, inside: np.ndarray, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Number (int64) and median of ``value`` (NaN without any) of the points in the buffer of each polygon.

    among: bool (num_points,), mask of the points that count. Both results are (num_polygons,).
    """
    count, result = np.zeros(len(offset) - 1, np.int64), np.full(len(offset) - 1, np.nan)
    some = np.empty(len(point))
    for p in range(len(offset) - 1):
        n = ZERO
        for k in range(offset[p], offset[p + 1]):
            if among[point[k]] and not inside[k]:
                some[n] = value[point[k]]
                n += 1
        count[p] = n
        if n:
            result[p] = median(some, n)
    return count, result


def seen_share(polygon: shapely.Polygon, x_m: np.ndarray, y_m: np.ndarray) -> float:
    """Share of the 1 m cells of a polygon that have one of the points (n,).

    A cell counts when its centre is inside the polygon; cells start at whole metres of the local frame, in
    which the polygon and the points are given. Without any such cell: 1 with a point, else 0.
    """
    if polygon.is_empty:
        return 0.0
    low_x, low_y, high_x, high_y = np.floor(polygon.bounds).astype(int).tolist()
    centre_x_m, centre_y_m = np.arange(low_x, high_x + 1) + 0.5, np.arange(low_y, high_y + 1) + 0.5
    inside = shapely.contains_xy(polygon, centre_x_m, centre_y_m[:, None])
    return seen_share_of_cells(inside, (low_x, low_y), x_m, y_m)


def seen_share_of_cells(
    inside: np.ndarray, low_m: tuple[int, int], x_m: np.ndarray, y_m: np.ndarray
) -> float:
    """Share of the cells ``inside``, bool (rows, columns), that have one of the points (n,).

    low_m: south-west corner of the first cell, whole metres. Without any cell inside: 1 with a point, else 0.
    """
    if not inside.any():
        return float(len(x_m) > 0)
    column, row = np.floor(x_m).astype(int) - low_m[0], np.floor(y_m).astype(int) - low_m[1]
    is_near = (column >= 0) & (column < inside.shape[1]) & (row >= 0) & (row < inside.shape[0])
    seen = np.zeros(inside.shape, bool)
    seen[row[is_near], column[is_near]] = True
    return float(seen[inside].mean())
