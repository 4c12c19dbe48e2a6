"""Terrain as triangles, two between four neighbouring cells of a raster, and rays against it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from p2wss.skeleton.compiled import inlined, inner


class TerrainGrid(NamedTuple):
    """The terrain in the local frame, as two triangles between every four neighbouring cell centres.

    height_m: float32 (rows, columns), NaN where there is no data. block_range_m: float32 (.., .., 2), lowest
    and highest height of each block of :data:`BLOCK_SQUARES` by :data:`BLOCK_SQUARES` squares with its
    border; the lowest is -inf where data is missing. region_range_m: the same for :data:`REGION_SQUARES`.
    min_m, max_m: lowest and highest height of all. x_min_m, y_max_m: centre of the north-west cell.

    A square between the centres nw, ne, sw, se is cut along nw-se; a triangle with a NaN corner does not
    exist.
    """

    height_m: np.ndarray
    block_range_m: np.ndarray
    region_range_m: np.ndarray
    min_m: float
    max_m: float
    x_min_m: float
    y_max_m: float
    cell_m: float


class GridFrame(NamedTuple):
    """The numbers of a :class:`TerrainGrid` without its arrays."""

    rows: int
    columns: int
    min_m: float
    max_m: float
    x_min_m: float
    y_max_m: float
    per_cell: float


class Ray(NamedTuple):
    """A ray from (x, y, z) along (dx, dy, dz). Lengths along it are in lengths of that direction."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float


BLOCK_SQUARES, REGION_SQUARES = 8, 64


def local_grid(
    height_m: np.ndarray, x_min_m: float, y_max_m: float, cell_m: float, origin_m: np.ndarray
) -> TerrainGrid:
    """A north-up raster of heights relative to ``origin_m`` (3,).

    height_m: float (rows, columns), NaN where there is no data. x_min_m, y_max_m: outer north-west corner.
    """
    height = (height_m.astype(np.float64) - origin_m[2]).astype(np.float32)
    blocks, regions = _ranges(height, BLOCK_SQUARES), _ranges(height, REGION_SQUARES)
    return TerrainGrid(
        height,
        blocks,
        regions,
        float(np.nanmin(height, initial=np.inf)),
        float(np.nanmax(height, initial=-np.inf)),
        float(x_min_m + cell_m / 2 - origin_m[0]),
        float(y_max_m - cell_m / 2 - origin_m[1]),
        float(cell_m),
    )


def _ranges(height: np.ndarray, size: int) -> np.ndarray:
    """Lowest and highest cell centre of every block of ``size`` by ``size`` squares, float32 (.., .., 2)."""
    known = np.where(np.isnan(height), np.float32(-np.inf), height)
    rows, columns = (np.arange(0, count - 1, size) for count in height.shape)
    ranges = []
    for extreme in (np.minimum, np.maximum):
        # of squares first: a centre on the border of two blocks counts for both
        of_rows = extreme.reduceat(extreme(known[:-1], known[1:]), rows)
        ranges.append(extreme.reduceat(extreme(of_rows[:, :-1], of_rows[:, 1:]), columns, axis=1))
    return np.stack(ranges, axis=-1)


@inlined
def frame_of(grid: TerrainGrid) -> GridFrame:
    """What :func:`crossing` needs of a grid besides its arrays."""
    return GridFrame(
        grid.height_m.shape[0],
        grid.height_m.shape[1],
        grid.min_m,
        grid.max_m,
        grid.x_min_m,
        grid.y_max_m,
        1 / grid.cell_m,
    )


