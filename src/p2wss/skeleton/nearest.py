"""The points nearest to places. scipy's trees are slower for the few points of a building, and loading them takes a
tenth of a program's start."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import entry
from p2wss.skeleton.ordering import sorted_by
from p2wss.skeleton.types import writable


def nearest(point_m: np.ndarray, place_m: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """(distances (m, count), numbers int (m, count)) of the points nearest to each place, the nearest first, and of
    equally near ones the first; an infinite distance where there are no more points.

    point_m: (n, d), at least one. place_m: (m, d). In the plane or in space.

    >>> nearest(np.array([[0.0, 0.0], [3.0, 4.0]]), np.zeros((1, 2)), 2)
    (array([[0., 5.]]), array([[0, 1]]))
    """
    squared_m2, number = _nearest(writable(place_m, np.float64), writable(point_m, np.float64), int(count))
    return np.sqrt(squared_m2[:, :count]), number[:, :count]


@entry
def _nearest(place_m: np.ndarray, point_m: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(squared distances, numbers), one more than asked for of each place."""
    size, low_m, extent_m, local_m = point_m.shape[1], np.zeros(3), np.zeros(3), np.zeros((len(point_m), 3))
    for k in range(size):
        low_m[k] = np.inf
        for t in range(len(point_m)):
            low_m[k] = min(low_m[k], point_m[t, k])
        for t in range(len(point_m)):
            local_m[t, k] = point_m[t, k] - low_m[k]
            extent_m[k] = max(extent_m[k], local_m[t, k])
    # the points by the cells of a grid in plan, one in each on average: larger ones are slower for any count
    cell_m = max(
        (extent_m[0] * extent_m[1] / len(point_m)) ** 0.5,
        max(extent_m[0], extent_m[1]) / len(point_m),
        1e-9,
    )
    num_columns, num_rows = int(extent_m[0] / cell_m) + 1, int(extent_m[1] / cell_m) + 1
    cell = np.empty(len(point_m), np.int64)
    for t in range(len(point_m)):
        cell[t] = int(local_m[t, 1] / cell_m) * num_columns + int(local_m[t, 0] / cell_m)
    begin, order = sorted_by(cell, num_columns * num_rows)
    sorted_m = local_m[order]
    all_squared_m2 = np.full((len(place_m), count + 1), np.inf)
    all_numbers = np.zeros((len(place_m), count + 1), np.int64)
    place = np.zeros(3)
    for i in range(len(place_m)):
        squared_m2, number = all_squared_m2[i], all_numbers[i]
        for k in range(size):
            place[k] = place_m[i, k] - low_m[k]
        column = int(min(max(place[0] / cell_m, 0.0), num_columns - 1.0))
        row = int(min(max(place[1] / cell_m, 0.0), num_rows - 1.0))
        reach, bound_m = 1, 0.0
        while bound_m < np.inf and squared_m2[count - 1] >= bound_m * bound_m:
            left, right, low, high = column - reach, column + reach, row - reach, row + reach
            for r in range(max(low, 0), min(high, num_rows - 1) + 1):
                # all cells of the row, or the first and the last one of those between which all were searched before
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
                place[0] - left * cell_m if left > 0 else np.inf,
                (right + 1) * cell_m - place[0] if right < num_columns - 1 else np.inf,
                place[1] - low * cell_m if low > 0 else np.inf,
                (high + 1) * cell_m - place[1] if high < num_rows - 1 else np.inf,
            )
            reach += 1
    return all_squared_m2, all_numbers
