"""Whether a stated confidence is what it says, and tells good from bad: a reliability diagram and a few numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats


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


@dataclass(frozen=True)
class Calibration:
    """Of the stated confidence of ``count`` buildings. stated, observed: means. gap: :func:`calibration_error`.
    auc: how often a building that is all right is stated higher than one that is not, 0.5 is chance. correlation: of
    stated and observed. NaN where nothing varies."""

    bins: list[Bin]
    count: int
    stated: float
    observed: float
    gap: float
    auc: float
    correlation: float


def calibration(confidence: np.ndarray, observed: np.ndarray) -> Calibration:
    """confidence (n,) and observed (n,), shares from 0 to 1; pairs with a NaN are left out."""
    confidence, observed = np.asarray(confidence, float), np.asarray(observed, float)
    known = ~(np.isnan(confidence) | np.isnan(observed))
    confidence, observed = confidence[known], observed[known]
    bins = reliability(confidence, observed)
    mean = [float(values.mean()) if len(values) else float("nan") for values in (confidence, observed)]
    varied = len(confidence) > 1 and np.ptp(confidence) > 0 and np.ptp(observed) > 0
    correlation = float(np.corrcoef(confidence, observed)[0, 1]) if varied else float("nan")
    auc = rank_auc(confidence, observed == 1.0)
    return Calibration(bins, len(confidence), mean[0], mean[1], calibration_error(bins), auc, correlation)


def rank_auc(score: np.ndarray, good: np.ndarray) -> float:
    """Share of pairs of a good and a bad one in which the good one has the higher score, ties count half (Mann and
    Whitney 1947); NaN without such a pair.

    >>> rank_auc(np.array([0.9, 0.8, 0.8, 0.1]), np.array([True, True, False, False]))
    0.875
    """
    num_good = int(good.sum())
    num_pairs = num_good * (len(good) - num_good)
    if not num_pairs:
        return float("nan")
    return float((stats.rankdata(score)[good].sum() - num_good * (num_good + 1) / 2) / num_pairs)
