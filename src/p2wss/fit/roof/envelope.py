"""The roof over a convex polygon without its skeleton: over every point the lowest of the planes of its slopes.

A wavefront that starts convex stays the intersection of the half-planes behind its edges: an edge that falls behind
the corner of its neighbours never reappears. So the kernel's roof is the lower envelope of the planes, cut at the
maximum height. If any edge has 0 degrees, or all edges have 90 degrees, the roof is flat.
"""

from __future__ import annotations

import numpy as np

from p2wss.fit.roof.work import FitWork, Polygon, Problem
from p2wss.skeleton.compiled import allocating, embedded
from p2wss.skeleton.footprint import MAX_SLOPE_DEG, MIN_SLOPE_DEG
from p2wss.skeleton.queries import CUT, FLAT, OUTSIDE

# sine of the turn below which a corner is reflex, as in the kernel
_REFLEX = -1e-9
# a point that is outside by no more than a rounding error is on the boundary
_OUTSIDE_M = -1e-9


@allocating
def inward_distances(polygon: Polygon, x: np.ndarray, y: np.ndarray):
    """Metres from the line of each edge to points, positive inwards, and in one more row the smallest of
    them: float64 (n + 1, m), or (0, 0) unless the polygon is convex. x, y: relative to its first vertex."""
    xy_m = polygon.xy_m
    n, m = len(xy_m), len(x)
    if len(polygon.ring_offset) != 2:
        return np.zeros((0, 0))
    dir_x, dir_y = np.empty(n), np.empty(n)
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        dx, dy = xy_m[j, 0] - xy_m[i, 0], xy_m[j, 1] - xy_m[i, 1]
        length = np.hypot(dx, dy)
        dir_x[i], dir_y[i] = dx / length, dy / length
    for i in range(n):
        j = i + 1 if i + 1 < n else 0
        if not dir_x[i] * dir_y[j] - dir_y[i] * dir_x[j] >= _REFLEX:
            return np.zeros((0, 0))
    result = np.empty((n + 1, m))
    for k in range(m):
        result[n, k] = np.inf
    for i in range(n):
        start_x, start_y = xy_m[i, 0] - xy_m[0, 0], xy_m[i, 1] - xy_m[0, 1]
        for k in range(m):
            result[i, k] = (y[k] - start_y) * dir_x[i] - (x[k] - start_x) * dir_y[i]
            result[n, k] = min(result[n, k], result[i, k])
    return result


@embedded
def lower_envelope(problem: Problem, work: FitWork, angle_deg: np.ndarray):
    """As :func:`p2wss.skeleton.queries.assign`, but from :func:`inward_distances`, with the tangents and cosines of the
    angles in ``work``. Also writes the height of the roof above the eave to ``work.rise`` and the z of its unit normal
    to ``work.slant``, NaN outside. Returns False if there is an angle that the kernel refuses."""
    inward_m, max_roof_height_m = problem.inward_m, problem.max_roof_height_m
    n, m = len(inward_m) - 1, inward_m.shape[1]
    face, distance, rise, slant = work.face[:m], work.distance[:m], work.rise[:m], work.slant[:m]
    is_flat, has_slope = False, False
    for e in range(n):
        angle = angle_deg[e]
        if angle == 0.0:
            is_flat = True
        elif angle != 90.0:
            if not MIN_SLOPE_DEG <= angle <= MAX_SLOPE_DEG:
                return False
            has_slope = True
    # without branches, so that several points are evaluated at once
    if is_flat or not has_slope:
        for k in range(m):
            face[k], distance[k], rise[k], slant[k] = FLAT, 0.0, 0.0, 1.0
    else:
        for k in range(m):
            face[k], distance[k], rise[k], slant[k] = CUT, max_roof_height_m, max_roof_height_m, 1.0
        for e in range(n):
            t, c = work.tangent[e], work.cosine[e]
            if t > 0.0:
                for k in range(m):
                    height = t * inward_m[e, k]
                    is_lower = height < rise[k]
                    rise[k] = height if is_lower else rise[k]
                    face[k] = e if is_lower else face[k]
                    distance[k] = inward_m[e, k] if is_lower else distance[k]
                    slant[k] = c if is_lower else slant[k]
    for k in range(m):
        is_outside = inward_m[n, k] < _OUTSIDE_M
        face[k] = OUTSIDE if is_outside else face[k]
        distance[k] = 0.0 if is_outside else distance[k]
        rise[k] = 0.0 if is_outside else rise[k]
        slant[k] = np.nan if is_outside else slant[k]
    return True
