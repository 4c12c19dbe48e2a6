"""Connected groups, cells side by side in a mask, and half-edges that run the other way."""

import numpy as np

from p2wss.skeleton.compiled import both, inner
from p2wss.skeleton.half_edges import find
from p2wss.skeleton.types import writable

# pairs of vertices are multiplied by this to spread them over a hash table (Knuth 1973, Fibonacci hashing)
_SPREAD = -7_046_029_254_386_353_131


def groups(size: int, pairs: np.ndarray) -> np.ndarray:
    """int (size,): the group of each element. Elements that ``pairs`` (n, 2) link, directly or through others, are in
    one group. Groups are numbered from 0 in the order of their first elements.

    >>> groups(4, np.array([[0, 2]])).tolist()
    [0, 1, 0, 2]
    """
    # scipy's function takes many times as long for the few triangles of a building
    return np.asarray(grouped(int(size), writable(pairs, np.int64)))


def cell_neighbours(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(first, second): all pairs of cells in a mask (rows, columns) that share a side, as numbers of the cells in it.

    >>> [each.tolist() for each in cell_neighbours(np.array([[True, False], [True, True]]))]
    [[1, 0], [2, 1]]
    """
    number = np.full(mask.shape, -1, np.int32)
    number[mask] = np.arange(np.count_nonzero(mask))
    sides = ((number[:, :-1], number[:, 1:]), (number[:-1], number[1:]))
    pairs = [(one[here], other[here]) for one, other in sides for here in [(one >= 0) & (other >= 0)]]
    first, second = (np.concatenate(each) for each in zip(*pairs, strict=True))
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


@both
def num_slots(num_half: int) -> int:
    """The size of the table that :func:`find_reverses` needs for ``num_half`` half-edges."""
    size = 4
    while size < 2 * num_half:
        size *= 2
    return size


@inner
def find_reverses(start: np.ndarray, end: np.ndarray, slot: np.ndarray, result: np.ndarray) -> None:
    """Write to ``result``, for each half-edge from ``start`` to ``end``, int64 (n,), the half-edge that runs the other
    way, the first one of several, -1 for none. slot: a hash table with open addressing, :func:`num_slots` long."""
    size = num_slots(len(start))
    slot[:size] = -1
    for is_asked in (False, True):
        for half in range(len(start)):
            one, other = (end[half], start[half]) if is_asked else (start[half], end[half])
            place = (((one << 31) + other) * _SPREAD >> 32) & (size - 1)
            while slot[place] >= 0 and (start[slot[place]] != one or end[slot[place]] != other):
                place = (place + 1) & (size - 1)
            if is_asked:
                result[half] = slot[place]
            elif slot[place] < 0:
                slot[place] = half
