"""All tests are strict: an error in the code of a run, which users would only find in its log, is raised."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext

import geopandas as gpd
import numpy as np
import pytest
import shapely

import p2wss
from p2wss.reconstruction.running import processes
from p2wss.reconstruction.running.failures import Failures


@pytest.fixture(scope="session", autouse=True)
def strict() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Failures, "met", lambda self: nullcontext())
        yield


@pytest.fixture(scope="session", autouse=True)
def compiled_code_is_loaded(strict: None) -> None:
    """By a reconstruction without forks: each of those of the tests would load it in its own fork, which takes longer
    than to reconstruct a few houses."""
    east_m, north_m = 652_000, 6_861_000
    houses = [
        shapely.box(0, 0, 12, 8) | shapely.box(0, 0, 5, 14),
        shapely.box(20, 0, 28, 9),
        shapely.box(28, 0, 36, 9),
    ]
    x, y = np.random.default_rng(0).uniform((-5, -5), (41, 19), (6000, 2)).T
    inside = shapely.contains_xy(shapely.union_all(houses), x, y)
    z = np.where(inside, 4 + 0.7 * np.minimum(y, 9 - y), 0)
    point = np.column_stack([x + east_m, y + north_m, z, np.where(inside, 6, 2)])[
        (x < 28) | (np.arange(6000) % 50 == 0)
    ]
    frame = gpd.GeoDataFrame(geometry=houses, crs=2154).translate(east_m, north_m)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(processes, "get_all_start_methods", list)
        p2wss.reconstruct(point, frame)
