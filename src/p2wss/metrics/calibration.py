"""Whether a stated confidence is what it says: a reliability diagram and its mean gap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Bin:
    """Buildings with a confidence from ``low`` to ``high``: how many, what was stated, what was observed."""

    low: float
    high: float
    count: int
    stated: float
    observed: float


def reliability(confidence: np.ndarray, observed: np.ndarray, num_bins: int = 10) -> list[Bin]:
    """Bins of equal width over [0, 1] that have any value; mean confidence and mean of what was observed.

    confidence (n,) and observed (n,), shares from 0 to 1; pairs with a NaN are left out. The top bin holds 1.
    """
    confidence, observed = np.asarray(confidence, float), np.asarray(observed, float)
    known = ~(np.isnan(confidence) | np.isnan(observed))
    confidence, observed = confidence[known], observed[known]
    index = np.minimum((confidence * num_bins).astype(int), num_bins - 1)
    return [
        Bin(
            i / num_bins,
            (i + 1) / num_bins,
            int((index == i).sum()),
            float(confidence[index == i].mean()),
            float(observed[index == i].mean()),
        )
        for i in np.unique(index).tolist()
    ]


def calibration_error(bins: list[Bin]) -> float:
    """Mean gap between stated and observed, weighted by count (Naeini et al. 2015); NaN without bins.

    >>> calibration_error([Bin(0, 0.5, 1, 0.4, 0.0), Bin(0.5, 1, 3, 0.8, 1.0)])
    0.25
    """
    total = sum(own.count for own in bins)
    if not total:
        return float("nan")
    return round(sum(own.count * abs(own.stated - own.observed) for own in bins) / total, 12)
