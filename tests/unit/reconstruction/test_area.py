"""A building is the same in any batch, in any tile and alone, and moves only where the producer shows buildings."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pytest
import shapely
from shapely import affinity
from toy_clouds import LAMBERT, cleaned

from p2wss.clouds.reading import Cloud
from p2wss.config import Reconstruct
from p2wss.reconstruction import area as areas
from p2wss.reconstruction.area import Area, run_area
from p2wss.reconstruction.outputs.measures import party_wall_areas_m2
from p2wss.reconstruction.pipeline import Rows
from p2wss.reconstruction.points.cloud_index import CloudIndex
from p2wss.reconstruction.registration.register import AROUND, CLASSES
from p2wss.reconstruction.result import Result
from p2wss.reconstruction.running.spool import Spool
from p2wss.storage.features import Features

CONFIG = Reconstruct()
# how far the footprints lie beside the buildings
SHIFT_M = (1.1, -0.8)
# the producer classified buildings west of it
EAST_M = 664_700.0
NUM_HOUSES, NUM_IN_ROW = 24, 6
# the house around which the data end: its own edges show nothing
ALONE = 16


@pytest.fixture(scope="module")
def town() -> tuple[Features, Cloud]:
    """Two rows of houses that share walls, houses by themselves, some 500 m further east, and one without points."""
    draw = np.random.default_rng(5)
    shapes = []
    for row in range(2):
        for i in range(NUM_IN_ROW):
            x, y = 664_300 + 8.5 * i, 6_360_700 + 60.0 * row
            shapes.append(shapely.box(x, y, x + 8.5, y + 11 + row))
    for i in range(NUM_HOUSES - len(shapes)):
        x, y = 664_420 + 40 * (i % 3) + (500 if i >= 6 else 0), 6_360_700 + 45 * (i % 6 // 3)
        shapes.append(affinity.rotate(shapely.box(x, y, x + 12, y + 9), draw.uniform(0, 90)))
    roofs = [shape.buffer(0.3, join_style="mitre") for shape in shapes]
    all_roofs = shapely.union_all(roofs)
    parts = []
    for k, shape in enumerate(shapes):
        low_x, low_y, high_x, high_y = shape.buffer(15).bounds
        x, y = draw.uniform((low_x, low_y), (high_x, high_y), (6000, 2)).T
        on_roof = shapely.contains_xy(all_roofs, x, y)
        if k == ALONE:
            is_near = ~on_roof & shapely.dwithin(shape, shapely.points(x, y), 8.0)
            x, y, on_roof = x[~is_near], y[~is_near], on_roof[~is_near]
        z = 560 + np.where(on_roof, 5 + 0.1 * (k % 5), 0.0) + 0.02 * draw.standard_normal(len(x))
        classes = np.where(on_roof, np.where(x < EAST_M, 6, 1), 2)
        parts.append(np.column_stack([x, y, z, classes]))
    x, y, z, classes = np.round(np.concatenate(parts), 2).T
    moved = [affinity.translate(shape, *SHIFT_M) for shape in shapes]
    moved.append(shapely.box(665_000, 6_361_200, 665_010, 6_361_212))
    names = [f"b{i}" for i in range(len(moved))]
    stated = np.where(np.arange(len(moved)) == NUM_HOUSES, 7.0, np.nan)
    frame = gpd.GeoDataFrame({"building_id": names, "stated_height_m": stated}, geometry=moved, crs=LAMBERT)
    return cleaned(frame), Cloud(x, y, z, classes.astype(np.uint8), LAMBERT)


def results_of(
    town: tuple[Features, Cloud],
    folder: Path,
    is_chosen: np.ndarray | None = None,
    num_processes: int = 1,
    **options: bool,
) -> tuple[dict[str, Result], int]:
    """The results by the ids of buildings, and the number of batches."""
    features, cloud = town
    is_chosen = np.ones(len(features), bool) if is_chosen is None else is_chosen
    area = Area(features, is_chosen, CONFIG)
    with CloudIndex(area.boxes, folder) as points, Spool[Any](len(area.numbers), folder) as store:
        points.append(cloud)
        registers = area.registers(points)
        if options.get("registers"):
            registers[:] = CLASSES
        rows = Rows(len(area.numbers), store, None, "tile", CONFIG, None, num_processes)
        run_area(area, points, rows, registers)
        num_batches = len(list(area.batches(points)))
        results = list(store[: int(is_chosen.sum())])
    return {result.reconstruction.building_id: result for result in results}, num_batches


def content(value: Any) -> Any:
    """Everything that a result holds, to the bit."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, shapely.Polygon):
        return value.wkb
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [content(getattr(value, field.name)) for field in dataclasses.fields(value)]
    if isinstance(value, list | tuple):
        return [content(each) for each in value]
    return repr(value)


