from __future__ import annotations

import tracemalloc
from pathlib import Path

import control_houses as houses
import numpy as np
import pytest
import rasterio
import rasterio.shutil
from rasterio.transform import Affine, from_origin
from scipy.interpolate import RegularGridInterpolator

from p2wss.data.terrain import Terrain, read_terrain, without_impossible, write_terrain
from p2wss.storage.messages import InputError


def hilly(rows: int = 30, columns: int = 40, cell: float = 2.0) -> Terrain:
    heights = np.random.default_rng(0).normal(50, 3, (rows, columns)).astype(np.float32)
    return Terrain(heights, 100.0, 500.0, cell)


def test_interpolation_agrees_with_scipy() -> None:
    terrain = hilly()
    x = 100 + 2 * (np.arange(40) + 0.5)
    y = 500 - 2 * (np.arange(30) + 0.5)
    oracle = RegularGridInterpolator(
        (y[::-1], x), terrain.height_m[::-1].astype(float), bounds_error=False, fill_value=np.nan
    )
    rng = np.random.default_rng(1)
    at_x, at_y = rng.uniform(95, 185, 500), rng.uniform(435, 505, 500)
    expected = oracle(np.column_stack([at_y, at_x]))
    assert np.isnan(expected).any()
    np.testing.assert_allclose(terrain.interpolated(at_x, at_y), expected, rtol=1e-9)


def test_no_data_affects_only_adjacent_squares() -> None:
    terrain = hilly()
    terrain.height_m[10, 10] = np.nan
    x, y = 100 + 2 * 10.5, 500 - 2 * 10.5
    assert np.isnan(terrain.interpolated(np.array([x, x + 1.9, x]), np.array([y, y, y - 1.9]))).all()
    assert np.isfinite(terrain.interpolated(np.array([x + 2.1, x]), np.array([y, y + 2.1]))).all()


def test_cut_keeps_positions_and_one_more_cell() -> None:
    terrain = hilly()
    part = terrain.cut((120.3, 460.2, 140.9, 480.7))
    rng = np.random.default_rng(2)
    x, y = rng.uniform(120.3, 140.9, 200), rng.uniform(460.2, 480.7, 200)
    np.testing.assert_array_equal(part.interpolated(x, y), terrain.interpolated(x, y))
    assert part.height_m.shape < (14, 14)
    whole = terrain.cut((0, 0, 1000, 1000))
    assert (whole.x_min_m, whole.y_max_m) == (100, 500)
    np.testing.assert_array_equal(whole.height_m, terrain.height_m)
    assert terrain.cut((900, 900, 950, 950)).height_m.size == 0


def test_a_file_survives_a_round_trip(tmp_path: Path) -> None:
    terrain = hilly()
    terrain.height_m[0, 0] = np.nan
    write_terrain(tmp_path / "t.tif", terrain, "EPSG:2154", {"code": "abc"})
    back, crs = read_terrain(tmp_path / "t.tif")
    np.testing.assert_array_equal(back.height_m, terrain.height_m)
    assert (back.x_min_m, back.y_max_m, back.cell_m) == (100, 500, 2)
    assert crs.to_epsg() == 2154
    with rasterio.open(tmp_path / "t.tif") as raster:
        assert raster.tags()["p2wss"] == '{"code": "abc"}'
    assert [path.name for path in tmp_path.iterdir()] == ["t.tif"]


@pytest.mark.parametrize(
    ("crs", "transform", "message"),
    [
        (None, from_origin(0, 10, 1, 1), "has no CRS"),
        ('LOCAL_CS["unknown",UNIT["metre",1]]', from_origin(0, 10, 1, 1), "has no CRS"),
        ("EPSG:2154", from_origin(0, 10, 1, 2), "square cells"),
        ("EPSG:2154", Affine(1, 0.1, 0, 0.1, -1, 10), "north-up"),
    ],
)
def test_unsupported_rasters(tmp_path: Path, crs: str | None, transform: Affine, message: str) -> None:
    profile = {"driver": "GTiff", "width": 5, "height": 5, "count": 1, "dtype": "float32"}
    with rasterio.open(tmp_path / "t.tif", "w", crs=crs, transform=transform, **profile) as raster:
        raster.write(np.ones((1, 5, 5), np.float32))
    with pytest.raises(InputError, match=rf"t\.tif: .*{message}"):
        read_terrain(tmp_path / "t.tif")


def test_not_a_raster(tmp_path: Path) -> None:
    (tmp_path / "t.tif").write_text("<html>")
    with pytest.raises(InputError, match=r"t\.tif: not a readable raster"):
        read_terrain(tmp_path / "t.tif")


FEET = {"ft": 0.3048, "US survey foot": 1200 / 3937, "cm": 0.01, "Metre": 1.0}


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (0.01, 0.0), (0.1, 200.0), (-1.0, 300.0)])
@pytest.mark.parametrize("unit", [None, *FEET])
@pytest.mark.parametrize("dtype", ["float32", "float64", "int32"])
def test_scale_offset_and_unit_of_a_band(
    tmp_path: Path, scale: float, offset: float, unit: str | None, dtype: str
) -> None:
    length_m = FEET.get(str(unit), 1.0)
    values = (houses.heights_m() / length_m - offset) / scale
    stored = np.round(values).astype(dtype) if dtype == "int32" else values.astype(dtype)
    path = houses.write_terrain(tmp_path / "t.tif", stored, scale=scale, offset=offset, unit=unit)
    read, _ = read_terrain(path)
    rounding_m = abs(scale) * length_m / 2 if dtype == "int32" else 1e-4
    np.testing.assert_allclose(read.height_m, houses.heights_m(), atol=rounding_m + 1e-4)