@inlined
def crossing(
    frame: GridFrame,
    height: np.ndarray,
    blocks: np.ndarray,
    regions: np.ndarray,
    ray: Ray,
    limit: float,
) -> tuple[float, float, float]:
    """Where a falling ray (dz < 0) first meets the terrain, if nearer than ``limit``.

    Returns (distance in lengths of the direction, or -1; slope of the triangle towards east; towards north). The arrays
    are those of the grid, taken out of it once for many rays: numba counts the references to an array each time that it
    is taken out of a tuple.

    In float64, and without a tree. The height range of the region and then that of the block through which
    the ray passes narrow the search to some decimetres of the ray, mostly within one square.
    """
    z, per_dz = ray.z, 1 / ray.dz
    start = max((frame.max_m - z) * per_dz, 0.0)
    end = min((frame.min_m - z) * per_dz + 1e-6, limit)
    hit, east, south = -1.0, 0.0, 0.0
    # in units of cells: u to the east, v to the south, squares between whole numbers
    u, v = (ray.x - frame.x_min_m) * frame.per_cell, (frame.y_max_m - ray.y) * frame.per_cell
    du, dv = ray.dx * frame.per_cell, -ray.dy * frame.per_cell
    on_grid = Ray(u, v, z, du, dv, ray.dz)
    u0, v0, u1, v1 = u + du * start, v + dv * start, u + du * end, v + dv * end
    if not (
        min(u0, u1) >= 0
        and min(v0, v1) >= 0
        and max(u0, u1) < frame.columns - 1
        and max(v0, v1) < frame.rows - 1
    ):
        if start < end:
            hit, east, south = _walk(height, blocks, on_grid, start, end)
        return hit, east * frame.per_cell, -south * frame.per_cell
    if start < end and _adjoin(u0, v0, u1, v1, REGION_SQUARES):
        low, high = _range(regions, u0, v0, u1, v1, REGION_SQUARES)
        start, end = max(start, (high - z) * per_dz), min(end, (low - z) * per_dz + 1e-6)
        u0, v0, u1, v1 = u + du * start, v + dv * start, u + du * end, v + dv * end
    if start < end:
        if _adjoin(u0, v0, u1, v1, BLOCK_SQUARES):
            low, high = _range(blocks, u0, v0, u1, v1, BLOCK_SQUARES)
            start, end = max(start, (high - z) * per_dz), min(end, (low - z) * per_dz + 1e-6)
            u0, v0, u1, v1 = u + du * start, v + dv * start, u + du * end, v + dv * end
            if start < end:
                row, column = int(v0), int(u0)
                if row == int(v1) and column == int(u1):
                    hit, east, south = _cross_square(height, row, column, on_grid, start, end)
                else:
                    hit, east, south = _walk_squares(height, on_grid, start, end)
        else:
            hit, east, south = _walk(height, blocks, on_grid, start, end)
    return hit, east * frame.per_cell, -south * frame.per_cell


@inlined
def _adjoin(u0: float, v0: float, u1: float, v1: float, size: int) -> bool:
    """Whether two places are in the same block of ``size`` squares or in neighbouring ones."""
    per = 1.0 / size
    return abs(int(u0 * per) - int(u1 * per)) <= 1 and abs(int(v0 * per) - int(v1 * per)) <= 1


@inlined
def _range(blocks: np.ndarray, u0: float, v0: float, u1: float, v1: float, size: int) -> tuple[float, float]:
    """Lowest and highest height of the one, two or four blocks that two such places span."""
    per = 1.0 / size
    i0, j0, i1, j1 = np.uint64(v0 * per), np.uint64(u0 * per), np.uint64(v1 * per), np.uint64(u1 * per)
    low = min(min(blocks[i0, j0, 0], blocks[i1, j1, 0]), min(blocks[i0, j1, 0], blocks[i1, j0, 0]))
    high = max(max(blocks[i0, j0, 1], blocks[i1, j1, 1]), max(blocks[i0, j1, 1], blocks[i1, j0, 1]))
    return np.float64(low), np.float64(high)


@inner
def _walk(
    height: np.ndarray, blocks: np.ndarray, ray: Ray, start: float, end: float
) -> tuple[float, float, float]:
    """First crossing between ``start`` and ``end``: block by block, and square by square in the blocks whose
    terrain the ray may meet. ray: in cells."""
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
        highest = blocks[block_row, block_column, 1]
        if z + dz * leave <= highest:
            hit, east, south = _walk_squares(height, ray, max(t, (highest - z) / dz), leave)
            if hit >= 0:
                return hit, east, south
        t = leave
    return -1.0, 0.0, 0.0


@inner
def _walk_squares(height: np.ndarray, ray: Ray, start: float, end: float) -> tuple[float, float, float]:
    """First crossing between ``start`` and ``end``, square by square. ray: in cells."""
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
    """Number of the interval of ``size`` that a ray at ``u`` enters; at a border, the one it goes into."""
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
    """First crossing of a square's triangles between ``start`` and ``end``. ray: in cells."""
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
