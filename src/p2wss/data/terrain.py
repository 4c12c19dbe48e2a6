"""Terrain: a north-up raster of heights, and its GeoTIFF."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyproj
import scipy

from p2wss.data.tiling import Bounds
from p2wss.storage import files, integrity
from p2wss.storage.errors import InputError, reading
from p2wss.storage.log_lines import log

if TYPE_CHECKING:
    import rasterio

# 20 km by 20 km at 0.5 m, 6.4 GB
_MAX_CELLS = 1_600_000_000
# no compression packs more cells into a byte of a file, except in small ones
_CELLS_PER_BYTE, _SMALL_CELLS = 1000, 10_000_000


@dataclass(frozen=True)
class Terrain:
    """A north-up raster of heights.

    height_m: float32 (rows, columns), NaN where there are no data; row 0 is the northernmost. x_min_m, y_max_m:
    outer corner of the north-west cell. cell_m: edge length of the square cells. A height is that of the centre
    of its cell.
    """

    height_m: np.ndarray
    x_min_m: float
    y_max_m: float
    cell_m: float

    def cut(self, bounds: Bounds) -> Terrain:
        """The cells with centres in ``bounds`` and one more on each side, so that interpolation covers ``bounds``."""
        rows, columns = self.height_m.shape
        x_min, y_min, x_max, y_max = bounds
        left = max(0, int(np.floor((x_min - self.x_min_m) / self.cell_m - 0.5)))
        top = max(0, int(np.floor((self.y_max_m - y_max) / self.cell_m - 0.5)))
        right = min(columns, int(np.ceil((x_max - self.x_min_m) / self.cell_m - 0.5)) + 1)
        bottom = min(rows, int(np.ceil((self.y_max_m - y_min) / self.cell_m - 0.5)) + 1)
        return Terrain(
            self.height_m[top : max(bottom, top), left : max(right, left)],
            self.x_min_m + left * self.cell_m,
            self.y_max_m - top * self.cell_m,
            self.cell_m,
        )

    def interpolated(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Bilinear height at each point, float64 (n,); NaN if one of the four nearest cells is missing or NaN."""
        column = (np.asarray(x_m) - self.x_min_m) / self.cell_m - 0.5
        row = (self.y_max_m - np.asarray(y_m)) / self.cell_m - 0.5
        heights = self.height_m.astype(np.float64)
        return scipy.ndimage.map_coordinates(
            heights, [row, column], order=1, mode="constant", cval=np.nan, prefilter=False
        )


def check_size(raster: rasterio.DatasetReader, path: str | Path) -> None:
    """Raise :class:`InputError` for a raster of more cells than anyone needs, or than its file can hold."""
    cells = raster.width * raster.height
    has_own_cells = raster.driver == "GTiff" and Path(path).is_file()
    limit = max(_CELLS_PER_BYTE * Path(path).stat().st_size, _SMALL_CELLS) if has_own_cells else _MAX_CELLS
    if cells > min(limit, _MAX_CELLS):
        raise InputError(
            f"{path}: states {raster.width} x {raster.height} cells; cut it to the area needed if that is right"
        )


def read_terrain(path: str | Path, crs: str | None = None) -> tuple[Terrain, pyproj.CRS]:
    """Read a raster of heights (first band) and its CRS; the nodata value becomes NaN.

    crs: assumed, with a note, for a raster that does not state one, such as most files .asc.

    Raises :class:`InputError` if the file is missing, unreadable, rotated or without CRS, or has cells that are not
    square.
    """
    import rasterio  # most runs have no terrain

    if not str(path).startswith("/vsi") and not Path(path).exists():
        raise InputError(f"{path}: no such file")
    integrity.verify(path)
    with reading(path, "a readable raster"), rasterio.open(path) as raster:
        check_size(raster, path)
        heights = raster.read(1, out_dtype="float32", masked=True).filled(np.nan)
        transform, stated = raster.transform, raster.crs
    if transform.b or transform.d or transform.a <= 0 or abs(transform.a + transform.e) > 1e-6 * transform.a:
        raise InputError(f"{path}: must be a north-up raster with square cells; resample it with gdalwarp")
    if stated is None and crs is None:
        raise InputError(f"{path}: has no CRS; set one with gdal_edit or gdal_translate -a_srs")
    terrain_crs = pyproj.CRS.from_user_input(stated or crs)
    if stated is None:
        log.info("note: %s does not state its CRS; assuming %s", path, terrain_crs.name)
    return Terrain(heights, transform.c, transform.f, transform.a), terrain_crs


def write_terrain(path: str | Path, terrain: Terrain, crs: str, metadata: dict[str, Any]) -> None:
    """Write a GeoTIFF: float32, deflate, NaN as nodata; ``metadata`` is stored as JSON in the tag ``p2wss``."""
    from rasterio.io import MemoryFile
    from rasterio.transform import from_origin

    rows, columns = terrain.height_m.shape
    profile = {
        "driver": "GTiff",
        "width": columns,
        "height": rows,
        "count": 1,
        "dtype": "float32",
        "crs": crs,
        "transform": from_origin(terrain.x_min_m, terrain.y_max_m, terrain.cell_m, terrain.cell_m),
        "nodata": np.nan,
        "compress": "deflate",
        "predictor": 3,
    }
    # GDAL does not report a full disk, but writing its bytes does
    with MemoryFile() as file:
        with file.open(**profile) as raster:
            raster.write(terrain.height_m.astype(np.float32), 1)
            raster.update_tags(p2wss=json.dumps(metadata))
        files.write_bytes(path, file.getbuffer(), seal=True)
