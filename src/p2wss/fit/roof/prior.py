"""The prior of a roof: what is assumed of it before its points are seen, from a network or what is usual.

It is weighed against the sum of the residuals, so that it decides where there are few points. A little of the weight
of a network stays however many points there are: an object on a roof shifts all points of a place alike, and more
points of the same kind do not reveal it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from p2wss.fit.settings import USUAL_SLOPE_DEG

# what each degree of difference from the usual slope costs
_USUAL_DEGREE_COST_M = 0.003
# What it costs to differ from a network: by a class of an edge that is e times less probable than the likeliest, by a
# degree, by a metre of the eave height; metres of distance in the sum over the points, and in their mean.
_CLASS_COST_M, _DEGREE_COST_M, _EAVE_COST = (0.0125, 0.002), (0.005, 0.0005), (0.075, 0.01)
# smaller probabilities count as this one: no network is surer than that
_MIN_PROBABILITY = 1e-3
# larger differences cost no more than these, which is where a different roof begins
_MAX_DIFFERENCE_DEG, _MAX_DIFFERENCE_M = 20.0, 3.0


@dataclass(frozen=True)
class Prior:
    """What each possible roof of n edges costs before its points are seen, in metres of loss.

    class_cost_m: (n, 3), for each edge the cost of 0 degrees, of 90 degrees and of a slope. slope_deg: (n,), the
    expected slope. degree_cost_m: for each degree of difference from it. eave_z_m: the expected height. eave_cost: for
    each metre of difference from it.
    """

    class_cost_m: np.ndarray
    slope_deg: np.ndarray
    degree_cost_m: float
    eave_z_m: float = 0.0
    eave_cost: float = 0.0

    def cost_m(self, angle_deg: np.ndarray, eave_z_m: np.ndarray) -> np.ndarray:
        """The cost (k,) of roofs. angle_deg: (k, n). eave_z_m: (k,)."""
        is_gable, is_slope = angle_deg == 90.0, (angle_deg > 0.0) & (angle_deg < 90.0)
        edge = np.arange(angle_deg.shape[1])
        cost_m = self.class_cost_m[edge, np.where(is_slope, 2, is_gable)]
        off_deg = np.minimum(np.abs(angle_deg - self.slope_deg), _MAX_DIFFERENCE_DEG)
        cost_m = cost_m + np.where(is_slope, self.degree_cost_m * off_deg, 0.0)
        off_m = np.minimum(np.abs(eave_z_m - self.eave_z_m), _MAX_DIFFERENCE_M)
        return cost_m.sum(axis=1) + self.eave_cost * off_m


def make_prior(
    rings: Sequence[np.ndarray],
    num_points: int,
    angle_deg: np.ndarray | None = None,
    class_probability: np.ndarray | None = None,
    eave_z_m: float | None = None,
) -> Prior:
    """The prior of a roof over ``rings`` that has ``num_points`` points.

    With values of a network: angle_deg (n,), one per edge; class_probability (n, 3): of 0 degrees, 90 degrees and a
    slope; eave_z_m. If any of them is missing, the prior is that of a usual roof.
    """
    n = sum(map(len, rings))
    if angle_deg is None or class_probability is None or eave_z_m is None:
        return Prior(np.zeros((n, 3)), np.full(n, USUAL_SLOPE_DEG), _USUAL_DEGREE_COST_M / num_points)
    surprise = -np.log(np.maximum(class_probability, _MIN_PROBABILITY))
    surprise -= surprise.min(axis=1, keepdims=True)
    slope_deg = np.where((angle_deg > 0) & (angle_deg < 90), angle_deg, USUAL_SLOPE_DEG)
    class_cost, degree_cost, eave_cost = (
        in_sum / num_points + in_mean for in_sum, in_mean in (_CLASS_COST_M, _DEGREE_COST_M, _EAVE_COST)
    )
    return Prior(class_cost * surprise, slope_deg, degree_cost, float(eave_z_m), eave_cost)
