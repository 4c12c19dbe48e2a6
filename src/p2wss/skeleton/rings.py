"""Area and inside of rings, for compiled code. A ring is ``xy[first:last]``, float64 (n, 2), open."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import inlined, inner


@inlined
def crosses(a_x: float, a_y: float, b_x: float, b_y: float, x: float, y: float) -> bool:
    """Whether the ray from (x, y) along x crosses the edge from a to b. A point is inside of a ring if it crosses an
    odd number of its edges."""
    return (a_y > y) != (b_y > y) and x < a_x + (y - a_y) * (b_x - a_x) / (b_y - a_y)


@inner
def is_inside(xy: np.ndarray, first: int, last: int, x: float, y: float) -> bool:
    """Whether (x, y) is inside of a ring, by the even-odd rule."""
    inside = False
    before = last - 1
    for here in range(first, last):
        if crosses(xy[before, 0], xy[before, 1], xy[here, 0], xy[here, 1], x, y):
            inside = not inside
        before = here
    return inside


@inner
def signed_area(xy: np.ndarray, first: int, last: int) -> float:
    """Area of a ring; positive when counter-clockwise."""
    area = 0.0
    a_x, a_y = 0.0, 0.0
    for k in range(first + 1, last):
        b_x, b_y = xy[k, 0] - xy[first, 0], xy[k, 1] - xy[first, 1]
        area += a_x * b_y - a_y * b_x
        a_x, a_y = b_x, b_y
    return 0.5 * area
