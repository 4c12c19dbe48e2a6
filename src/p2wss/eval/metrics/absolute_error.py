"""Mean absolute error of parameters, Table 1 of the paper (section 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class AbsoluteError:
    """Mean and standard deviation (of the population) of absolute errors, and the number of values pooled."""

    mean: float
    std: float
    count: int


def absolute_error(predicted: np.ndarray, truth: np.ndarray) -> AbsoluteError:
    """MAE ± standard deviation of the absolute errors of two arrays of equal shape, pooled over all values.

    Pairs with a NaN on either side are left out. Mean and deviation of nothing are NaN. Raises ``ValueError`` if the
    shapes differ.

    >>> absolute_error(np.array([1.0, 4.0]), np.array([2.0, 1.0]))
    AbsoluteError(mean=2.0, std=1.0, count=2)
    """
    predicted, truth = np.asarray(predicted, float), np.asarray(truth, float)
    if predicted.shape != truth.shape:
        raise ValueError(f"predicted has shape {predicted.shape}, truth {truth.shape}")
    return summarize_errors(np.abs(predicted - truth))


def vertex_error(predicted_xy_m: np.ndarray, truth_xy_m: np.ndarray) -> AbsoluteError:
    """Mean ± standard deviation of the Euclidean distances between corresponding vertices, both (n, 2).

    >>> vertex_error(np.array([[0.0, 0.0]]), np.array([[3.0, 4.0]])).mean
    5.0
    """
    difference = np.asarray(predicted_xy_m, float) - np.asarray(truth_xy_m, float)
    return summarize_errors(np.linalg.norm(difference, axis=1))


def summarize_errors(errors: np.ndarray) -> AbsoluteError:
    """Mean and standard deviation (of the population) of errors that are already absolute, without NaN."""
    errors = np.asarray(errors, float).ravel()
    errors = errors[~np.isnan(errors)]
    if not len(errors):
        return AbsoluteError(float("nan"), float("nan"), 0)
    return AbsoluteError(float(errors.mean()), float(errors.std()), len(errors))


def pooled(errors: Sequence[AbsoluteError]) -> AbsoluteError:
    """The error over the values of several samples together.

    >>> pooled([AbsoluteError(1.0, 0.0, 1), AbsoluteError(3.0, 0.0, 1)])
    AbsoluteError(mean=2.0, std=1.0, count=2)
    """
    errors = [error for error in errors if error.count]
    if not errors:
        return AbsoluteError(float("nan"), float("nan"), 0)
    mean, std, count = (
        np.array([getattr(error, name) for error in errors]) for name in ("mean", "std", "count")
    )
    total = float(np.average(mean, weights=count))
    variance = np.average(std**2 + (mean - total) ** 2, weights=count)
    return AbsoluteError(total, float(np.sqrt(variance)), int(count.sum()))
