"""Heights of points above the upper surface of a mesh."""

from __future__ import annotations

import numpy as np


def surface_height_m(xy_m: np.ndarray, vertex_m: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Height of the highest triangle at each place of the plan: (n,), NaN beside the mesh.

    xy_m (n, 2), vertex_m (v, 3), triangle (t, 3). Vertical triangles are left out.
    """
    xy = np.asarray(xy_m, float)
    highest = np.full(len(xy), np.nan)
    for a, b, c in np.asarray(vertex_m, float)[np.asarray(triangle, int)]:
        u, v, w = b - a, c - a, xy - a[:2]
        area = u[0] * v[1] - u[1] * v[0]
        # on a nearly vertical triangle, rounding a place moves its height at will
        if abs(area) > 1e-9 * np.linalg.norm(np.cross(u, v)):
            s = (w[:, 0] * v[1] - w[:, 1] * v[0]) / area
            t = (u[0] * w[:, 1] - u[1] * w[:, 0]) / area
            over = (s >= -1e-9) & (t >= -1e-9) & (s + t <= 1 + 1e-9)
            highest[over] = np.fmax(highest[over], (a[2] + s * u[2] + t * v[2])[over])
    return highest


def height_rmse_m(difference_m: np.ndarray) -> float:
    """Root mean square of the differences that are not NaN; NaN without any.

    >>> height_rmse_m(np.array([3.0, np.nan, -4.0, 0.0]))  # sqrt(25 / 3)
    2.886751345948129
    """
    difference = np.asarray(difference_m, float)
    difference = difference[~np.isnan(difference)]
    return float(np.sqrt((difference**2).mean())) if len(difference) else float("nan")
