from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine, from_origin
from scipy.interpolate import RegularGridInterpolator

from p2wss.data.terrain import Terrain, read_terrain, write_terrain
from p2wss.storage.errors import InputError


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
