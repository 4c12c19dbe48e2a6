"""The search for the partition: cuts that need a second one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely

from p2wss.fit.parts.partition import fit_parts
from p2wss.fit.parts.parts import PartFitter
from p2wss.fit.roof.fitter import Fitter
from p2wss.fit.roof.work import NO_PRIOR
from p2wss.fit.settings import Cutting, Effort, Limits

RING = np.array([[0, 0], [14, 0], [14, 10], [0, 10.0]])


def flat_roof(seed: int) -> np.ndarray:
    """900 points, 6 m high."""
    xy_m = np.random.default_rng(seed).uniform((0, 0), (14, 10), (900, 2))
    return np.column_stack([xy_m, 6.0 + np.random.default_rng(3).normal(0, 0.03, 900)])


@pytest.mark.parametrize("width_m", [4.0, 5.0, 6.0])
@pytest.mark.parametrize("seed", range(4))
def test_an_annex_in_a_corner_is_found(seed: int, width_m: float) -> None:
    """The first of the two cuts that it takes gains nothing by itself."""
    point_m = flat_roof(seed)
    is_annex = (point_m[:, 0] > 14 - width_m) & (point_m[:, 1] > 11 - width_m)
    point_m[is_annex, 2] = 3.0
    fitter = Fitter(Limits())
    parts = fit_parts(fitter, [RING], point_m, Effort(), Cutting())
    low, high = sorted(parts, key=lambda part: part.eave_z_m)
    assert [len(part.rings[0]) for part in (low, high)] == [4, 6]
    assert shapely.Polygon(low.rings[0]).area == pytest.approx(width_m * (width_m - 1), rel=0.25)
    without = fit_parts(fitter, [RING], point_m, Effort(), Cutting(loss_share=0.0))
    assert len(without) == 1


def test_parts_stay_apart_in_memory() -> None:
    """Parts are told apart by identity, not by values: the search keeps what it knows of pairs of them."""
    fitter = PartFitter(Fitter(Limits()), Effort(), Cutting(), 900)
    part = fitter.whole([RING], flat_roof(0), (), NO_PRIOR)
    assert part is not None
    assert len({part, replace(part)}) == 2
