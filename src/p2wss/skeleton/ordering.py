"""Sorting for compiled code: the sorts of numba itself take half a second to compile, for each type."""

import numpy as np

from p2wss.skeleton.compiled import allocating, inner


@inner
def median(values: np.ndarray, count: int) -> float:
    """Median of the first ``count`` values, at least one; reorders them."""
    half = count // 2
    upper = select(values, count, half)
    if count % 2 == 1:
        return upper
    lower = values[0]
    for k in range(half):
        lower = max(lower, values[k])
    return (lower + upper) / 2


@inner
def select(values: np.ndarray, count: int, place: int) -> float:
    """The value that would be at ``place`` if the first ``count`` values were sorted.

    Reorders them, so that no value before ``place`` is greater and none after it is less.
    """
    low, high = 0, count - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if place <= j:
            high = j
        elif place >= i:
            low = i
        else:
            break
    return values[place]


@allocating
def order_of(value: np.ndarray) -> np.ndarray:
    """The indices (n,) that sort float64 values; the order of equal values stays."""
    return np.argsort(value, kind="mergesort")


@allocating
def ascending(number: np.ndarray) -> np.ndarray:
    """int64 numbers (n,), sorted."""
    return np.sort(number)


@allocating
def sorted_by(number: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """(first int64 (size + 1,), index): the indices at which ``number`` is k are ``index[first[k]:first[k + 1]]``,
    ascending. number: int (n,), below ``size``; negative numbers are left out."""
    first = np.zeros(size + 1, np.int64)
    for each in number:
        if each >= 0:
            first[each + 1] += 1
    first = np.cumsum(first)
    free, result = first.copy(), np.empty(first[size], np.int64)
    for k, each in enumerate(number):
        if each >= 0:
            result[free[each]] = k
            free[each] += 1
    return first, result
