"""The committed miniature is what its script draws, and has what the pipeline is to be tried on."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import geopandas as gpd
import laspy
import numpy as np
import pytest
import shapely
from places import MINI

from p2wss.data.tiling import tiles_of_points

LIDAR = "lidar/LHD_FXX_0653_6861_PTS_LAMB93_IGN69.laz"
FOOTPRINTS = "bdtopo/BDTOPO_mini.gpkg"


@pytest.fixture(scope="module")
def make() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make", MINI / "make.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["make"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def footprints() -> gpd.GeoDataFrame:
    return gpd.read_file(MINI / FOOTPRINTS)


def test_size() -> None:
    assert sum(path.stat().st_size for path in MINI.rglob("*") if path.is_file()) <= 5_000_000


def test_script_draws_the_committed_files(
    make: ModuleType, tmp_path: Path, footprints: gpd.GeoDataFrame
) -> None:
    """All but the cloud, which takes longer; contents, because SQLite's bytes depend on its version."""
    rng = np.random.Generator(np.random.PCG64(make.SEED))
    town = make.draw_town(rng)
    make.write_terrain(tmp_path / "rgealti")
    make.write_footprints(town, tmp_path / FOOTPRINTS, rng)
    again = gpd.read_file(tmp_path / FOOTPRINTS)
    assert again.drop(columns="geometry").equals(footprints.drop(columns="geometry"))
    assert shapely.equals_exact(again.geometry, footprints.geometry, 1e-6).all()
    for path in sorted((MINI / "rgealti").iterdir()):
        assert (tmp_path / "rgealti" / path.name).read_text() == path.read_text()


@pytest.mark.slow
def test_script_draws_the_committed_cloud(make: ModuleType, tmp_path: Path) -> None:
    make.main(tmp_path)
    again, committed = laspy.read(tmp_path / LIDAR), laspy.read(MINI / LIDAR)
    np.testing.assert_array_equal(again.points.array, committed.points.array)


def test_the_town_has_what_it_is_for(footprints: gpd.GeoDataFrame) -> None:
    middle = footprints.centroid
    tiles = tiles_of_points(middle.x.to_numpy(), middle.y.to_numpy(), 1000)
    counts = dict(zip(*np.unique(tiles, return_counts=True), strict=True))
    assert sum(counts[tile] for tile in ("0652_6862", "0653_6862", "0652_6861")) >= 2000
    assert 150 <= counts["0653_6861"] <= 500
    assert footprints["hauteur"].isna().any() and (footprints["hauteur"] == 0).any()
    assert (shapely.get_coordinates(footprints.geometry, include_z=True)[:, 2] == -1000).any()
    assert (footprints.geometry.count_geometries() > 1).any()
    exteriors = footprints.geometry.map(lambda shape: len(shape.geoms[0].exterior.coords) - 1)
    assert (exteriors == 4).mean() > 0.4 and (exteriors > 7).any()
    assert footprints.geometry.map(lambda shape: len(shape.geoms[0].interiors)).any()
    assert footprints["cleabs"].is_unique


def test_the_cloud_is_like_lidar_hd(footprints: gpd.GeoDataFrame) -> None:
    cloud = laspy.read(MINI / LIDAR)
    assert (cloud.header.version.minor, cloud.header.point_format.id) == (4, 6)
    assert cloud.header.parse_crs().to_epsg() == 2154
    assert "not LiDAR HD" in cloud.header.system_identifier
    assert set(cloud.classification) == {1, 2, 5, 6}
    x, y = np.asarray(cloud.x), np.asarray(cloud.y)
    assert x.min() >= 653000 and y.max() < 6861000
    inside = footprints[footprints.within(shapely.box(653000, 6860000, 654000, 6861000))].geometry
    near = shapely.union_all(inside.buffer(1).to_numpy())
    shapely.prepare(near)
    density = shapely.contains_xy(near, x, y).sum() / near.area
    assert 10 <= density <= 15
    # every building has points on it
    tree = shapely.STRtree(shapely.points(x[cloud.classification == 6], y[cloud.classification == 6]))
    on_roof = tree.query(inside.to_numpy(), predicate="contains")[0]
    assert np.bincount(on_roof, minlength=len(inside)).min() > 30