def test_heights_in_the_unit_of_the_vertical_crs(tmp_path: Path) -> None:
    values = (houses.heights_m() / houses.SURVEY_FOOT_M).astype(np.float32)
    path = houses.write_terrain(tmp_path / "t.tif", values, "EPSG:26910", "EPSG:26910+6360")
    np.testing.assert_allclose(read_terrain(path)[0].height_m, houses.heights_m(), atol=1e-3)
    # what the user states counts more
    np.testing.assert_allclose(read_terrain(path, unit="m")[0].height_m, values)


def test_an_unknown_unit_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = houses.write_terrain(tmp_path / "t.tif", houses.heights_m().astype(np.float32), unit="vara")
    read_terrain(path)
    assert "its heights are in vara, an unknown unit (--terrain-unit" in caplog.text


@pytest.mark.parametrize("fill", [-9999, -32767, 3.4028234663852886e38, -3.4e38, 99999, np.inf, 0, -100])
def test_cells_that_cannot_be_ground_are_holes(
    tmp_path: Path, fill: float, caplog: pytest.LogCaptureFixture
) -> None:
    values = (houses.heights_m() + 100).astype(np.float32)
    values[:, :23] = fill
    read, _ = read_terrain(houses.write_terrain(tmp_path / "t.tif", values))
    assert np.isnan(read.height_m[:, :23]).all()
    np.testing.assert_array_equal(read.height_m[:, 23:], values[:, 23:])
    assert caplog.text.count("no ground is at the heights of 1380 of its cells") == 1
    assert "--terrain-unit" not in caplog.text


def test_a_raster_in_centimetres_of_which_most_is_no_height_names_the_remedy(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = houses.write_terrain(tmp_path / "t.tif", (houses.heights_m() * 100).astype(np.float32))
    assert np.isnan(read_terrain(path)[0].height_m).mean() > 0.5
    assert (
        "of its cells" in caplog.text
        and "(--terrain-unit states their unit, if it is another)" in caplog.text
    )
    np.testing.assert_allclose(read_terrain(path, unit="cm")[0].height_m, houses.heights_m(), atol=1e-3)


def test_an_asc_without_nodata_value(tmp_path: Path) -> None:
    rows = "\n".join("-9999 " + "250.0 " * 4 for _ in range(5))
    (tmp_path / "t.asc").write_text(f"ncols 5\nnrows 5\nxllcorner 0\nyllcorner 0\ncellsize 1\n{rows}\n")
    read, _ = read_terrain(tmp_path / "t.asc", "EPSG:2154")
    np.testing.assert_array_equal(read.height_m, [[np.nan, 250, 250, 250, 250]] * 5)


def test_cliffs_towers_and_the_sea_stay() -> None:
    heights = np.full((40, 40), 300.0, np.float32) + np.random.default_rng(0).normal(0, 1, (40, 40))
    heights[20:] -= 250  # a cliff
    heights[30:] = 0.0  # the sea
    heights[5, 5] = -80.0  # a pit of one cell is no ground
    cleaned = without_impossible(Terrain(heights.astype(np.float32), 0, 40, 1), "t")
    assert np.argwhere(np.isnan(cleaned.height_m)).tolist() == [[5, 5]]


def test_a_point_raster_is_where_its_points_are(tmp_path: Path) -> None:
    """A cell of a raster of points is around its point: GDAL moves the corner by half a cell."""
    values = houses.heights_m().astype(np.float32)
    path = houses.write_terrain(tmp_path / "t.tif", values)
    with rasterio.open(path, "r+") as raster:
        raster.update_tags(AREA_OR_POINT="Point")
    read, _ = read_terrain(path)
    assert (read.x_min_m, read.y_max_m) == (652_000 - 60, 6_862_000 + 60)


def test_a_missing_source_of_a_vrt_is_named(tmp_path: Path) -> None:
    terrain = Terrain(np.ones((4, 4), np.float32), 0, 4, 1)
    write_terrain(tmp_path / "t.tif", terrain, "EPSG:2154", {})
    rasterio.shutil.copy(tmp_path / "t.tif", tmp_path / "t.vrt", driver="VRT")
    (tmp_path / "t.tif").unlink()
    with pytest.raises(InputError, match=r"t\.vrt: .*t\.tif: No such file"):
        read_terrain(tmp_path / "t.vrt")


def test_heights_of_a_few_places_are_read_from_the_raster_as_it_is() -> None:
    """As numbers of 64 bits it would take twice its memory, for each batch of buildings."""
    terrain = Terrain(np.ones((1000, 1000), np.float32), 0.0, 1000.0, 1.0)
    tracemalloc.start()
    assert terrain.interpolated(np.array([500.0]), np.array([500.0])).tolist() == [1.0]
    assert tracemalloc.get_traced_memory()[1] < terrain.height_m.nbytes / 10
    tracemalloc.stop()
