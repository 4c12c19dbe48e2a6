"""Sorting for compiled code: numba's own sorts take seconds to compile in every function that calls them."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import inner


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
