"""Towns of houses of several bodies: their true roofs are closed, under the points and over the footprints."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import shapely
import towns
from drawn_towns.files import ROOFS, write_town
from drawn_towns.wings import SHAPES, draw_terraces, draw_wings, true_solids

import p2wss
from p2wss.mesh import Mesh
from p2wss.mesh.surface import topmost
from p2wss.reconstruction.scene import Scene, SceneBuilding
from p2wss.towns import FOOTPRINTS
from p2wss.towns.ign import building_id

SEED = 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wings")
    write_town(folder, SEED, "wings", with_lidar=False)
    return folder


@pytest.fixture(scope="module")
def roofs(folder: Path) -> Scene:
    return p2wss.read(folder / ROOFS)


def solid_of(building: SceneBuilding) -> Mesh:
    assert building.solid is not None
    return building.solid


def test_every_footprint_has_a_closed_true_roof(folder: Path, roofs: Scene) -> None:
    footprints = gpd.read_file(folder / FOOTPRINTS)
    assert list(roofs) == footprints["cleabs"].tolist() and len(roofs) > 80
    assert all(solid_of(building).is_closed for building in roofs.values())
    assert set(Counter(building.attributes["shape"] for building in roofs.values())) == set(SHAPES)
    # errors of the map are smaller than the distance at which an edge is false
    for shape, building in zip(footprints.geometry, roofs.values(), strict=True):
        ring = shapely.convex_hull(shapely.MultiPoint(solid_of(building).vertex_m[:, :2]))
        assert shapely.hausdorff_distance(shapely.convex_hull(shapely.force_2d(shape)), ring) < 0.75


def test_the_true_roof_is_the_highest_of_the_bodies(roofs: Scene) -> None:
    town = draw_wings(np.random.Generator(np.random.PCG64(SEED)))
    rng = np.random.default_rng(1)
    for index, building in enumerate(town[::7]):
        solid = solid_of(roofs[building_id(7 * index)])
        low_x, low_y, high_x, high_y = building.footprint.bounds
        xy = rng.uniform((low_x, low_y), (high_x, high_y), (200, 2))
        z = np.full(len(xy), np.nan)
        for wing in building.wings:
            inside = shapely.contains_xy(shapely.Polygon(wing.outline), *xy.T) & (wing.detail == "")
            z[inside] = np.fmax(z, building.floor_m + wing.eave_m + wing.rise_m(xy))[inside]
        found = topmost(np.ascontiguousarray(solid.corner_m), np.column_stack([xy, z]))[1]
        both = np.isfinite(z) & np.isfinite(found)
        # a point within a millimetre of a step may be on either side
        assert both.sum() > 40 and np.mean(np.abs(z - found)[both] < 0.01) > 0.98


def test_the_command_writes_the_same_bytes(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["towns.py", "--kind", "wings", "--seed", str(SEED), "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", words)
    towns.main()
    for name in (ROOFS, FOOTPRINTS):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


def test_most_terraced_houses_have_a_lower_part_and_many_footprints_do_not_show_it() -> None:
    town = draw_terraces(np.random.Generator(np.random.PCG64(SEED)))
    low = [any(wing.ridge_m < house.wings[0].eave_m for wing in house.wings[1:]) for house in town]
    is_hidden = [
        each and house.footprint.area > 0.97 * shapely.minimum_rotated_rectangle(house.footprint).area
        for each, house in zip(low, town, strict=True)
    ]
    assert len(town) > 200 and 0.4 < np.mean(low) < 0.95 and 0.2 < np.mean(is_hidden) < 0.7
    assert len(list(true_solids(town[:9]))) == 9
