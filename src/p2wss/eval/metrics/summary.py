"""Mean, quartiles and deviation of a sample, the rows of Table 2, with a bootstrap interval of the mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

# resampled values in memory at a time
_MAX_DRAWS = 1 << 19


@dataclass(frozen=True)
class Summary:
    """Statistics of ``count`` values; ``low`` and ``high`` bound the mean with 95 % confidence."""

    count: int
    mean: float
    q1: float
    median: float
    q3: float
    std: float
    low: float
    high: float


def summarize(values: np.ndarray, generator: np.random.Generator, num_resamples: int = 1000) -> Summary:
    """Summary of the values that are not NaN; all NaN if there is none.

    The interval is the percentile bootstrap (Efron 1979) over ``num_resamples`` draws with replacement; of a
    single value it is that value.
    """
    values = np.asarray(values, float)
    values = values[~np.isnan(values)]
    if not len(values):
        return Summary(0, *[float("nan")] * 7)
    q1, median, q3 = np.quantile(values, [0.25, 0.5, 0.75])
    low, high = values[0], values[0]
    if len(values) > 1:
        low, high = stats.bootstrap(
            (values,),
            np.mean,
            n_resamples=num_resamples,
            # the draws are the same in pieces of any size
            batch=max(_MAX_DRAWS // len(values), 1),
            method="percentile",
            rng=generator,
        ).confidence_interval
    statistics = (values.mean(), q1, median, q3, values.std(), low, high)
    return Summary(len(values), *map(float, statistics))
