"""The search for the partition: cuts that need a second one, and parts that are divided anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely

from p2wss.fit.parts.partition import _Search, fit_parts
from p2wss.fit.parts.parts import Cutting, PartFitter
from p2wss.fit.points import even_order
from p2wss.fit.roof.fitter import Effort, Fitter, Limits
from p2wss.fit.roof.work import NO_PRIOR

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


@pytest.mark.parametrize(("division_share", "is_divided"), [(0.3, True), (0.0, False), (20.0, False)])
def test_two_parts_are_divided_along_a_better_line(division_share: float, is_divided: bool) -> None:
    """The step runs along x = 9, and the parts have been cut along x = 6."""
    point_m = flat_roof(0)
    point_m[point_m[:, 0] > 9, 2] = 3.0
    point_m = point_m[even_order(point_m)]
    cutting = Cutting(division_share=division_share)
    fitter = PartFitter(Fitter(Limits()), Effort(), cutting, len(point_m))
    sides = []
    for low_m, high_m in ((0.0, 6.0), (6.0, 14.0)):
        ring = np.clip(RING, (low_m, 0), (high_m, 10))
        is_inside = (point_m[:, 0] >= low_m) & (point_m[:, 0] < high_m)
        part = fitter.whole([ring], point_m[is_inside], (), NO_PRIOR)
        assert part is not None
        sides.append(part)
    search = _Search(fitter, sides[0])
    search.parts = sides
    assert not search.merge()
    assert search.divide_anew() == is_divided
    cost_m = sum(part.cost_m for part in search.parts)
    if is_divided:
        assert cost_m < 0.2 * sum(part.cost_m for part in sides)
        east = max(search.parts, key=lambda part: part.roof.rings[0][:, 0].min())
        np.testing.assert_allclose(east.roof.rings[0].min(axis=0), (9, 0), atol=0.2)
        np.testing.assert_allclose(east.roof.rings[0].max(axis=0), (14, 10))
        assert sum(part.point_m.shape[1] for part in search.parts) == len(point_m)
        # there is nothing left to gain
        assert not search.divide_anew()
    else:
        assert search.parts == sides


def test_parts_stay_apart_in_memory() -> None:
    """Parts are told apart by identity, not by values: the search keeps what it knows of pairs of them."""
    fitter = PartFitter(Fitter(Limits()), Effort(), Cutting(), 900)
    part = fitter.whole([RING], flat_roof(0), (), NO_PRIOR)
    assert part is not None
    assert len({part, replace(part)}) == 2
