"""Terrain as triangles, two between four neighbouring cells of a raster, and rays against it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit


class TerrainGrid(NamedTuple):
    """The terrain in the local frame, as two triangles between every four neighbouring cell centres.

    height_m: float32 (rows, columns), NaN where there is no data. block_max_m: float32, the highest of each
    block of :data:`BLOCK_SQUARES` squares and its border. min_m, max_m: the lowest and the highest of all.
    x_min_m, y_max_m: centre of the north-west cell.

    A square between the centres nw, ne, sw, se is cut along nw-se; a triangle with a NaN corner does not
    exist.
    """

    height_m: np.ndarray
    block_max_m: np.ndarray
    min_m: float
    max_m: float
    x_min_m: float
    y_max_m: float
    cell_m: float


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
        _block_max(height),
        float(np.nanmin(height, initial=np.inf)),
        float(np.nanmax(height, initial=-np.inf)),
        float(x_min_m + cell_m / 2 - origin_m[0]),
        float(y_max_m - cell_m / 2 - origin_m[1]),
        float(cell_m),
    )


@njit(cache=True)
def _block_max(height: np.ndarray) -> np.ndarray:
    rows, columns = height.shape
    num_rows, num_columns = (rows - 2) // BLOCK_SQUARES + 1, (columns - 2) // BLOCK_SQUARES + 1
    result = np.full((max(num_rows, 0), max(num_columns, 0)), -np.inf, np.float32)
    for row in range(rows):
        for column in range(columns):
            h = height[row, column]
            # a centre on the border of two blocks counts for both; NaN compares false
            for i in range(max(row - 1, 0) // BLOCK_SQUARES, min(row // BLOCK_SQUARES, num_rows - 1) + 1):
                for j in range(
                    max(column - 1, 0) // BLOCK_SQUARES, min(column // BLOCK_SQUARES, num_columns - 1) + 1
                ):
                    if h > result[i, j]:
                        result[i, j] = h
    return result


@njit(cache=True, nogil=True)
def first_crossing(
    grid: TerrainGrid, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, limit: float
) -> tuple[float, float, float]:
    """Where a falling ray (dz < 0) first meets the terrain, if nearer than ``limit``.

    Returns (distance in lengths of the direction, or -1; slope of the triangle towards east; towards north).
    Walks over blocks that the ray passes above, and through the squares of those that it may meet, in
    float64: a ray at 20 degrees meets two or three squares, and no tree has to be built.
    """
    rows, columns = grid.height_m.shape
    per_dz = 1 / dz
    end = min((grid.min_m - oz) * per_dz + 1e-6, limit)
    # in units of cells: u to the east, v to the south, squares between whole numbers
    per_cell = 1 / grid.cell_m
    u, v = (ox - grid.x_min_m) * per_cell, (grid.y_max_m - oy) * per_cell
    du, dv = dx * per_cell, -dy * per_cell
    # lengths of ray per cell; a ray that stays in its column or row never leaves it
    per_u, per_v = 1 / du if du != 0 else 1e300, 1 / dv if dv != 0 else 1e300
    t, end = _clip(u, per_u, columns - 1.0, max((grid.max_m - oz) * per_dz, 0.0), end)
    t, end = _clip(v, per_v, rows - 1.0, t, end)
    size = BLOCK_SQUARES
    while t < end:
        block_column = _place(u + du * t, du, size, grid.block_max_m.shape[1])
        block_row = _place(v + dv * t, dv, size, grid.block_max_m.shape[0])
        leave = min(_exit(u, per_u, block_column, size, t), _exit(v, per_v, block_row, size, t), end)
        highest = grid.block_max_m[block_row, block_column]
        if oz + dz * leave <= highest:
            s = max(t, (highest - oz) * per_dz)
            while s < leave:
                column = _place(u + du * s, du, 1, columns - 1)
                row = _place(v + dv * s, dv, 1, rows - 1)
                out = min(_exit(u, per_u, column, 1, s), _exit(v, per_v, row, 1, s), leave)
                hit, east, south = _cross_square(
                    grid.height_m, row, column, u - column, v - row, oz, du, dv, dz, s, out
                )
                if hit >= 0:
                    return hit, east * per_cell, -south * per_cell
                s = out
        t = leave
    return -1.0, 0.0, 0.0


@njit(cache=True, nogil=True, inline="always")
def _clip(u: float, per_u: float, high: float, start: float, end: float) -> tuple[float, float]:
    """The part of the ray from ``start`` to ``end`` on the grid, 0 to ``high``; empty if start >= end."""
    a, b = -u * per_u, (high - u) * per_u
    return max(start, min(a, b)), min(end, max(a, b))


@njit(cache=True, nogil=True, inline="always")
def _place(u: float, du: float, size: int, count: int) -> int:
    """Number of the interval of ``size`` that a ray at ``u`` enters; at a border, the one it goes into."""
    # rounding may leave u just short of the border that the ray is about to cross
    ahead = u + 1e-9 if du > 0 else u - 1e-9
    return min(max(int(ahead * (1.0 / size)), 0), count - 1)


@njit(cache=True, nogil=True, inline="always")
def _exit(u: float, per_u: float, place: int, size: int, t: float) -> float:
    """Where the ray leaves the interval number ``place``, always a little after ``t``."""
    border = (place + 1) * size if per_u > 0 else place * size
    return max((border - u) * per_u, t + 1e-9)


@njit(cache=True, nogil=True, inline="always")
def _cross_square(
    height: np.ndarray,
    row: int,
    column: int,
    u: float,
    v: float,
    z: float,
    du: float,
    dv: float,
    dz: float,
    start: float,
    end: float,
) -> tuple[float, float, float]:
    """First crossing of a square's triangles between ``start`` and ``end``; u, v are relative to the
    square."""
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
