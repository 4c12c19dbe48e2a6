from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import shapely

from p2wss.config import Scenes
from p2wss.data.terrain import Terrain
from p2wss.scenes.cut import DRAWN_BY_NATURE_M, eave_heights, ground_heights
from p2wss.storage.features import Features, columns_of

CONFIG = Scenes()


def attributes(**columns: list[object]) -> Features:
    ids = [f"B{i}" for i in range(len(next(iter(columns.values()))))]
    table = pd.DataFrame({"building_id": ids, **columns})
    return Features(np.full(len(table), None), columns_of(table))


def test_fallbacks_are_used_in_order() -> None:
    nan = np.nan
    features = attributes(
        hauteur_m=[6.2, nan, 0.0, nan, nan, 0.4],
        altitude_minimale_toit_m=[99, 55.5, 58.0, nan, 50, nan],
        altitude_minimale_sol_m=[50, 50.0, 50.0, 50, 50, 50],
        num_floors=[9, 9, 9, 2, nan, 0],
        nature=["Indifférenciée"] * 4 + ["Silo", None],
        usage=[None] * 6,
    )
    height, source = eave_heights(features, CONFIG)
    assert list(source) == ["hauteur", "altitudes", "altitudes", "floors", "drawn", "drawn"]
    assert list(height[:4]) == pytest.approx([6.2, 5.5, 8.0, 6.0])
    low, high = DRAWN_BY_NATURE_M["Silo"]
    assert low <= height[4] <= high


def test_drawn_heights_depend_only_on_the_building() -> None:
    features = attributes(hauteur_m=[np.nan] * 5, usage=["Annexe"] * 5)
    height, source = eave_heights(features, CONFIG)
    assert set(source) == {"drawn"} and len(set(height)) > 1
    assert ((height >= 2.2) & (height <= 3.2)).all()
    backwards, _ = eave_heights(features.take(np.arange(5)[::-1]), CONFIG)
    np.testing.assert_array_equal(backwards[::-1], height)
    other, _ = eave_heights(features, Scenes(seed=1))
    assert not np.array_equal(other, height)


def test_without_any_height_column() -> None:
    height, source = eave_heights(attributes(nature=["Indifférenciée"]), CONFIG)
    assert list(source) == ["drawn"] and CONFIG.min_eave_height_m < height[0] < 10


def slope(nodata: bool = False) -> Terrain:
    """z = x / 10 on 1 m cells centred on whole metres, 0..40."""
    x = np.arange(41, dtype=np.float32)
    z = np.broadcast_to(x / 10, (41, 41)).copy()
    if nodata:
        z[:, 30:] = np.nan
    return Terrain(z, -0.5, 40.5, 1.0)


def test_ground_along_a_footprint_on_a_slope() -> None:
    square = shapely.box(10, 10, 20, 20)
    median, lowest, share = ground_heights(np.array([square]), slope())
    assert lowest[0] == pytest.approx(1.0)
    assert median[0] == pytest.approx(1.5, abs=0.06)
    assert share[0] == 1


def test_ground_agrees_with_dense_sampling() -> None:
    """A rotated L with a courtyard, compared with a much denser sampling of its edges."""
    shape = shapely.Polygon(
        [(3, 3), (33, 12), (30, 22), (15, 18), (12, 30), (2, 27)], [[(8, 10), (10, 14), (12, 11)]]
    )
    median, lowest, _ = ground_heights(np.array([shape]), slope())
    fine = shapely.get_coordinates(shapely.segmentize(shape.boundary, 0.01))[:, 0] / 10
    assert lowest[0] == pytest.approx(fine.min(), abs=0.01)
    assert median[0] == pytest.approx(np.median(fine), abs=0.05)


def test_missing_terrain() -> None:
    shapes = np.array(
        [
            shapely.box(25, 10, 35, 20),
            shapely.box(35, 10, 38, 20),
            shapely.Polygon(),
            shapely.box(90, 0, 99, 9),
        ]
    )
    median, _, share = ground_heights(shapes, slope(nodata=True))
    assert 0.2 < share[0] < 0.6 and list(share[1:]) == [0, 0, 0]
    assert np.isfinite(median[0]) and np.isnan(median[1:]).all()
