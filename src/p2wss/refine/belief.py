"""What is believed of a roof before its points are seen: a usual one, or what a network says.

It is weighed against the sum over the points, so that it decides where there are few, and fades with more.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2wss.refine.work import Prior

# a usual slope, and what it costs to leave it by a degree
_USUAL_DEG, _USUAL_DEGREE_COST_M = 38.0, 0.003
# against the network: another class for an edge, a degree, a metre
_CLASS_COST_M, _DEGREE_COST_M, _EAVE_COST = 0.3, 0.02, 0.3


def believed(
    rings: Sequence[np.ndarray],
    num_points: int,
    angle_deg: np.ndarray | None = None,
    eave_z_m: float | None = None,
) -> Prior:
    """The prior of a roof over ``rings`` with so many points: with the angles per edge and the eave that a
    network tells, or without."""
    n = sum(map(len, rings))
    if angle_deg is None or eave_z_m is None:
        cost = _USUAL_DEGREE_COST_M / num_points
        return Prior(np.zeros((n, 3)), np.full(n, _USUAL_DEG), cost, np.zeros(0), 0.0)
    kind = np.where(angle_deg == 0, 0, np.where(angle_deg == 90, 1, 2))
    class_cost = np.full((n, 3), _CLASS_COST_M / num_points)
    class_cost[np.arange(n), kind] = 0.0
    slope = np.where(kind == 2, angle_deg, _USUAL_DEG)
    degree_cost, eave_cost = _DEGREE_COST_M / num_points, _EAVE_COST / num_points
    return Prior(class_cost, slope, degree_cost, np.array([float(eave_z_m)]), eave_cost)
