"""Terrain under reconstructed buildings: a closed block of few triangles, and buildings that reach into it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from p2wss.data.terrain import Terrain
from p2wss.data.tiling import Bounds
from p2wss.formats.meshes import TERRAIN, Body
from p2wss.mesh import Mesh
from p2wss.mesh.topology import border_rings, doubled_plan_areas, twins
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.types import FaceKind
from p2wss.storage.messages import InputError, log

NAME = "terrain"
# the block reaches at least this far below the lowest ground, a building this far below the lowest terrain under it;
# both reach further if the tolerance of the triangles is large
_BELOW_M, _FOOT_M = 2.0, 0.5
# windows of more cells are thinned to every k-th row and column; 1 km2 at 0.5 m is used whole
_MAX_CELLS = 4_000_000


def block(window: Terrain, tolerance_m: float, lowest_m: float = np.inf) -> Body:
    """A closed solid over the centres of the cells of a :func:`window`.

    The top is a Delaunay triangulation. Cells are added as vertices until no cell is further than ``tolerance_m`` above
    or below it: in each round, the worst cell of every triangle (greedy insertion, Garland and Heckbert 1995,
    section 4). The sides are vertical. The bottom is level, below all ground and ``lowest_m``. The attribute
    ``spacing_m`` is the size of a cell.
    """
    height_m, spacing_m = window.height_m, window.cell_m
    rows, columns = height_m.shape
    vertices = np.array([0, columns - 1, (rows - 1) * columns, rows * columns - 1])
    while True:
        row, column = np.divmod(vertices, columns)
        # Delaunay on whole numbers is exact: points on the border stay on it
        plan = np.column_stack([column, row])
        upper = scipy.spatial.Delaunay(plan.astype(float)).simplices
        area = doubled_plan_areas(plan[upper])
        # rows run south: what is clockwise on the grid is counter-clockwise seen from above
        upper = np.where((area > 0)[:, None], upper[:, ::-1], upper)[area != 0]
        worst = _worst_cells(height_m, plan[upper], tolerance_m)
        extended = np.union1d(vertices, worst[worst >= 0])
        if len(extended) == len(vertices):
            break
        vertices = extended
    x_m, y_m = window.x_min_m + (column + 0.5) * spacing_m, window.y_max_m - (row + 0.5) * spacing_m
    top_m = np.column_stack([x_m, y_m, height_m[row, column]])
    body = _closed(top_m, upper, min(float(height_m.min()), lowest_m) - max(_BELOW_M, 2 * tolerance_m))
    return replace(body, attributes={"spacing_m": round(spacing_m, 3)})


def lowered_into(bodies: Sequence[Body], window: Terrain, tolerance_m: float) -> list[Body]:
    """The buildings with ground faces lowered below the lowest terrain under each building, and walls extended.

    So there is no gap between a level ground face and sloping terrain through which a ray could enter the building.
    window, tolerance_m: as for :func:`block`, whose top may be up to ``tolerance_m`` below the terrain.
    """
    result = []
    for body in bodies:
        mesh = body.mesh
        low, high = mesh.vertex_m.min(axis=0), mesh.vertex_m.max(axis=0)
        lowest = window.cut((low[0], low[1], high[0], high[1])).height_m.min()
        vertex_m = mesh.vertex_m.copy()
        ground = np.unique(mesh.triangle[mesh.kind == FaceKind.GROUND])
        vertex_m[ground, 2] = np.minimum(vertex_m[ground, 2], lowest - max(_FOOT_M, tolerance_m))
        result.append(replace(body, mesh=mesh.moved(vertex_m)))
    return result


@entry
def _worst_cells(height_m: np.ndarray, corner: np.ndarray, tolerance_m: float) -> np.ndarray:
    """int64 (t,): the cell (row * columns + column) whose height is furthest from each triangle; -1 if no cell is
    further than ``tolerance_m``. corner: int (t, 3, 2), column and row of the corners, clockwise on the grid."""
    result = np.full(len(corner), -1, np.int64)
    for t in range(len(corner)):
        ax, ay = corner[t, 0, 0], corner[t, 0, 1]
        bx, by = corner[t, 1, 0], corner[t, 1, 1]
        cx, cy = corner[t, 2, 0], corner[t, 2, 1]
        za, zb, zc = height_m[ay, ax], height_m[by, bx], height_m[cy, cx]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        furthest = tolerance_m
        for y in range(min(ay, by, cy), max(ay, by, cy) + 1):
            for x in range(min(ax, bx, cx), max(ax, bx, cx) + 1):
                wa = (bx - x) * (cy - y) - (by - y) * (cx - x)
                wb = (cx - x) * (ay - y) - (cy - y) * (ax - x)
                wc = area - wa - wb
                # all of the sign of the area, which is negative
                if wa <= 0 and wb <= 0 and wc <= 0:
                    gap = abs((wa * za + wb * zb + wc * zc) / area - height_m[y, x])
                    if gap > furthest:
                        furthest = gap
                        result[t] = y * height_m.shape[1] + x
    return result


def window(terrain: Terrain, bounds: Bounds) -> Terrain:
    """The cells in ``bounds`` and one more row of cells on every side. Cells without data take the height of the
    nearest cell with data. Of more than 4 million cells, one in k along rows and columns is used, with a warning.

    Raises :class:`InputError` if there is no height.
    """
    cell = terrain.cell_m
    x_min, y_min, x_max, y_max = bounds
    left = int(np.floor((x_min - terrain.x_min_m) / cell - 0.5))
    right = int(np.ceil((x_max - terrain.x_min_m) / cell - 0.5))
    first = int(np.floor((terrain.y_max_m - y_max) / cell - 0.5))
    last = int(np.ceil((terrain.y_max_m - y_min) / cell - 0.5))
    step = max(int(np.ceil(np.sqrt((right - left + 1) * (last - first + 1) / _MAX_CELLS))), 1)
    if step > 1:
        log.warning(
            "warning: the terrain around the buildings has more than %d cells: its mesh has heights every %g m, not"
            " every %g m (fewer buildings at a time, as by --bbox, have all)",
            _MAX_CELLS,
            step * cell,
            cell,
        )
    column = np.arange(left, right + step, step)
    row = np.arange(first, last + step, step)
    rows, columns = terrain.height_m.shape
    height = np.full((len(row), len(column)), np.nan)
    in_row, in_column = (row >= 0) & (row < rows), (column >= 0) & (column < columns)
    height[np.ix_(in_row, in_column)] = terrain.height_m[np.ix_(row[in_row], column[in_column])]
    has_data = np.isfinite(height)
    if not has_data.any():
        raise InputError("the terrain has no height around the buildings")
    if not has_data.all():
        nearest = scipy.ndimage.distance_transform_edt(~has_data, return_distances=False, return_indices=True)
        height = height[tuple(nearest)]
    # the corner of larger cells around the same centres
    west, north = left + (1 - step) / 2, first + (1 - step) / 2
    return Terrain(height, terrain.x_min_m + west * cell, terrain.y_max_m - north * cell, step * cell)


def _closed(top_m: np.ndarray, upper: np.ndarray, bottom_z_m: float) -> Body:
    """The solid of a top surface, vertical sides and a level bottom; the border of ``upper`` must be a single ring."""
    border = np.array(border_rings(upper, np.zeros(len(upper), int), twins(upper))[0][1])
    border = np.roll(border, -border.argmin())
    count, around = len(top_m), len(border)
    below = np.column_stack([top_m[border, :2], np.full(around, bottom_z_m)])
    lower = count + np.arange(around)
    following = np.roll(np.arange(around), -1)
    sides = np.concatenate(
        [
            np.column_stack([border, lower, lower[following]]),
            np.column_stack([border, lower[following], border[following]]),
        ]
    )
    # a fan, because the border has vertices within its straight sides, which an ear clipper would skip
    middle = [*((top_m[:, :2].min(axis=0) + top_m[:, :2].max(axis=0)) / 2), bottom_z_m]
    bottom = np.column_stack([lower[following], lower, np.full(around, count + around)])
    triangle = np.concatenate([upper, sides, bottom]).astype(np.int32)
    kind = np.full(len(triangle), TERRAIN, np.uint8)
    label = np.zeros(len(triangle), np.int32)
    return Body.of_building(NAME, Mesh(np.vstack([top_m, below, middle]), triangle, kind, label))
