"""The source ``folder``: the miniature's files in IGN's formats, and small files with a defect each."""

from __future__ import annotations

import struct
from datetime import date
from pathlib import Path
from typing import Any

import geopandas as gpd
import laspy
import numpy as np
import pytest
import rasterio
import shapely
from places import ROOT
from rasterio.transform import from_origin

from p2wss.clouds.reading import read_clouds
from p2wss.config import Folder
from p2wss.fetching.bdtopo import normalise, write_footprints
from p2wss.fetching.cloud import write_cloud
from p2wss.fetching.folder import FolderSource, mosaic
from p2wss.fetching.source import known_height_share
from p2wss.footprints.cleaning import read_footprints
from p2wss.formats.materials import materials_of
from p2wss.storage import integrity
from p2wss.storage.messages import InputError

MINI = ROOT / "tests" / "mini"
OLEMPS = ROOT.parent / "shared" / "data" / "olemps_bdtopo"


def source(crs: str = "EPSG:2154", **paths: Any) -> FolderSource:
    config = Folder(**{name: str(path) for name, path in paths.items()})
    return FolderSource(config, crs)


# --- footprints ---


def buildings(number: int = 3, **columns: Any) -> gpd.GeoDataFrame:
    squares = [shapely.box(652000 + 20 * i, 6861000, 652010 + 20 * i, 6861010) for i in range(number)]
    values = {"cleabs": [f"B{i}" for i in range(number)], "hauteur": np.arange(number) + 3.0} | columns
    return gpd.GeoDataFrame(values, geometry=shapely.force_3d(np.array(squares), 60.0), crs="EPSG:2154")


def test_window_of_the_miniature() -> None:
    footprints = source(footprints=MINI / "bdtopo").footprints((652900, 6861000, 653000, 6861100))
    result = normalise(footprints, "EPSG:2154", "mini")
    everything = gpd.read_file(MINI / "bdtopo" / "BDTOPO_mini.gpkg")
    expected = everything[everything.intersects(shapely.box(652900, 6861000, 653000, 6861100))]
    assert sorted(result["building_id"]) == sorted(expected["cleabs"])
    assert list(result.columns) == [
        "building_id",
        "hauteur_m",
        "nature",
        "usage",
        "num_floors",
        "altitude_minimale_sol_m",
        "altitude_minimale_toit_m",
        "materiaux_des_murs",
        "materiaux_de_la_toiture",
        "geometry",
    ]
    assert set(result.geom_type) == {"MultiPolygon"}
    assert not result.has_z.any()


@pytest.mark.skipif(not OLEMPS.exists(), reason="no shared/data/olemps_bdtopo")
def test_shapefiles_have_other_column_names() -> None:
    footprints = source(footprints=OLEMPS / "BATIMENT.shp").footprints((664000, 6360000, 665000, 6361000))
    result = normalise(footprints, "EPSG:2154", "olemps").set_index("building_id")
    raw = gpd.read_file(OLEMPS / "BATIMENT.shp").set_index("ID").loc[result.index]
    np.testing.assert_array_equal(result["hauteur_m"], raw["HAUTEUR"])
    np.testing.assert_array_equal(result["altitude_minimale_sol_m"], raw["Z_MIN_SOL"])
    np.testing.assert_array_equal(result["num_floors"], raw["NB_ETAGES"].astype(float))
    assert "Indifférenciée" in set(result["nature"]), "UTF-8 without a .cpg file"


