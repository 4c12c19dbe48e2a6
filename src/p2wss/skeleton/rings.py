"""Areas of rings, whether points are inside, and distances of segments, for compiled code. A ring is
``xy[first:last]``, float64 (n, 2), without its first vertex at the end."""

import numpy as np

from p2wss.skeleton.compiled import inlined, inner


@inlined
def crosses(a_x: float, a_y: float, b_x: float, b_y: float, x: float, y: float) -> bool:
    """Whether the ray from (x, y) along x crosses the edge from a to b. A point is inside a ring if its ray crosses an
    odd number of edges."""
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


@inner
def segment_distance_m2(
    a: tuple[float, float], b: tuple[float, float], c: tuple[float, float], d: tuple[float, float]
) -> float:
    """Squared distance of the segments from a to b and from c to d, all (x, y); 0 where they cross."""
    if max(sides(a, b, c, d), sides(c, d, a, b)) < 0.0:
        return 0.0
    near = min(to_segment_m2(a, c, d), to_segment_m2(b, c, d))
    return min(near, min(to_segment_m2(c, a, b), to_segment_m2(d, a, b)))


@inner
def sides(
    a: tuple[float, float], b: tuple[float, float], c: tuple[float, float], d: tuple[float, float]
) -> float:
    """Below 0 if c and d are on different sides of the line through a and b, 0 if one of them is on it."""
    ux, uy = b[0] - a[0], b[1] - a[1]
    c_side, d_side = ux * (c[1] - a[1]) - uy * (c[0] - a[0]), ux * (d[1] - a[1]) - uy * (d[0] - a[0])
    return c_side * d_side


@inner
def to_segment_m2(p: tuple[float, float], a: tuple[float, float], b: tuple[float, float]) -> float:
    """Squared distance of p from the segment from a to b."""
    ux, uy = b[0] - a[0], b[1] - a[1]
    length2 = ux * ux + uy * uy
    share = 0.0
    if length2 > 0.0:
        share = min(max(((p[0] - a[0]) * ux + (p[1] - a[1]) * uy) / length2, 0.0), 1.0)
    dx, dy = p[0] - a[0] - share * ux, p[1] - a[1] - share * uy
    return dx * dx + dy * dy


@inner
def are_apart(
    a: tuple[float, float],
    b: tuple[float, float],
    c: tuple[float, float],
    d: tuple[float, float],
    most: float,
) -> bool:
    """Whether the boxes around the segments from a to b and from c to d are further apart than ``most``."""
    return (
        min(a[0], b[0]) > max(c[0], d[0]) + most
        or min(c[0], d[0]) > max(a[0], b[0]) + most
        or min(a[1], b[1]) > max(c[1], d[1]) + most
        or min(c[1], d[1]) > max(a[1], b[1]) + most
    )
