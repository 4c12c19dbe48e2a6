"""What is connected, directly or through others."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import both
from p2wss.skeleton.half_edges import find
from p2wss.skeleton.types import writable


def groups(size: int, pairs: np.ndarray) -> np.ndarray:
    """int (size,): equal numbers, from 0 in the order of the first of each, for what is linked by ``pairs`` (n, 2),
    directly or through others.

    >>> groups(4, np.array([[0, 2]])).tolist()
    [0, 1, 0, 2]
    """
    # scipy's function takes many times as long for the few triangles of a building
    return np.asarray(grouped(int(size), writable(pairs, np.int64)))


def cell_neighbours(grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices of all pairs of cells of a grid (rows, columns) that share a side."""
    index = np.arange(grid.size).reshape(grid.shape)
    first = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    second = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
    return first, second


@both
def grouped(size: int, pairs: np.ndarray) -> np.ndarray:
    """:func:`groups`, for compiled code, too."""
    first = np.arange(size)
    for k in range(len(pairs)):
        a, b = find(first, pairs[k, 0]), find(first, pairs[k, 1])
        first[max(a, b)] = min(a, b)
    number = np.empty(size, np.int64)
    num_groups = 0
    for k in range(size):
        if first[k] == k:
            number[k] = num_groups
            num_groups += 1
        else:
            number[k] = number[find(first, k)]
    return number