@pytest.mark.parametrize("suffix", [".gpkg", ".parquet", ".geojson", ".fgb"])
def test_windows_of_other_formats(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"b{suffix}"
    frame = buildings(5)
    if suffix == ".parquet":
        frame.to_parquet(path, write_covering_bbox=True)
    else:
        frame.to_file(path)
    footprints = normalise(
        source(footprints=path).footprints((652015, 6861000, 652055, 6861010)), "EPSG:2154", "b"
    )
    assert list(footprints["building_id"]) == ["B1", "B2"]


def test_a_building_in_two_files_is_returned_once(tmp_path: Path) -> None:
    buildings(3).to_file(tmp_path / "a.gpkg")
    buildings(5).iloc[2:].to_file(tmp_path / "b.gpkg")
    footprints = source(footprints=tmp_path / "*.gpkg").footprints((652000, 6861000, 652100, 6861100))
    assert list(normalise(footprints, "EPSG:2154", "ab")["building_id"]) == ["B0", "B1", "B2", "B3", "B4"]


def test_a_missing_column_is_an_error_that_lists_the_columns() -> None:
    frame = buildings().rename(columns={"hauteur": "height"})
    with pytest.raises(
        InputError, match="x: has no column hauteur or HAUTEUR; its columns are cleabs, height"
    ):
        normalise(frame, "EPSG:2154", "x")


def test_a_wrong_crs_is_an_error_that_names_both() -> None:
    with pytest.raises(
        InputError, match=r"x: is in Amersfoort.*, but the region is in RGF93 v1 / Lambert-93"
    ):
        normalise(buildings().to_crs("EPSG:28992"), "EPSG:2154", "x")


def test_missing_attributes_are_null() -> None:
    result = normalise(buildings(hauteur=[None, 0.0, 4.5]), "EPSG:2154", "x")
    np.testing.assert_array_equal(result["hauteur_m"], [np.nan, 0.0, 4.5])
    assert result["nature"].isna().all() and result["num_floors"].isna().all()


def test_a_building_without_an_id_is_an_error() -> None:
    with pytest.raises(InputError, match="x: building number 2 has no cleabs"):
        normalise(buildings(cleabs=["a", None, "c"]), "EPSG:2154", "x")


def test_several_layers_without_the_named_one(tmp_path: Path) -> None:
    for layer in ("roads", "rivers"):
        buildings().to_file(tmp_path / "b.gpkg", layer=layer)
    with pytest.raises(InputError, match="has no layer batiment, but roads, rivers"):
        source(footprints=tmp_path / "b.gpkg").footprints((652000, 6861000, 652100, 6861100))


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"fetch\.folder\.footprints: .*nothing: no such file"):
        source(footprints=tmp_path / "nothing").footprints((0, 0, 1, 1))


def test_not_a_vector_file(tmp_path: Path) -> None:
    (tmp_path / "b.gpkg").write_text("<html>")
    with pytest.raises(InputError, match=r"b\.gpkg: not a readable vector file"):
        source(footprints=tmp_path).footprints((0, 0, 1, 1))


def test_footprints_are_written_with_their_provenance(tmp_path: Path) -> None:
    out = tmp_path / "footprints.gpkg"
    frame = normalise(buildings(), "EPSG:2154", "x")
    write_footprints(out, frame, {"code": "abc"})
    assert [path.name for path in tmp_path.iterdir()] == ["footprints.gpkg"]
    back = gpd.read_file(out)
    assert back.geometry.geom_equals(frame.geometry).all()
    import pyogrio

    assert pyogrio.read_info(out)["layer_metadata"]["p2wss"] == '{"code": "abc"}'


# --- terrain ---


