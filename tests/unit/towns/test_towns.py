"""The committed miniature is what ``p2wss towns`` draws, and has what the pipeline is to be tried on; so are the files
of the demo."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pytest
import shapely
from drawn_towns.files import MINIATURE_SEED, write_demo
from drawn_towns.files import write_town as write_town_with_lidar
from drawn_towns.lidar import LIDAR
from places import MINI, ROOT

from p2wss.cli import main
from p2wss.cli.demo import write_inputs
from p2wss.data.tiling import tiles_of_points
from p2wss.towns import FOOTPRINTS, draw_town, write_town


@pytest.fixture(scope="module")
def footprints() -> gpd.GeoDataFrame:
    return gpd.read_file(MINI / FOOTPRINTS)


def test_size() -> None:
    # of which recorded outputs of Roofer, so that a clone has all columns of the report, take 1.3 MB
    assert sum(path.stat().st_size for path in MINI.rglob("*") if path.is_file()) <= 6_000_000


@pytest.fixture(scope="module")
def town_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The miniature's footprints and terrain, drawn again by the command."""
    folder = tmp_path_factory.mktemp("town")
    assert main(["towns", "--seed", str(MINIATURE_SEED), "--out", str(folder)]) == 0
    return folder


def test_the_command_draws_the_committed_footprints(town_folder: Path, footprints: gpd.GeoDataFrame) -> None:
    """Their contents, because SQLite's bytes depend on its version."""
    again = gpd.read_file(town_folder / FOOTPRINTS)
    assert again.drop(columns="geometry").equals(footprints.drop(columns="geometry"))
    assert shapely.equals_exact(again.geometry, footprints.geometry, 1e-6).all()


def test_the_command_draws_the_committed_terrain(town_folder: Path) -> None:
    names = sorted(path.name for path in (MINI / "rgealti").iterdir())
    assert sorted(path.name for path in (town_folder / "rgealti").iterdir()) == names
    for name in names:
        assert (town_folder / "rgealti" / name).read_bytes() == (MINI / "rgealti" / name).read_bytes()


def test_a_second_drawing_writes_the_same_bytes(town_folder: Path, tmp_path: Path) -> None:
    write_town(tmp_path, MINIATURE_SEED)
    assert (tmp_path / FOOTPRINTS).read_bytes() == (town_folder / FOOTPRINTS).read_bytes()


def test_another_seed_draws_another_town(footprints: gpd.GeoDataFrame) -> None:
    town = draw_town(np.random.Generator(np.random.PCG64(MINIATURE_SEED + 1)))
    assert len(town) > 1000
    assert {building.footprint.wkb for building in town}.isdisjoint(
        shapely.to_wkb(shapely.force_2d(footprints.geometry.map(lambda shape: shape.geoms[0])))
    )


def test_the_drawing_is_independent_of_the_kernel() -> None:
    """Its roofs judge the kernel's: they may not come from it."""
    names = "p2wss.towns, drawn_towns.wings, drawn_towns.old, drawn_towns.large"
    code = f"import sys, {names}; print(*[name for name in sys.modules if name.startswith('p2wss.')])"
    command = [sys.executable, "-c", code]
    modules = subprocess.run(
        command, cwd=ROOT / "benchmarks", capture_output=True, text=True, check=True
    ).stdout
    assert "p2wss.towns" in modules and "p2wss.skeleton" not in modules and "p2wss.config" not in modules


@pytest.mark.slow
def test_the_committed_cloud_is_drawn(tmp_path: Path) -> None:
    write_town_with_lidar(tmp_path, MINIATURE_SEED, "streets")
    again, committed = laspy.read(tmp_path / LIDAR), laspy.read(MINI / LIDAR)
    np.testing.assert_array_equal(again.points.array, committed.points.array)
    assert again.header.generating_software == committed.header.generating_software


def test_the_committed_demo_is_drawn(tmp_path: Path) -> None:
    write_demo(tmp_path)
    cloud, footprints = write_inputs(tmp_path / "shipped")
    again, shipped = laspy.read(tmp_path / cloud.name), laspy.read(cloud)
    np.testing.assert_array_equal(again.points.array, shipped.points.array)
    drawn, known = gpd.read_file(tmp_path / footprints.name), gpd.read_file(footprints)
    assert drawn.drop(columns="geometry").equals(known.drop(columns="geometry")) and len(known) == 31
    assert shapely.equals_exact(drawn.geometry, known.geometry, 1e-6).all()


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
