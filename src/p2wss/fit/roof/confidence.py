"""The confidence of a fitted building: the expected share of its values, the eave height and an angle per edge, that
are within 0.5 m and 5 degrees of the truth.

The probability of each value is a logistic function of the evidence of the points (:mod:`p2wss.fit.roof.evidence`).
"""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from p2wss.fit.roof.evidence import Evidence

# coefficients of 1, log(margin), residual, log(points) and is_level; and of 1, residual and log(points):
# python benchmarks/confidence.py MANIFEST .. --model models/point2wss.safetensors --fit
EDGE = (2.73, 0.94, -3.95, 0.17, 1.99)
HEIGHT = (-0.89, -7.37, 2.05)
# added to a margin before its logarithm
_MIN_MARGIN_M = 0.05
# A building whose residual exceeds the first figure is of another kind than those that chose the coefficients: whatever
# the number of points, its share is at most 1 - 2 * (residual - 0.2).
_FAR_OFF_M, _DROP_PER_M = 0.2, 2.0


def share(evidence: Evidence) -> float:
    """The expected share of right values of one roof, over its edges and the eave height."""
    edges = expit(EDGE[0] + edge_terms(evidence) @ EDGE[1:])
    height = expit(HEIGHT[0] + height_terms(evidence) @ HEIGHT[1:])
    most = 1.0 - _DROP_PER_M * max(evidence.residual_m - _FAR_OFF_M, 0.0)
    return max(0.0, min(most, float((edges.sum() + height) / (len(edges) + 1))))


def edge_terms(evidence: Evidence) -> np.ndarray:
    """(k, 4): the terms of :data:`EDGE` after the constant, for each edge that was evaluated."""
    terms = np.empty((len(evidence.margin_m), 4))
    terms[:, 0] = np.log(np.maximum(evidence.margin_m, 0.0) + _MIN_MARGIN_M)
    terms[:, 1:] = evidence.residual_m, np.log(evidence.num_points + 1.0), evidence.is_level
    return terms


def height_terms(evidence: Evidence) -> np.ndarray:
    """(2,): the terms of :data:`HEIGHT` after the constant."""
    return np.array([evidence.residual_m, np.log(evidence.num_points + 1.0)])
