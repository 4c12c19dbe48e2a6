"""What is believed of a roof before its points are seen: a usual one, or what a network says.

It is weighed against the sum over the points, so that it decides where there are few. Of a network a little stays
however many there are: what stands on a roof moves all points of a place alike, and no number of them tells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2wss.fit.work import Prior

# a usual slope, and what it costs to leave it by a degree
_USUAL_DEG, _USUAL_DEGREE_COST_M = 38.0, 0.003
# against a network: a class of an edge e times less probable than the likeliest, a degree, a metre of the eave;
# metres of distance in the sum over the points, and in their mean
_CLASS_COST_M, _DEGREE_COST_M, _EAVE_COST = (0.0125, 0.002), (0.005, 0.0005), (0.075, 0.01)
# how sure of a class a network is at most
_LEAST_PROBABILITY = 1e-3


def believed(
    rings: Sequence[np.ndarray],
    num_points: int,
    angle_deg: np.ndarray | None = None,
    class_probability: np.ndarray | None = None,
    eave_z_m: float | None = None,
) -> Prior:
    """The prior of a roof over ``rings`` with so many points: with what a network tells or without. Of it: angles
    per edge (n,), probabilities of 0 degrees, 90 degrees and a slope (n, 3), the eave."""
    n = sum(map(len, rings))
    if angle_deg is None or class_probability is None or eave_z_m is None:
        cost = _USUAL_DEGREE_COST_M / num_points
        return Prior(np.zeros((n, 3)), np.full(n, _USUAL_DEG), cost, np.zeros(0), 0.0)
    surprise = -np.log(np.maximum(class_probability, _LEAST_PROBABILITY))
    surprise -= surprise.min(axis=1, keepdims=True)
    slope_deg = np.where((angle_deg > 0) & (angle_deg < 90), angle_deg, _USUAL_DEG)
    class_cost, degree_cost, eave_cost = (
        in_sum / num_points + in_mean for in_sum, in_mean in (_CLASS_COST_M, _DEGREE_COST_M, _EAVE_COST)
    )
    return Prior(class_cost * surprise, slope_deg, degree_cost, np.array([float(eave_z_m)]), eave_cost)
