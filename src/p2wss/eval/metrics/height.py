"""Heights of points above the upper surface of a mesh."""

import numpy as np

from p2wss.mesh.surface import topmost


def height_rmse_m(point_m: np.ndarray, corner_m: np.ndarray) -> float:
    """Root mean square of the heights of points (n, 3) above the topmost triangle at their place. Points beside the
    mesh are left out; NaN if no other point is left.

    corner_m: of the triangles (t, 3, 3), counter-clockwise seen from outside.

    >>> height_rmse_m(np.array([[1, 1, 4], [1, 1, -3], [9, 9, 0.0]]), np.array([[[0, 0, 1], [4, 0, 1], [0, 4, 1.0]]]))
    3.5355339059327378
    """
    _, surface_z_m = topmost(np.ascontiguousarray(corner_m), np.ascontiguousarray(point_m))
    difference_m = (point_m[:, 2] - surface_z_m)[np.isfinite(surface_z_m)]
    return float(np.sqrt((difference_m**2).mean())) if len(difference_m) else float("nan")
