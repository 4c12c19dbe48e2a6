"""Sorting for compiled code: numba's own sorts take seconds to compile in every function that calls them."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import allocating, inner


@allocating
def stable_order(key: np.ndarray) -> np.ndarray:
    """Indices, int64 (n,), that sort float64 values (n,) without NaN in ascending order; equal values keep
    their order."""
    n = len(key)
    order, merged = np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        order[i] = i
    width = 1
    while width < n:
        for first in range(0, n, 2 * width):
            middle, last = min(first + width, n), min(first + 2 * width, n)
            a, b = first, middle
            for k in range(first, last):
                if b >= last or (a < middle and not key[order[b]] < key[order[a]]):
                    merged[k] = order[a]
                    a += 1
                else:
                    merged[k] = order[b]
                    b += 1
        order, merged = merged, order
        width *= 2
    return order


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
