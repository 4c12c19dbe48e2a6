"""How much of a fitted building is right: the expected share of its numbers, the eave height and an angle per edge,
that are within 0.5 m and 5 degrees of the truth.

Each number has a logistic formula of what the points say for it (:mod:`p2wss.fit.evidence`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from scipy.special import expit

from p2wss.fit.evidence import Evidence, evidence
from p2wss.fit.one_height import Fitter, OneHeight

# coefficients of 1, log(margin), residual, log(points) and "level"; and of 1, residual and log(points):
# python benchmarks/confidence.py MANIFEST .. --model models/point2wss.safetensors --fit
EDGE = (2.73, 0.94, -3.95, 0.17, 1.99)
HEIGHT = (-0.89, -7.37, 2.05)
# added to a margin before its logarithm
_LEAST_M = 0.05
# a building whose points are further off is of another kind than those that chose the coefficients: however many points
# say the same, no more than 1 - 2 * (residual - 0.2) is right
_FAR_OFF_M, _LOST_PER_M = 0.2, 2.0


def expected_share(
    fitter: Fitter,
    parts: Sequence[OneHeight],
    point_m: np.ndarray,
    class_probability: np.ndarray | None = None,
) -> float:
    """The expected share, from 0 to 1, of the numbers of a fitted building that are right; of several parts the mean,
    weighed by their points.

    parts: in the frame of the points (m, 3) on the roof. class_probability: what a network said of the edges of a
    building of one part, (n, 3): 0 degrees, 90 degrees and a slope.
    """
    if len(parts) == 1:
        return share(evidence(fitter, parts[0], point_m, class_probability))
    total, weight = 0.0, 0.0
    for part in parts:
        polygon = shapely.Polygon(part.rings[0], part.rings[1:])
        own = point_m[shapely.contains_xy(polygon, point_m[:, 0], point_m[:, 1])]
        total += (len(own) + 1) * share(evidence(fitter, part, own))
        weight += len(own) + 1
    return total / weight


def share(found: Evidence) -> float:
    """The expected share of right numbers of one roof, over its edges and the height."""
    edges = expit(EDGE[0] + edge_terms(found) @ EDGE[1:])
    height = expit(HEIGHT[0] + height_terms(found) @ HEIGHT[1:])
    most = 1.0 - _LOST_PER_M * max(found.residual_m - _FAR_OFF_M, 0.0)
    return max(0.0, min(most, float((edges.sum() + height) / (len(edges) + 1))))


def edge_terms(found: Evidence) -> np.ndarray:
    """(k, 4): what the coefficients :data:`EDGE` but the first are of."""
    terms = np.empty((len(found.margin_m), 4))
    terms[:, 0] = np.log(np.maximum(found.margin_m, 0.0) + _LEAST_M)
    terms[:, 1:] = found.residual_m, np.log(found.num_points + 1.0), found.level
    return terms


def height_terms(found: Evidence) -> np.ndarray:
    """(2,): what the coefficients :data:`HEIGHT` but the first are of."""
    return np.array([found.residual_m, np.log(found.num_points + 1.0)])
