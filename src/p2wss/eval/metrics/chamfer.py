"""Chamfer distance between two point sets, the CD of Table 2 (section 5.3 of the paper)."""

import numpy as np
from scipy.spatial import cKDTree


def chamfer_distance_m(point_m: np.ndarray, sample_m: np.ndarray) -> float:
    """Half the sum of the two mean nearest-neighbour distances, metres; NaN if either set is empty.

    point_m (n, 3), sample_m (m, 3). Distances are not squared. The value of two samplings of one surface is
    not zero: it is about 0.5 / sqrt(points per square metre) in each direction.

    >>> chamfer_distance_m(np.array([[0.0, 0, 0]]), np.array([[3.0, 4, 0], [0, 1, 0]]))
    2.0
    """
    if not len(point_m) or not len(sample_m):
        return float("nan")
    forth = cKDTree(sample_m).query(point_m)[0].mean()
    back = cKDTree(point_m).query(sample_m)[0].mean()
    return float((forth + back) / 2)
