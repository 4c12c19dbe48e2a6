"""Whether a stated confidence is calibrated, and whether it ranks good above bad: a reliability diagram and scores."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats


@dataclass(frozen=True)
class Bin:
    """Buildings with a confidence from ``low`` to ``high``: their number, mean stated and mean observed share."""

    low: float
    high: float
    count: int
    stated: float
    observed: float


def reliability(confidence: np.ndarray, observed: np.ndarray, num_bins: int = 10) -> list[Bin]:
    """The bins of equal width over [0, 1] that hold any building, with mean confidence and mean observed share.

    confidence (n,) and observed (n,), from 0 to 1; pairs with a NaN are left out. The top bin includes 1.
    """
    confidence, observed = _without_nan(confidence, observed)
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
    total = sum(b.count for b in bins)
    if not total:
        return float("nan")
    return round(sum(b.count * abs(b.stated - b.observed) for b in bins) / total, 12)


@dataclass(frozen=True)
class Calibration:
    """How good the stated confidence of ``count`` buildings is.

    stated, observed: means. gap: :func:`calibration_error`. auc: :func:`rank_auc` of the buildings whose observed
    share is 1 against the others. correlation: Pearson's, of stated and observed. NaN where nothing varies.
    """

    bins: list[Bin]
    count: int
    stated: float
    observed: float
    gap: float
    auc: float
    correlation: float


def calibration(confidence: np.ndarray, observed: np.ndarray) -> Calibration:
    """Calibration of confidence (n,) against observed (n,), both from 0 to 1; pairs with a NaN are left out."""
    confidence, observed = _without_nan(confidence, observed)
    bins = reliability(confidence, observed)
    mean = [float(values.mean()) if len(values) else float("nan") for values in (confidence, observed)]
    varied = len(confidence) > 1 and np.ptp(confidence) > 0 and np.ptp(observed) > 0
    correlation = float(np.corrcoef(confidence, observed)[0, 1]) if varied else float("nan")
    auc = rank_auc(confidence, observed == 1.0)
    return Calibration(bins, len(confidence), mean[0], mean[1], calibration_error(bins), auc, correlation)


def rank_auc(score: np.ndarray, good: np.ndarray) -> float:
    """Area under the ROC curve: how often a good building has a higher score than a bad one, ties count half.

    score (n,), good bool (n,). 0.5 is chance; NaN if all are good or all are bad. Computed from the U statistic of
    Mann and Whitney (1947).

    >>> rank_auc(np.array([0.9, 0.8, 0.8, 0.1]), np.array([True, True, False, False]))
    0.875
    """
    good = np.asarray(good, bool)
    num_pairs = int(good.sum()) * int((~good).sum())
    if not num_pairs:
        return float("nan")
    # only the statistic is used; the asymptotic p-value is the cheapest
    return float(stats.mannwhitneyu(score[good], score[~good], method="asymptotic").statistic / num_pairs)


def _without_nan(confidence: np.ndarray, observed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    confidence, observed = np.asarray(confidence, float), np.asarray(observed, float)
    valid = ~(np.isnan(confidence) | np.isnan(observed))
    return confidence[valid], observed[valid]