@pytest.fixture(scope="module")
def whole(town: tuple[Features, Cloud], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    results, num_batches = results_of(town, tmp_path_factory.mktemp("whole"))
    assert num_batches == 1
    assert list(results) == town[0]["building_id"].tolist()
    return {name: content(result) for name, result in results.items()}


@pytest.mark.parametrize(("limit", "num_processes"), [("MAX_FOOTPRINTS", 1), ("MAX_POINTS", 2)])
def test_batches_change_nothing(
    town: tuple[Features, Cloud],
    whole: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    limit: str,
    num_processes: int,
) -> None:
    monkeypatch.setattr(areas, limit, 4 if limit == "MAX_FOOTPRINTS" else 60_000)
    results, num_batches = results_of(town, tmp_path, num_processes=num_processes)
    assert num_batches >= 4
    assert {name: content(result) for name, result in results.items()} == whole


def test_a_part_gives_the_same_as_the_whole(
    town: tuple[Features, Cloud], whole: dict[str, Any], tmp_path: Path
) -> None:
    """Chosen as by a border through a row, whose walls are party walls on either side; and in the east, where nobody
    classified buildings."""
    features, _ = town
    for low, high in ((664_300, 664_325), (664_900, 664_970)):
        is_chosen = (features["centre_x_m"] >= low) & (features["centre_x_m"] <= high)
        assert 2 <= is_chosen.sum() < 10
        part, _ = results_of(town, tmp_path, is_chosen)
        assert list(part) == features["building_id"][is_chosen].tolist()
        for name, result in part.items():
            assert content(result) == whole[name]
        if low == 664_300:
            assert min(result.party_wall_area_m2 for result in part.values()) > 40


def test_footprints_move_less_readily_where_the_producer_shows_no_buildings(
    town: tuple[Features, Cloud], tmp_path: Path
) -> None:
    features, cloud = town
    results, _ = results_of(town, tmp_path)
    registrations = [result.registration for result in results.values()]
    for registration in registrations[:NUM_HOUSES]:
        assert registration and np.hypot(*np.add(registration.shift_m, SHIFT_M)) < 0.3
    # where its own edges show nothing, a house moves as those around it
    assert [each and each.source for each in registrations].index(AROUND) == ALONE
    # points that are nobody's buildings are taken for roofs
    assert [result.status for result in results.values()] == ["ok"] * NUM_HOUSES + ["flat"]
    # half a metre off
    nearer = np.array([affinity.translate(shape, -0.7, 0.5) for shape in features.geometry], object)
    town = dataclasses.replace(features, geometry=nearer), cloud
    is_east = (features["centre_x_m"] > EAST_M)[:NUM_HOUSES]
    for registers, stays in ((False, is_east), (True, is_east & False)):
        results, _ = results_of(town, tmp_path, registers=registers)
        lengths_m = [np.hypot(*each.registration.shift_m) for each in [*results.values()][:NUM_HOUSES]]
        assert np.array_equal(np.array(lengths_m) == 0, stays) and max(lengths_m) < 0.8


def test_ground_of_a_building_without_points(town: tuple[Features, Cloud], tmp_path: Path) -> None:
    """It is that of the nearest buildings with points, in whatever batch these are."""
    results, _ = results_of(town, tmp_path)
    far = results[f"b{NUM_HOUSES}"]
    assert far.reason == "height-from-attribute" and far.reconstruction.ground_z_m == pytest.approx(
        560, abs=0.1
    )


def test_party_walls_of_meshes_that_are_read_again(town: tuple[Features, Cloud], tmp_path: Path) -> None:
    results, _ = results_of(town, tmp_path)
    meshes = [result.reconstruction.placed_mesh for result in results.values()]
    expected = [result.party_wall_area_m2 for result in results.values()]
    assert party_wall_areas_m2(meshes).tolist() == expected
    assert sum(area > 40 for area in expected) == 2 * NUM_IN_ROW
