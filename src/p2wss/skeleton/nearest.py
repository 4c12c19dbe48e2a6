"""The points nearest to places. scipy's trees are slower for the few points of a building, and loading them takes a
tenth of a program's start."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import entry

# of a cell of the plan, at least, and of the points that are asked for
_POINTS_PER_CELL, _SHARE_PER_CELL = 2.0, 0.25


def nearest(point_m: np.ndarray, place_m: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """(distances (m, count), numbers int (m, count)) of the points nearest to each place, the nearest first, and of
    equally near ones the first; an infinite distance where there are no more points.

    point_m: (n, d), at least one. place_m: (m, d). In the plane or in space.

    >>> nearest(np.array([[0.0, 0.0], [3.0, 4.0]]), np.zeros((1, 2)), 2)
    (array([[0., 5.]]), array([[0, 1]]))
    """
    low_m = point_m.min(axis=0)
    point, place = np.zeros((len(point_m), 3)), np.zeros((len(place_m), 3))
    point[:, : len(low_m)], place[:, : len(low_m)] = point_m - low_m, place_m - low_m
    extent_m = point[:, :2].max(axis=0)
    share = max(_POINTS_PER_CELL, _SHARE_PER_CELL * count) / len(point)
    cell_m = max((share * extent_m[0] * extent_m[1]) ** 0.5, share * extent_m.max(), 1e-9)
    column, row = (point[:, :2] / cell_m).astype(np.int64).T
    num_columns, num_rows = int(column.max()) + 1, int(row.max()) + 1
    cell = row * num_columns + column
    order = np.argsort(cell, kind="stable")
    begin = np.searchsorted(cell[order], np.arange(num_columns * num_rows + 1))
    squared_m2, number = _nearest(place, point[order], order, begin, (count, num_columns, num_rows), cell_m)
    return np.sqrt(squared_m2[:, :count]), number[:, :count]


@entry
def _nearest(
    place_m: np.ndarray,
    point_m: np.ndarray,
    order: np.ndarray,
    begin: np.ndarray,
    sizes: tuple[int, int, int],
    cell_m: float,
) -> tuple[np.ndarray, np.ndarray]:
    """(squared distances, numbers), one more than asked for of each place. point_m: those of the cells of a grid in
    plan, which ``begin`` there. sizes: the number of points that are sought, of columns and of rows."""
    count, num_columns, num_rows = sizes
    all_squared_m2 = np.full((len(place_m), count + 1), np.inf)
    all_numbers = np.zeros((len(place_m), count + 1), np.int64)
    for i in range(len(place_m)):
        squared_m2, number, place = all_squared_m2[i], all_numbers[i], place_m[i]
        column = int(min(max(place[0] / cell_m, 0.0), num_columns - 1.0))
        row = int(min(max(place[1] / cell_m, 0.0), num_rows - 1.0))
        reach, bound_m = 0, 0.0
        while bound_m < np.inf and squared_m2[count - 1] >= bound_m * bound_m:
            left, right, low, high = column - reach, column + reach, row - reach, row + reach
            for r in range(max(low, 0), min(high, num_rows - 1) + 1):
                for c in range(left, right + 1, 1 if r in (low, high) else right - left):
                    if not 0 <= c < num_columns:
                        continue
                    for t in range(begin[r * num_columns + c], begin[r * num_columns + c + 1]):
                        x, y, z = point_m[t, 0] - place[0], point_m[t, 1] - place[1], point_m[t, 2] - place[2]
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
                place[0] - left * cell_m if left > 0 else np.inf,
                (right + 1) * cell_m - place[0] if right < num_columns - 1 else np.inf,
                place[1] - low * cell_m if low > 0 else np.inf,
                (high + 1) * cell_m - place[1] if high < num_rows - 1 else np.inf,
            )
            reach += 1
    return all_squared_m2, all_numbers
