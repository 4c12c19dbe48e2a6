"""Terrain as triangles, two between four neighbouring cells of a raster, and rays against it."""

from typing import NamedTuple

import numpy as np

from p2wss.skeleton.compiled import inlined, inner


class TerrainGrid(NamedTuple):
    """The terrain in the local frame, as two triangles between every four neighbouring cell centres.

    height_m: float32 (rows, columns), NaN where there is no data. highest_m: float32, of each block of
    :data:`BLOCK_SQUARES` by :data:`BLOCK_SQUARES` squares with its border; -inf where data is missing. min_m, max_m:
    lowest and highest height of all. x_min_m, y_max_m: centre of the north-west cell.

    A square between the centres nw, ne, sw, se is cut along nw-se; a triangle with a NaN corner does not
    exist.
    """

    height_m: np.ndarray
    highest_m: np.ndarray
    min_m: float
    max_m: float
    x_min_m: float
    y_max_m: float
    cell_m: float


class Ray(NamedTuple):
    """A ray from (x, y, z) along (dx, dy, dz). Lengths along it are in lengths of that direction."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float


BLOCK_SQUARES = 8


def local_grid(
    height_m: np.ndarray, x_min_m: float, y_max_m: float, cell_m: float, origin_m: np.ndarray
) -> TerrainGrid:
    """A north-up raster of heights relative to ``origin_m`` (3,).

    height_m: float (rows, columns), NaN where there is no data. x_min_m, y_max_m: outer north-west corner.
    """
    height = (height_m.astype(np.float64) - origin_m[2]).astype(np.float32)
    return TerrainGrid(
        height,
        _highest(height),
        float(np.nanmin(height, initial=np.inf)),
        float(np.nanmax(height, initial=-np.inf)),
        float(x_min_m + cell_m / 2 - origin_m[0]),
        float(y_max_m - cell_m / 2 - origin_m[1]),
        float(cell_m),
    )


def _highest(height: np.ndarray) -> np.ndarray:
    """The highest cell centre of every block of squares, float32."""
    known = np.where(np.isnan(height), np.float32(-np.inf), height)
    rows, columns = (np.arange(0, count - 1, BLOCK_SQUARES) for count in height.shape)
    # first the highest corner of each square, as a centre on the border of two blocks belongs to both
    of_rows = np.maximum.reduceat(np.maximum(known[:-1], known[1:]), rows)
    return np.maximum.reduceat(np.maximum(of_rows[:, :-1], of_rows[:, 1:]), columns, axis=1)


@inlined
def crossing(
    grid: TerrainGrid, height: np.ndarray, highest: np.ndarray, ray: Ray, limit: float
) -> tuple[float, float, float]:
    """Where a falling ray (dz < 0) first meets the terrain, if nearer than ``limit``.

    Returns (distance in lengths of the direction, or -1; slope of the triangle towards east; towards north), in float64
    and without a tree. height, highest: arrays of ``grid``, taken out once for many rays: numba counts the references
    to an array each time that it is taken out of a tuple.
    """
    per_cell = 1 / grid.cell_m
    start = max((grid.max_m - ray.z) / ray.dz, 0.0)
    end = min((grid.min_m - ray.z) / ray.dz + 1e-6, limit)
    # in units of cells: u to the east, v to the south, squares between whole numbers
    u, v = (ray.x - grid.x_min_m) * per_cell, (grid.y_max_m - ray.y) * per_cell
    on_grid = Ray(u, v, ray.z, ray.dx * per_cell, -ray.dy * per_cell, ray.dz)
    hit, east, south = _walk(height, highest, on_grid, start, end)
    return hit, east * per_cell, -south * per_cell


@inner
def _walk(
    height: np.ndarray, blocks: np.ndarray, ray: Ray, start: float, end: float
) -> tuple[float, float, float]:
    """First crossing between ``start`` and ``end``: block by block, and square by square in the blocks whose terrain
    the ray may meet. ray: in units of cells."""
    rows, columns = height.shape
    u, v, z, du, dv, dz = ray
    # lengths of ray per cell; a ray that stays in its column or row never leaves it
    per_u, per_v = 1 / du if du != 0 else 1e300, 1 / dv if dv != 0 else 1e300
    t, end = _clip(u, per_u, columns - 1.0, start, end)
    t, end = _clip(v, per_v, rows - 1.0, t, end)
    size = BLOCK_SQUARES
    while t < end:
        block_column = _place(u + du * t, du, size, blocks.shape[1])
        block_row = _place(v + dv * t, dv, size, blocks.shape[0])
        leave = min(_exit(u, per_u, block_column, size, t), _exit(v, per_v, block_row, size, t), end)
        highest = blocks[block_row, block_column]
        if z + dz * leave <= highest:
            hit, east, south = _walk_squares(height, ray, max(t, (highest - z) / dz), leave)
            if hit >= 0:
                return hit, east, south
        t = leave
    return -1.0, 0.0, 0.0


@inner
def _walk_squares(height: np.ndarray, ray: Ray, start: float, end: float) -> tuple[float, float, float]:
    """First crossing between ``start`` and ``end``, square by square. ray: in units of cells."""
    rows, columns = height.shape
    u, v, _, du, dv, _ = ray
    per_u, per_v = 1 / du if du != 0 else 1e300, 1 / dv if dv != 0 else 1e300
    t = start
    while t < end:
        column = _place(u + du * t, du, 1, columns - 1)
        row = _place(v + dv * t, dv, 1, rows - 1)
        leave = min(_exit(u, per_u, column, 1, t), _exit(v, per_v, row, 1, t), end)
        hit, east, south = _cross_square(height, row, column, ray, t, leave)
        if hit >= 0:
            return hit, east, south
        t = leave
    return -1.0, 0.0, 0.0


@inlined
def _clip(u: float, per_u: float, high: float, start: float, end: float) -> tuple[float, float]:
    """The part of the ray from ``start`` to ``end`` on the grid, 0 to ``high``; empty if start >= end."""
    a, b = -u * per_u, (high - u) * per_u
    return max(start, min(a, b)), min(end, max(a, b))


@inlined
def _place(u: float, du: float, size: int, count: int) -> int:
    """Number of the interval of ``size`` that contains ``u``; at a border, the interval that the ray enters."""
    # rounding may leave u just short of the border that the ray is about to cross
    ahead = u + 1e-9 if du > 0 else u - 1e-9
    return min(max(int(ahead * (1.0 / size)), 0), count - 1)


@inlined
def _exit(u: float, per_u: float, place: int, size: int, t: float) -> float:
    """Where the ray leaves the interval number ``place``, always a little after ``t``."""
    border = (place + 1) * size if per_u > 0 else place * size
    return max((border - u) * per_u, t + 1e-9)


@inlined
def _cross_square(
    height: np.ndarray, row: int, column: int, ray: Ray, start: float, end: float
) -> tuple[float, float, float]:
    """First crossing of a square's triangles between ``start`` and ``end``. ray: in units of cells."""
    u, v, z, du, dv, dz = ray.x - column, ray.y - row, ray.z, ray.dx, ray.dy, ray.dz
    nw, ne = np.float64(height[row, column]), np.float64(height[row, column + 1])
    sw, se = np.float64(height[row + 1, column]), np.float64(height[row + 1, column + 1])
    along = u - v  # above 0 in the triangle of ne
    rate = du - dv
    turn = -along / rate if rate != 0 else -1.0  # where the ray crosses the diagonal
    middle = min(max(turn, start), end)
    for part in range(2):
        a, b = (start, middle) if part == 0 else (middle, end)
        if a >= b:
            continue
        half = 0.5 * (a + b)
        if along + rate * half > 0:
            east, south = ne - nw, se - ne
        else:
            east, south = se - sw, sw - nw
        above_a = z + dz * a - (nw + east * (u + du * a) + south * (v + dv * a))
        above_b = z + dz * b - (nw + east * (u + du * b) + south * (v + dv * b))
        # NaN compares false; a ray that comes from below, through a hole, goes on
        if above_b <= 0 and above_a > -1e-6:
            share = above_a / (above_a - above_b) if above_a > 0 else 0.0
            return a + share * (b - a), east, south
    return -1.0, 0.0, 0.0
