"""A building's reconstruction is the same to the bit whatever other buildings, points and threads a run has."""

from __future__ import annotations

from typing import Any

import geopandas as gpd
import numpy as np
import pytest
import shapely
import torch
from places import ROOT
from shapely import affinity
from toy_clouds import LAMBERT, cleaned

from p2wss.clouds.reading import Cloud
from p2wss.config import Reconstruct
from p2wss.data.building import Reconstruction
from p2wss.fit import fitting
from p2wss.nets.predictor import load_predictor
from p2wss.reconstruction.area import window
from p2wss.reconstruction.pipeline import run
from p2wss.reconstruction.product import Predictor

NUM_BUILDINGS = 68


@pytest.fixture(scope="module")
def town() -> tuple[gpd.GeoDataFrame, Cloud]:
    """Houses, every third with a wing, in no regular grid, at the coordinates of Olemps."""
    draw = np.random.default_rng(3)
    shapes, parts = [], []
    for i in range(NUM_BUILDINGS):
        centre = np.array([664_300.0 + 29.3 * (i % 9), 6_360_700.0 + 31.7 * (i // 9)]) + draw.uniform(
            -2, 2, 2
        )
        length, width = draw.uniform(9, 15), draw.uniform(6, 9)
        shape = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
        if i % 3 == 0:
            shape = shape.union(shapely.box(0, 0, length / 3, width))
        shape = affinity.translate(affinity.rotate(shape, draw.uniform(0, 90), origin=(0, 0)), *centre)
        x, y = draw.uniform(centre - 11, centre + 11, (4000, 2)).T
        inside = shapely.contains_xy(shape, x, y)
        roof_m = draw.uniform(3, 6) + 0.7 * shapely.distance(shape.boundary, shapely.points(x, y))
        z = 560 + np.where(inside, roof_m, 0) + 0.03 * draw.standard_normal(len(x))
        shapes.append(shape)
        parts.append(np.column_stack([x, y, z, np.where(inside, 6, 2)])[: draw.integers(60, 4000)])
    x, y, z, classes = np.round(np.concatenate(parts), 2).T
    frame = gpd.GeoDataFrame(
        {"building_id": [f"b{i}" for i in range(NUM_BUILDINGS)]}, geometry=shapes, crs=LAMBERT
    )
    return frame, Cloud(x, y, z, classes.astype(np.uint8), LAMBERT)


def reconstructions(
    frame: gpd.GeoDataFrame, cloud: Cloud, predictor: Predictor | None, config: Reconstruct
) -> dict[str, tuple[object, ...]]:
    """Everything that is known of each building, to the bit, from the points in the run's window."""
    frame = cleaned(frame.reset_index(drop=True))
    x_min, y_min, x_max, y_max = window(frame)
    near = (cloud.x_m >= x_min) & (cloud.x_m <= x_max) & (cloud.y_m >= y_min) & (cloud.y_m <= y_max)
    columns = (cloud.x_m, cloud.y_m, cloud.z_m, cloud.classification)
    cloud = Cloud(*(column[near] for column in columns), LAMBERT)
    result: dict[str, tuple[object, ...]] = {}
    for row in run(frame, cloud, predictor, "tile", config):
        single = row.reconstruction
        arrays = (
            single.angle_deg,
            single.mesh.vertex_m,
            single.mesh.triangle,
            single.mesh.kind,
            *single.rings,
        )
        numbers = (single.eave_height_m, row.residual_m, row.visible_share)
        content = tuple(None if array is None else array.tobytes() for array in arrays)
        result[single.building_id] = (row.status, row.num_points, *map(repr, numbers), *content)
    return result


@pytest.mark.parametrize("method", ["fit", "point2wss"])
def test_a_building_does_not_depend_on_the_rest_of_the_run(
    town: tuple[gpd.GeoDataFrame, Cloud], method: str
) -> None:
    frame, cloud = town
    weights = ROOT / "models/point2wss.safetensors"
    predictor = None if method == "fit" else load_predictor(weights, "cpu")
    config = Reconstruct()
    together = reconstructions(frame, cloud, predictor, config)
    assert len(together) == NUM_BUILDINGS and {row[0] for row in together.values()} == {"ok"}
    assert len({row[-1] for row in together.values()}) == NUM_BUILDINGS
    draw = np.random.default_rng(1)
    num_threads = torch.get_num_threads()
    try:
        for rows, threads in ((range(12), 1), (draw.permutation(NUM_BUILDINGS)[:12], 2), ([37], 1)):
            torch.set_num_threads(threads)
            alone = reconstructions(frame.iloc[list(rows)], cloud, predictor, config)
            assert alone == {name: together[name] for name in alone}
            assert len(alone) == len(rows)
    finally:
        torch.set_num_threads(num_threads)


def test_a_building_does_not_depend_on_the_order_of_the_points(town: tuple[gpd.GeoDataFrame, Cloud]) -> None:
    """As when a survey comes in other tiles, or in files in another order."""
    frame, cloud = town
    order = np.random.default_rng(2).permutation(len(cloud))
    columns = (cloud.x_m, cloud.y_m, cloud.z_m, cloud.classification)
    shuffled = Cloud(*(column[order] for column in columns), LAMBERT)
    first = reconstructions(frame[:12], cloud, None, Reconstruct())
    assert reconstructions(frame[:12], shuffled, None, Reconstruct()) == first


def test_a_house_with_few_points_has_those_of_the_roofs_around_it_whatever_the_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shapes = [shapely.box(664_300 + 6 * i, 6_360_700, 664_306 + 6 * i, 6_360_709) for i in range(4)]
    low, high = np.array([664_299.0, 6_360_699.0]), np.array([664_325.0, 6_360_710.0])
    x, y = np.round(np.random.default_rng(5).uniform(low, high, (140, 2)).T, 2)
    inside = shapely.contains_xy(shapely.union_all(shapes), x, y)
    z = np.round(560 + np.where(inside, 4 + 0.8 * (4.5 - np.abs(y - 6_360_704.5)), 0), 2)
    cloud = Cloud(x, y, z, np.where(inside, 6, 2).astype(np.uint8), LAMBERT)
    frame = gpd.GeoDataFrame({"building_id": list("abcd")}, geometry=shapes, crs=LAMBERT)
    seen: dict[str, np.ndarray] = {}
    fit_building = fitting.fit_building

    def observed(task: Any) -> Reconstruction:
        seen[task.building.building_id] = task.building.around_m + task.building.position_m
        return fit_building(task)

    monkeypatch.setattr(fitting, "fit_building", observed)
    together = reconstructions(frame, cloud, None, Reconstruct())
    others = inside & ~shapely.contains_xy(shapes[1], x, y)
    beside = others & shapely.dwithin(shapes[1], shapely.points(x, y), 12.0)
    expected = sorted(map(tuple, np.column_stack([x, y, z])[beside].tolist()))
    assert sorted(map(tuple, np.round(seen["b"], 2).tolist())) == expected and len(expected) > 50
    assert reconstructions(frame.iloc[[1]], cloud, None, Reconstruct()) == {"b": together["b"]}
