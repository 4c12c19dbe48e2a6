"""The kinds of roofs that are tried for a part beside the one that the search finds, which has level eaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from p2wss.fit.parts.roofs import Roof
from p2wss.fit.roof.fitter import FittedRoof, Fitter
from p2wss.fit.roof.prior import with_slope_cost
from p2wss.fit.roof.work import Prior
from p2wss.fit.settings import NOISE_M, Effort

# From a roof with level eaves, its points (m, 3) in even order, the effort, the prior and what a slope costs in the
# sum: a roof of this kind, None without one. Its loss is that with the prior.
Kind = Callable[[Fitter, FittedRoof, np.ndarray, Effort, Prior, float], Roof | None]


def uneven_eaves(
    fitter: Fitter, roof: FittedRoof, point_m: np.ndarray, effort: Effort, prior: Prior, slope_cost_m: float
) -> FittedRoof | None:
    """A roof with eaves at different heights, where the points are far enough off to pay for one."""
    excess_m = roof.total_loss_m - NOISE_M * len(point_m)
    # it has two slopes at least, and costs as much as one more
    if roof.loss_m < NOISE_M or excess_m + roof.num_slopes * slope_cost_m <= 3 * slope_cost_m:
        return None
    slope_prior = with_slope_cost(prior, slope_cost_m, len(point_m), len(roof.angle_deg))
    uneven = fitter.fit_eaves(roof, point_m, effort, slope_prior)
    return None if uneven is None else replace(uneven, loss_m=fitter.loss(uneven, point_m, prior))


KINDS: tuple[Kind, ...] = (uneven_eaves,)