def plane(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.05 * (x - 652000) - 0.02 * (y - 6861000) + 100


def write_asc(path: Path, x_nw: float, y_nw: float, size: int, cell: float, nodata: int = 0) -> None:
    x, y = np.meshgrid(x_nw + cell * np.arange(size), y_nw - cell * np.arange(size))
    z = plane(x, y)
    z.ravel()[:nodata] = -99999
    corner = f"xllcorner {x_nw - cell / 2}\nyllcorner {y_nw - cell * (size - 1) - cell / 2}\n"
    header = f"ncols {size}\nnrows {size}\n{corner}cellsize {cell}\nNODATA_value -99999.00\n"
    path.write_text(
        header + "\n".join(" ".join(f"{v:.2f}" for v in row) for row in z) + "\n", encoding="utf-8"
    )


def test_terrain_of_the_miniature_equals_its_files() -> None:
    """A window over four tiles equals the numbers in the files."""
    terrain = source(dtm=MINI / "rgealti").dtm((652900.0, 6860900.0, 653100.0, 6861100.0))
    assert terrain.cell_m == 5
    for name, rows, columns in [
        ("0652_6862", slice(180, 200), slice(180, 200)),
        ("0653_6861", slice(0, 20), slice(0, 20)),
    ]:
        path = MINI / "rgealti" / f"RGEALTI_FXX_{name}_MNT_LAMB93_IGN69.asc"
        text = np.loadtxt(path, skiprows=6)[rows, columns]
        x = int(name[:4]) * 1000 + 5 * columns.start
        y = int(name[5:]) * 1000 - 5 * rows.start
        column = round((x - terrain.x_min_m) / 5 - 0.5)
        row = round((terrain.y_max_m - y) / 5 - 0.5)
        np.testing.assert_allclose(terrain.height_m[row : row + 20, column : column + 20], text, atol=1e-4)


def test_terrain_outside_the_files_is_nan() -> None:
    terrain = source(dtm=MINI / "rgealti").dtm((651900.0, 6861500.0, 652100.0, 6861600.0))
    x = terrain.x_min_m + 5 * (np.arange(terrain.height_m.shape[1]) + 0.5)
    np.testing.assert_array_equal(
        np.isnan(terrain.height_m), np.broadcast_to(x < 652000, terrain.height_m.shape)
    )


def test_nodata_becomes_nan(tmp_path: Path) -> None:
    write_asc(tmp_path / "a.asc", 652000, 6861050, 50, 1, nodata=50)
    terrain = source(dtm=tmp_path).dtm((652000.0, 6861010.0, 652040.0, 6861060.0))
    has_data = np.isfinite(terrain.height_m)
    y = terrain.y_max_m - (np.arange(len(has_data)) + 0.5)
    np.testing.assert_array_equal(has_data[:, 0], y < 6861050)
    assert known_height_share(terrain, (652000, 6861010, 652040, 6861040), "x") == 1
    with pytest.raises(InputError, match="x: no heights in"):
        known_height_share(terrain, (652000, 6861052, 652040, 6861058), "x")


def errors_of_merged(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """(x, how far heights of a.asc and b.asc together are from the plane) of cells of 1 m."""
    files = [folder / "a.asc", folder / "b.asc"]
    terrain = mosaic(files, (652010.0, 6861010.0, 652180.0, 6861080.0), "EPSG:2154", "x")
    rows, columns = terrain.height_m.shape
    x, y = np.meshgrid(
        terrain.x_min_m + np.arange(columns) + 0.5, terrain.y_max_m - np.arange(rows) - 0.5, indexing="xy"
    )
    return x, np.abs(terrain.height_m - plane(x, y))


def test_another_cell_size_is_interpolated(tmp_path: Path) -> None:
    """A file with 1 m cells beside one with 5 m cells: a plane is reproduced on both sides of the seam."""
    write_asc(tmp_path / "a.asc", 652000, 6861099, 100, 1)
    write_asc(tmp_path / "b.asc", 652100, 6861095, 20, 5)
    x, error = errors_of_merged(tmp_path)
    assert np.nanmax(error[:, x[0] < 652095]) < 0.006
    assert np.nanmax(error[:, x[0] > 652105]) < 0.02
    assert np.isfinite(error).mean() > 0.97


def test_a_grid_between_the_cells_of_another_is_interpolated(tmp_path: Path) -> None:
    """Beside a file whose cells are half a cell off, heights are those of the plane, not of half a cell beside."""
    write_asc(tmp_path / "a.asc", 652000, 6861099, 100, 1)
    write_asc(tmp_path / "b.asc", 652099.5, 6861099.5, 100, 1)
    x, error = errors_of_merged(tmp_path)
    is_inner = (x < 652098) | (x > 652101)
    assert error[is_inner].max() < 0.006


def test_rasters_of_a_folder_are_refused_and_cleaned_as_terrain_is(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    values = np.full((10, 10), 50, np.float32)
    values[:2] = -9999
    for name, transform in (
        ("a", from_origin(652000, 6861010, 1, 1)),
        ("b", rasterio.Affine(1, 0, 652010, 0, 1, 6861000)),
    ):
        with rasterio.open(
            tmp_path / f"{name}.tif", "w", driver="GTiff", width=10, height=10, count=1, dtype="float32",
            crs="EPSG:2154", transform=transform,
        ) as raster:  # fmt: skip
            raster.write(values, 1)
    bounds = (652001.0, 6861001.0, 652009.0, 6861010.0)
    with caplog.at_level("WARNING", "p2wss"):
        terrain = mosaic([tmp_path / "a.tif"], bounds, "EPSG:2154", "x")
    assert "such as -9999 m" in caplog.text
    assert np.isnan(terrain.height_m[:2]).all() and (terrain.height_m[2:] == 50).all()
    with pytest.raises(InputError, match=r"b.tif: must be a north-up raster"):
        mosaic([tmp_path / "b.tif"], bounds, "EPSG:2154", "x")


def test_heights_are_in_metres_as_rasters_state_their_units(tmp_path: Path) -> None:
    """A grid of whole centimetres, stated as unit or as scale, and an offset; not two units side by side."""
    (tmp_path / "alone").mkdir()
    for name, left, unit, scale in (
        ("alone/a", 652000, "cm", 1.0),
        ("alone/b", 652010, "cm", 1.0),
        ("c", 652000, "", 0.01),
    ):
        with rasterio.open(
            tmp_path / f"{name}.tif", "w", driver="GTiff", width=10, height=10, count=1, dtype="int16",
            crs="EPSG:2154", transform=from_origin(left, 6861010, 1, 1), nodata=-1,
        ) as raster:  # fmt: skip
            raster.write(np.where(np.eye(10), -1, 3250).astype(np.int16), 1)
            raster.units, raster.scales, raster.offsets = [unit], [scale], [0.0 if unit else 5.0]
    bounds = (652000.0, 6861000.0, 652020.0, 6861010.0)
    terrain = source(dtm=tmp_path / "alone").dtm(bounds)
    assert (
        np.isnan(terrain.height_m).sum() == 20
        and np.nanmin(terrain.height_m) == np.nanmax(terrain.height_m) == 32.5
    )
    assert np.nanmax(source(dtm=tmp_path / "c.tif").dtm(bounds).height_m) == 37.5
    (tmp_path / "alone" / "a.tif").rename(tmp_path / "a.tif")
    with pytest.raises(InputError, match=r"c\.tif: its heights have another unit.* than those of .*a\.tif"):
        source(dtm=tmp_path).dtm(bounds)


def test_terrain_in_another_crs(tmp_path: Path) -> None:
    with rasterio.open(
        tmp_path / "a.tif", "w", driver="GTiff", width=10, height=10, count=1, dtype="float32",
        crs="EPSG:28992", transform=from_origin(0, 10, 1, 1),
    ) as raster:  # fmt: skip
        raster.write(np.ones((1, 10, 10), np.float32))
    with pytest.raises(InputError, match=r"a\.tif: is in Amersfoort.*the region is in RGF93"):
        source(dtm=tmp_path).dtm((0, 0, 10, 10))


def test_terrain_elsewhere_and_not_a_raster(tmp_path: Path) -> None:
    write_asc(tmp_path / "a.asc", 652000, 6861050, 50, 1)
    with pytest.raises(InputError, match=r"none of its 1 files covers 700000\.\.700100, 6600000\.\.6600100"):
        source(dtm=tmp_path).dtm((700000, 6600000, 700100, 6600100))
    (tmp_path / "b.asc").write_text("<html>")
    with pytest.raises(InputError, match=r"b\.asc: not a readable raster"):
        source(dtm=tmp_path).dtm((652000, 6861000, 652050, 6861050))


def test_truncated_terrain(tmp_path: Path) -> None:
    write_asc(tmp_path / "a.asc", 652000, 6861050, 50, 1)
    text = (tmp_path / "a.asc").read_text()
    (tmp_path / "a.asc").write_text(text[: len(text) // 2])
    with pytest.raises(InputError, match=r"a\.asc.*truncated"):
        source(dtm=tmp_path).dtm((652000, 6861000, 652050, 6861050))


# --- LiDAR ---

LIDAR = MINI / "lidar" / "LHD_FXX_0653_6861_PTS_LAMB93_IGN69.laz"
TILE = (653000.0, 6860000.0, 654000.0, 6861000.0)


def write_points(path: Path, x: np.ndarray, y: np.ndarray, crs: str | None = "EPSG:2154") -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.001] * 3, [652000, 6861000, 0]
    if crs:
        from pyproj import CRS

        header.add_crs(CRS(crs))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = x, y, np.full(len(x), 12.345)
    cloud.classification = np.full(len(x), 6)
    cloud.gps_time = np.arange(len(x))
    cloud.write(path)


def test_a_single_laz_is_copied_unchanged(tmp_path: Path) -> None:
    paths = source(lidar=MINI / "lidar").lidar(TILE)
    assert paths == [LIDAR]
    out = tmp_path / "0653_6861.laz"
    assert write_cloud(out, paths, TILE, "EPSG:2154") == laspy.open(LIDAR).header.point_count
    assert out.read_bytes()[: -len(integrity.TRAILER)] == LIDAR.read_bytes()
    assert integrity.is_intact(out) and not integrity.has_checksum(LIDAR)


def test_a_single_laz_whose_header_states_wrong_bounds_is_cropped(tmp_path: Path) -> None:
    x, y = 653000 + np.arange(2000.0), np.full(2000, 6860500.0)
    path = tmp_path / "wrong.laz"
    write_points(path, x, y)
    content = bytearray(path.read_bytes())
    content[179:211] = struct.pack("<4d", 653200, 653100, 6860600, 6860550)
    path.write_bytes(content)
    paths = source(lidar=path).lidar(TILE)
    assert write_cloud(tmp_path / "out.laz", paths, TILE, "EPSG:2154") == 1000


def test_points_of_several_files_are_written_once(write_points: Any, tmp_path: Path) -> None:
    """Tiles that overlap, the second in other steps; equal points within one file stay."""
    points = np.round(np.random.default_rng(0).uniform((1, 1, 40), (99, 99, 60), (3000, 3)), 2)
    points += [652000, 6861000, 0]
    points[1] = points[0] = (652010, 6861010, 50)
    is_first, is_second = points[:, 0] < 652060, points[:, 0] > 652040
    first, second = (write_points(f"{k}.laz", points[of]) for k, of in enumerate((is_first, is_second)))
    other = laspy.convert(laspy.read(second), point_format_id=6)
    other.change_scaling(scales=[0.01] * 3, offsets=[652000.5, 6861000.25, 0])
    other.write(second)
    bounds = (652000.0, 6861000.0, 652100.0, 6861100.0)
    assert write_cloud(tmp_path / "out.laz", [first, second], bounds, "EPSG:2154") == len(points)


def test_several_files_are_merged_and_cropped(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    x = 652000 + np.round(rng.uniform(-100, 200, 5000), 3)
    y = 6861000 + np.round(rng.uniform(0, 100, 5000), 3)
    files = tmp_path / "in"
    files.mkdir()
    west = x < 652050
    write_points(files / "a.las", x[west], y[west])
    write_points(files / "b.laz", x[~west], y[~west])
    write_points(files / "far.laz", x + 5000, y)
    # headers that state no bounds, and others than those of the points
    for name, stated in (("a.las", bytes(32)), ("b.laz", struct.pack("<4d", 7e5, 6.9e5, 7e6, 6.9e6))):
        content = bytearray((files / name).read_bytes())
        content[179:211] = stated
        (files / name).write_bytes(content)
    bounds = (652000.0, 6861000.0, 652100.0, 6861100.0)
    paths = source(lidar=files).lidar(bounds)
    assert [path.name for path in paths] == ["a.las", "b.laz"]
    inside = (x >= 652000) & (x < 652100)
    assert write_cloud(tmp_path / "out.laz", paths, bounds, "EPSG:2154") == inside.sum()
    cloud = laspy.read(tmp_path / "out.laz")
    order = np.lexsort([np.round(cloud.y, 3), np.round(cloud.x, 3)])
    expected = np.lexsort([np.round(y[inside], 3), np.round(x[inside], 3)])
    np.testing.assert_allclose(np.asarray(cloud.x)[order], x[inside][expected], rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.asarray(cloud.y)[order], y[inside][expected], rtol=0, atol=1e-6)
    assert set(cloud.classification) == {6}
    assert cloud.header.parse_crs().to_epsg() == 2154


def test_merged_clouds_keep_high_classes_flags_and_their_day(tmp_path: Path) -> None:
    """Of a file in an old format and one in a new one: whichever is first, and whatever the day of the merging."""
    for name, version, number, code, day in (("a", "1.2", 3, 6, 1), ("b", "1.4", 6, 65, 2)):
        header = laspy.LasHeader(point_format=number, version=version)
        header.scales, header.offsets, header.creation_date = (
            [0.001] * 3,
            [652000, 6861000, 0],
            date(2012, 5, day),
        )
        cloud = laspy.LasData(header)
        cloud.x, cloud.y, cloud.z = np.array([[652000.0 + day, 6861000.0, 1.0]] * 2).T
        cloud.classification, cloud.withheld = np.array([code, 2], np.uint8), np.array([0, 1], np.uint8)
        cloud.return_number, cloud.number_of_returns = np.full((2, 2), 3, np.uint8)
        cloud.write(tmp_path / f"{name}.laz")
    for names in ("ab", "ba"):
        bounds = (651000.0, 6860000.0, 653000.0, 6862000.0)
        assert (
            write_cloud(tmp_path / "out.laz", [tmp_path / f"{n}.laz" for n in names], bounds, "EPSG:2154")
            == 4
        )
        merged = laspy.read(tmp_path / "out.laz")
        assert sorted(merged.classification) == [2, 2, 6, 65] and list(merged.withheld) == [0, 1, 0, 1]
        assert set(merged.return_number) == set(merged.number_of_returns) == {3}
        assert merged.header.creation_date == date(2012, 5, 2)


def test_a_neighbour_that_only_shares_an_edge_is_not_read(tmp_path: Path) -> None:
    write_points(tmp_path / "a.laz", np.array([652900.0, 653000.0]), np.array([6860500.0, 6860600.0]))
    with pytest.raises(InputError, match="none of its 1 files has points in"):
        source(lidar=tmp_path).lidar(TILE)


@pytest.mark.parametrize("keep", [0.9999, 0.5, 0.001])
def test_a_truncated_laz_leaves_no_output(tmp_path: Path, keep: float) -> None:
    whole = LIDAR.read_bytes()
    broken = tmp_path / "broken.laz"
    broken.write_bytes(whole[: int(keep * len(whole))])
    out = tmp_path / "out.laz"
    out.write_bytes(b"what was there before")
    with pytest.raises(InputError, match=r"broken\.laz: .*truncated"):
        write_cloud(out, [broken], TILE, "EPSG:2154")
    assert out.read_bytes() == b"what was there before"
    assert len(list(tmp_path.iterdir())) == 2


COPC = ROOT.parent / "shared" / "data" / "lidarhd_crops" / "77050_627755_LA93_IGN69.copc.laz"


@pytest.mark.skipif(not COPC.exists(), reason="no shared/data/lidarhd_crops")
@pytest.mark.parametrize("keep", [1, 0.9999, 0.5, 0.1, 0.001])
def test_real_copc_complete_and_truncated(tmp_path: Path, keep: float) -> None:
    path, out = tmp_path / "a.copc.laz", tmp_path / "out.laz"
    path.write_bytes(COPC.read_bytes()[: int(keep * COPC.stat().st_size)])
    bounds = (770000.0, 6277000.0, 771000.0, 6278000.0)
    if keep == 1:
        assert write_cloud(out, [path], bounds, "EPSG:2154") == 73355
        assert out.read_bytes()[: -len(integrity.TRAILER)] == COPC.read_bytes()
        assert len(read_clouds([out], bounds)) == len(read_clouds([path], bounds)) > 0
    else:
        with pytest.raises(InputError, match=r"a\.copc\.laz: .*truncated"):
            write_cloud(out, [path], bounds, "EPSG:2154")
        assert not out.exists()


def test_lidar_in_another_crs(tmp_path: Path) -> None:
    write_points(tmp_path / "a.laz", np.array([653100.0]), np.array([6860500.0]), "EPSG:28992")
    with pytest.raises(InputError, match=r"a\.laz: is in Amersfoort.*the region is in RGF93"):
        write_cloud(tmp_path / "out.laz", [tmp_path / "a.laz"], TILE, "EPSG:2154")


# --- large files, and files in degrees ---


@pytest.mark.parametrize("covering", [True, False])
@pytest.mark.parametrize("crs", ["OGC:CRS84", "EPSG:4171", "EPSG:2154"])
def test_window_of_the_national_geoparquet(tmp_path: Path, crs: str, covering: bool) -> None:
    """IGN's national file is in degrees and has a column of bounding boxes; other files may lack either."""
    frame = buildings(200)
    frame.to_crs(crs).to_parquet(tmp_path / "b.parquet", write_covering_bbox=covering, row_group_size=20)
    window = (652105.0, 6861000.0, 652145.0, 6861010.0)
    footprints = source(footprints=tmp_path / "b.parquet").footprints(window)
    result = normalise(footprints, "EPSG:2154", "b").set_index("building_id")
    expected = frame.set_index("cleabs")
    expected = expected[expected.intersects(shapely.box(*window))]
    assert sorted(result.index) == sorted(expected.index)
    moved = result.geometry.hausdorff_distance(gpd.GeoSeries(shapely.force_2d(expected.geometry), crs=2154))
    assert moved.max() < 1e-3


def test_geopackage_in_degrees(tmp_path: Path) -> None:
    buildings(50).to_crs("EPSG:4326").to_file(tmp_path / "b.gpkg")
    footprints = source(footprints=tmp_path / "b.gpkg").footprints((652105.0, 6861000.0, 652145.0, 6861010.0))
    assert sorted(normalise(footprints, "EPSG:2154", "b")["building_id"]) == ["B5", "B6", "B7"]


def test_an_empty_window_of_each_format(tmp_path: Path) -> None:
    frame = buildings(5)
    frame.to_parquet(tmp_path / "a.parquet", write_covering_bbox=True)
    frame.to_parquet(tmp_path / "b.parquet")
    frame.to_file(tmp_path / "c.gpkg")
    for name in ("a.parquet", "b.parquet", "c.gpkg"):
        footprints = source(footprints=tmp_path / name).footprints((0.0, 0.0, 1.0, 1.0))
        assert len(normalise(footprints, "EPSG:2154", name)) == 0


def test_not_a_parquet_file(tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_text("<html>")
    with pytest.raises(InputError, match=r"a\.parquet: not a readable vector file"):
        source(footprints=tmp_path / "a.parquet").footprints((0.0, 0.0, 1.0, 1.0))


def test_square_kilometres_without_a_file_are_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    source(dtm=MINI / "rgealti").dtm((651900.0, 6861500.0, 652100.0, 6861600.0))
    assert "no file covers 0651_6862; the terrain is unknown there" in caplog.text
    caplog.clear()
    source(dtm=MINI / "rgealti").dtm((652100.0, 6861500.0, 652200.0, 6861600.0))
    assert not caplog.text


def test_clouds_in_another_crs_are_selected_by_the_reprojected_window(tmp_path: Path) -> None:
    from pyproj import Transformer

    to_utm = Transformer.from_crs(2154, 32631, always_xy=True)
    x, y = to_utm.transform(np.array([653100.0, 653200.0]), np.array([6860500.0, 6860600.0]))
    write_points(tmp_path / "a.laz", x, y, "EPSG:32631")
    assert source(lidar=tmp_path, lidar_crs="EPSG:32631").lidar(TILE) == [tmp_path / "a.laz"]
    with pytest.raises(InputError, match="none of its 1 files has points"):
        source(lidar=tmp_path).lidar(TILE)


def test_footprints_of_other_schemas(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Overture in degrees, in two files with one building in both, and one of its ids twice."""
    squares = buildings(5).to_crs(4326).geometry.to_numpy()
    columns = {"sources": "[]", "height": [4.0, None, None, 8.0, 9.0], "num_floors": [None, 2, None, 3, None]}
    frame = gpd.GeoDataFrame({"id": ["a", "b", "c", "d", "a"], **columns}, geometry=squares, crs=4326)
    frame[:3].to_parquet(tmp_path / "1.parquet")
    frame[2:].to_parquet(tmp_path / "2.parquet")
    footprints = source(footprints=tmp_path).footprints((652000, 6861000, 652200, 6861100))
    for schema in ("auto", "overture"):
        result = normalise(footprints, "EPSG:2154", "f", schema).set_index("building_id")
        assert list(result.index) == ["a", "a_2", "b", "c", "d"]
        assert result["hauteur_m"].to_list() == pytest.approx([4, 9, np.nan, np.nan, 8], nan_ok=True)
        assert result["num_floors"].to_list() == pytest.approx([np.nan, np.nan, 2, np.nan, 3], nan_ok=True)
        assert list(result.columns) == list(normalise(buildings(), "EPSG:2154", "x").columns[1:])
    assert "f: id column id: a occurs more than once" in caplog.text


@pytest.mark.parametrize("schema", ["bdtopo", "auto"])
@pytest.mark.parametrize(
    "names", [("materiaux_des_murs", "materiaux_de_la_toiture"), ("MAT_MURS", "MAT_TOITS")]
)
def test_materials_and_heights_of_buildings_reach_the_reconstruction(
    schema: str, names: tuple[str, str], tmp_path: Path
) -> None:
    """What IGN states of walls, roofs and eaves serves the scene of a place, as it serves a run on its files."""
    stated = {names[0]: ["40", None], names[1]: ["20", "99"], "hauteur": [np.nan, 3.0]}
    eaves = {"altitude_minimale_toit": [57.5, 60.0], "altitude_minimale_sol": [50.0, 50.0]}
    frame = normalise(buildings(2, **stated, **eaves), "EPSG:2154", "f", schema)
    write_footprints(tmp_path / "f.gpkg", frame, {})
    features = read_footprints(tmp_path / "f.gpkg", needs_crs=True)
    rows = [{name: values[k] for name, values in features.columns.items()} for k in range(2)]
    assert list(map(materials_of, rows)) == [{"wall": "brick", "roof": "slate"}, {}]
    assert features["stated_height_m"].tolist() == [7.5, 3.0]


def test_footprints_without_ids_of_several_files(tmp_path: Path) -> None:
    for name in "ab":
        buildings(2).drop(columns="cleabs").to_file(tmp_path / f"{name}.gpkg", layer="batiment")
    footprints = source(footprints=tmp_path).footprints((652000, 6861000, 652200, 6861100))
    result = normalise(footprints, "EPSG:2154", "f", "auto")
    assert list(result["building_id"]) == ["a-1", "a-2", "b-1", "b-2"]
    assert list(result["hauteur_m"]) == [3.0, 4.0] * 2


def test_files_of_one_name_in_several_folders_have_ids_of_their_own(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).mkdir()
        buildings(2).drop(columns="cleabs").to_file(tmp_path / name / "town.gpkg", layer="batiment")
    footprints = source(footprints=tmp_path / "*" / "town.gpkg").footprints(
        (652000, 6861000, 652200, 6861100)
    )
    ids = normalise(footprints, "EPSG:2154", "f", "auto")["building_id"]
    assert list(ids) == ["1-town-1", "1-town-2", "2-town-1", "2-town-2"]


@pytest.mark.parametrize("suffix", [".gpkg", ".parquet", ".fgb"])
@pytest.mark.parametrize("crs", ["EPSG:32631", "EPSG:3857", "EPSG:2154+5720", "EPSG:27572"])
def test_footprints_in_another_projection_are_reprojected(
    tmp_path: Path, suffix: str, crs: str, caplog: pytest.LogCaptureFixture
) -> None:
    frame = buildings(5)
    elsewhere = frame.to_crs(crs)
    path = tmp_path / f"b{suffix}"
    elsewhere.to_parquet(path) if suffix == ".parquet" else elsewhere.to_file(path)
    with caplog.at_level("INFO"):
        features = source(footprints=path).footprints((652015, 6861000, 652055, 6861010))
    result = normalise(features, "EPSG:2154", "b").set_index("building_id")
    assert list(result.index) == ["B1", "B2"]
    expected = gpd.GeoSeries(frame.geometry.to_numpy()[1:3], index=result.index, crs=2154)
    # the old French datum is known to a metre or two without its grid
    off_m = result.geometry.hausdorff_distance(expected).max()
    assert off_m < (3.0 if crs == "EPSG:27572" else 1e-3)
    assert ("reprojected from" in caplog.text) == ("5720" not in crs)


def test_files_in_several_crs(tmp_path: Path) -> None:
    buildings(3).to_file(tmp_path / "a.gpkg")
    buildings(5).iloc[2:].to_crs(4326).to_file(tmp_path / "b.gpkg")
    buildings(6).iloc[4:].to_crs(32631).to_file(tmp_path / "c.gpkg")
    features = source(footprints=tmp_path).footprints((652000, 6861000, 652200, 6861100))
    result = normalise(features, "EPSG:2154", "abc")
    assert list(result["building_id"]) == [f"B{i}" for i in range(6)]
    np.testing.assert_allclose(result.geometry.area, 100.0, rtol=1e-6)


MOON = "+proj=eqc +lon_0=0 +R=1737400 +units=m +no_defs"
ANTIPODES = "+proj=gnom +lat_0=-45 +lon_0=-170 +datum=WGS84 +type=crs"


@pytest.mark.parametrize("crs", [MOON, ANTIPODES])
def test_a_crs_to_which_the_region_cannot_be_transformed(tmp_path: Path, crs: str) -> None:
    buildings(2).set_crs(crs, allow_override=True).to_parquet(tmp_path / "b.parquet")
    with pytest.raises(InputError, match=r"b\.parquet: is in .*the region cannot be transformed"):
        source(footprints=tmp_path).footprints((652000, 6861000, 652200, 6861100))
