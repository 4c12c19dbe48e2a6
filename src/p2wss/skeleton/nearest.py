"""The points nearest to places. scipy's trees are slower for the few points of a building, and loading them takes a
tenth of a program's start."""

import numpy as np

from p2wss.skeleton.compiled import allocating, both, entry, inner
from p2wss.skeleton.ordering import select, sorted_by
from p2wss.skeleton.types import writable


def nearest(point_m: np.ndarray, place_m: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """(distances (m, count), numbers int (m, count)) of the points nearest to each place, the nearest first; points
    that are equally near are in their order. The distance is infinite where there are no more points.

    point_m: (n, d), at least one. place_m: (m, d). In the plane or in space.

    >>> nearest(np.array([[0.0, 0.0], [3.0, 4.0]]), np.zeros((1, 2)), 2)
    (array([[0., 5.]]), array([[0, 1]]))
    """
    squared_m2, number = _nearest(writable(place_m, np.float64), writable(point_m, np.float64), int(count))
    # contiguous, as callers' code is compiled for that layout
    return np.sqrt(squared_m2[:, :count]), np.ascontiguousarray(number[:, :count])


@inner
def _between(edge_m: np.ndarray, mean_m: float, at_m: float) -> int:
    """The index of the last of the ascending ``edge_m`` that is not above a coordinate, 0 if all are above it. mean_m:
    the mean distance of two edges, from which the search starts."""
    k = int(min(max(at_m / mean_m, 0.0), len(edge_m) - 1.0))
    while k > 0 and at_m < edge_m[k]:
        k -= 1
    while k + 1 < len(edge_m) and at_m >= edge_m[k + 1]:
        k += 1
    return k


@allocating
def _as_many_in_each(value_m: np.ndarray, num: int) -> np.ndarray:
    """The lower edges of ``num`` columns with about the same number of values in each; the first edge is 0. Reorders
    the values."""
    edge_m, size = np.zeros(num), len(value_m) // num + 1
    for k in range(1, num):
        first = min((k - 1) * size, len(value_m) - 1)
        rest_m = value_m[first:]
        edge_m[k] = select(rest_m, len(rest_m), min(size, len(rest_m) - 1))
    return edge_m


@allocating
def _cells(
    local_m: np.ndarray, x_edge_m: np.ndarray, y_edge_m: np.ndarray, cell_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """(first, point): cell k of the grid, counted row by row, has the points ``point[first[k]:first[k + 1]]``."""
    cell = np.empty(len(local_m), np.int64)
    for t in range(len(local_m)):
        row, column = _between(y_edge_m, cell_m, local_m[t, 1]), _between(x_edge_m, cell_m, local_m[t, 0])
        cell[t] = row * len(x_edge_m) + column
    return sorted_by(cell, len(x_edge_m) * len(y_edge_m))


@both
def _grid(local_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, np.ndarray, np.ndarray]:
    """A grid of cells in plan over points (n, 3), whose least coordinates are 0: (lower edges of columns; lower edges
    of rows; mean distance of edges; first and point of :func:`_cells`)."""
    x_m, y_m = local_m[:, 0].copy(), local_m[:, 1].copy()
    width_m, height_m = x_m.max(), y_m.max()
    # one point in each cell on average: larger cells are slower for any count
    cell_m = max((width_m * height_m / len(x_m)) ** 0.5, max(width_m, height_m) / len(x_m), 1e-9)
    x_edge_m = np.arange(int(width_m / cell_m) + 1) * cell_m
    y_edge_m = np.arange(int(height_m / cell_m) + 1) * cell_m
    begin, order = _cells(local_m, x_edge_m, y_edge_m, cell_m)
    most = (begin[1:] - begin[:-1]).max()
    if most > 64 and most * most > 16 * len(x_m):
        # points are in patches that are far apart: with cells of one size, all points of a patch would be in one cell
        num = int(len(x_m) ** 0.5)
        x_edge_m, y_edge_m = _as_many_in_each(x_m, num), _as_many_in_each(y_m, num)
        begin, order = _cells(local_m, x_edge_m, y_edge_m, cell_m)
    return x_edge_m, y_edge_m, cell_m, begin, order


@entry
def _nearest(place_m: np.ndarray, point_m: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(squared distances, numbers), (m, count + 1): one point more than asked for at each place."""
    size, low_m, local_m = point_m.shape[1], np.zeros(3), np.zeros((len(point_m), 3))
    for k in range(size):
        low_m[k] = point_m[:, k].min()
        local_m[:, k] = point_m[:, k] - low_m[k]
    x_edge_m, y_edge_m, cell_m, begin, order = _grid(local_m)
    num_columns, num_rows = len(x_edge_m), len(y_edge_m)
    sorted_m = local_m[order]
    all_squared_m2 = np.full((len(place_m), count + 1), np.inf)
    all_numbers = np.zeros((len(place_m), count + 1), np.int64)
    place = np.zeros(3)
    for i in range(len(place_m)):
        squared_m2, number = all_squared_m2[i], all_numbers[i]
        for k in range(size):
            place[k] = place_m[i, k] - low_m[k]
        column, row = _between(x_edge_m, cell_m, place[0]), _between(y_edge_m, cell_m, place[1])
        reach, bound_m = 1, 0.0
        while bound_m < np.inf and squared_m2[count - 1] >= bound_m * bound_m:
            left, right, low, high = column - reach, column + reach, row - reach, row + reach
            for r in range(max(low, 0), min(high, num_rows - 1) + 1):
                # all cells of the row; or only the first and the last, as the cells between were searched before
                is_whole = reach == 1 or r in (low, high)
                for first, last in (
                    (left, right if is_whole else left),
                    (right, left if is_whole else right),
                ):
                    first, last = max(first, 0), min(last, num_columns - 1)
                    if first > last:
                        continue
                    for t in range(begin[r * num_columns + first], begin[r * num_columns + last + 1]):
                        x, y, z = (
                            sorted_m[t, 0] - place[0],
                            sorted_m[t, 1] - place[1],
                            sorted_m[t, 2] - place[2],
                        )
                        near_m2, k = x * x + y * y + z * z, count
                        if near_m2 > squared_m2[count - 1]:
                            continue
                        while k > 0 and (
                            near_m2 < squared_m2[k - 1]
                            or (near_m2 == squared_m2[k - 1] and order[t] < number[k - 1])
                        ):
                            squared_m2[k], number[k], k = squared_m2[k - 1], number[k - 1], k - 1
                        squared_m2[k], number[k] = near_m2, order[t]
            # all points that are not in this square of cells are at least so far away
            bound_m = min(
                place[0] - x_edge_m[left] if left > 0 else np.inf,
                x_edge_m[right + 1] - place[0] if right < num_columns - 1 else np.inf,
                place[1] - y_edge_m[low] if low > 0 else np.inf,
                y_edge_m[high + 1] - place[1] if high < num_rows - 1 else np.inf,
            )
            reach += 1
    return all_squared_m2, all_numbers
