"""Terrain: a north-up raster of heights, and its GeoTIFF."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyproj
import scipy

from p2wss.data.tiling import Bounds
from p2wss.storage import files, integrity
from p2wss.storage.las_crs import placed, unit_m, vertical_part
from p2wss.storage.messages import InputError, log, reading

if TYPE_CHECKING:
    import rasterio

# 20 km by 20 km at 0.5 m, 6.4 GB
_MAX_CELLS = 1_600_000_000
# a larger raster is read only where it is needed; 5 km by 5 km at 1 m are read whole
_WHOLE_CELLS = 25_000_000
# no compression packs more cells into a byte of a file, except in small ones
_CELLS_PER_BYTE, _SMALL_CELLS = 1000, 10_000_000
# limits of heights of the ground, and the difference from all cells beside it with which a cell cannot be ground
_LOWEST_M, _HIGHEST_M, _MAX_JUMP_M = -500.0, 9000.0, 150.0
# lengths of units of heights, metres, by the names that rasters have for them
UNITS_M = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), 0.3048),
    **dict.fromkeys(("us-ft", "us survey foot", "us survey feet", "foot_us", "ftus", "sft"), 1200 / 3937),
    **dict.fromkeys(("dm", "decimetre", "decimeter"), 0.1),
    **dict.fromkeys(("cm", "centimetre", "centimeter"), 0.01),
    **dict.fromkeys(("mm", "millimetre", "millimeter"), 0.001),
}


@dataclass(frozen=True)
class Terrain:
    """A north-up raster of heights.

    height_m: float32 (rows, columns), at the centres of cells, NaN where there are no data; row 0 is the northernmost.
    x_min_m, y_max_m: outer corner of the north-west cell. cell_m: edge length of the square cells.
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

    def warped(self, crs: str, target: str) -> Terrain:
        """The raster in another CRS, both as WKT: bilinear, with cells of about the same size."""
        from rasterio.transform import array_bounds, from_origin
        from rasterio.warp import Resampling, calculate_default_transform, reproject

        rows, columns = self.height_m.shape
        before = from_origin(self.x_min_m, self.y_max_m, self.cell_m, self.cell_m)
        bounds = array_bounds(rows, columns, before)
        after, width, height = calculate_default_transform(crs, target, columns, rows, *bounds)
        height_m = np.full((height, width), np.nan, np.float32)
        reproject(
            self.height_m,
            height_m,
            src_transform=before,
            src_crs=crs,
            src_nodata=np.nan,
            dst_transform=after,
            dst_crs=target,
            dst_nodata=np.nan,
            resampling=Resampling.bilinear,
        )
        return Terrain(height_m, after.c, after.f, after.a)

    def interpolated(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Bilinear height at each point, float64 (n,); NaN if one of the four nearest cells is missing or NaN."""
        column = (np.asarray(x_m) - self.x_min_m) / self.cell_m - 0.5
        row = (self.y_max_m - np.asarray(y_m)) / self.cell_m - 0.5
        return scipy.ndimage.map_coordinates(
            self.height_m, [row, column], np.float64, order=1, mode="constant", cval=np.nan, prefilter=False
        )


def check_size(raster: rasterio.DatasetReader, path: str | Path, read: tuple[int, ...] | None = None) -> None:
    """Raise :class:`InputError` for more cells than anyone needs, or than the file can hold. read: rows and columns of
    the part that is read; None for the whole raster."""
    rows, columns = read or raster.shape
    cells = rows * columns
    has_own_cells = raster.driver == "GTiff" and Path(path).is_file()
    limit = max(_CELLS_PER_BYTE * Path(path).stat().st_size, _SMALL_CELLS) if has_own_cells else _MAX_CELLS
    if cells > min(limit, _MAX_CELLS):
        raise InputError(
            f"{path}: states {columns} x {rows} cells; cut it to the area needed if that is right"
        )


def check_north_up(transform: rasterio.Affine, path: str | Path) -> None:
    """Raise :class:`InputError` for a raster that is rotated, south-up, or has cells that are not square."""
    if transform.b or transform.d or transform.a <= 0 or abs(transform.a + transform.e) > 1e-6 * transform.a:
        raise InputError(f"{path}: must be a north-up raster with square cells; resample it with gdalwarp")


def read_terrain(
    path: str | Path,
    crs: str | None = None,
    unit: str = "",
    unstated_m: Callable[[pyproj.CRS], float] = lambda crs: 1.0,
    windows: Callable[[pyproj.CRS], Iterable[Bounds]] = lambda crs: (),
) -> tuple[Terrain, pyproj.CRS]:
    """Read a raster of heights (first band) in metres, and its CRS.

    Scale, offset and unit of the band are used, and the unit of the vertical part of its CRS. Cells without data become
    NaN, and so do heights that cannot be.

    crs: assumed, with a note, for a raster that does not state one, such as most files .asc. unit: of the heights,
    whatever the raster states: a key of :data:`UNITS_M`. unstated_m: length in metres of the unit of heights where the
    raster states none, given its CRS. windows: of a raster with more than 25 million cells only a window is read: the
    first of these, in its CRS, with fewer cells, else the last.

    Raises :class:`InputError` if the file is missing, unreadable, rotated or without CRS, or has cells that are not
    square, or none in the window.
    """
    import rasterio  # most runs have no terrain

    if not str(path).startswith("/vsi") and not Path(path).exists():
        raise InputError(f"{path}: no such file")
    integrity.verify(path)
    with reading(path, "a readable raster"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what it lacks is said below
        with rasterio.open(path) as raster:
            transform, stated, num_bands = raster.transform, raster.crs, raster.count
            check_north_up(transform, path)
            with reading(path, "a raster in a CRS that PROJ knows"):
                stated = None if stated is None else placed(pyproj.CRS.from_user_input(stated))
                terrain_crs = (
                    pyproj.CRS.from_user_input(crs) if stated is None and crs is not None else stated
                )
            if terrain_crs is None:
                raise InputError(f"{path}: has no CRS; set one with gdal_edit or gdal_translate -a_srs")
            # without memory for its cells
            all_cells = Terrain(
                np.broadcast_to(np.float32(0), raster.shape), transform.c, transform.f, transform.a
            )
            part = all_cells
            for bounds in windows(terrain_crs) if all_cells.height_m.size > _WHOLE_CELLS else ():
                part = all_cells.cut(bounds)
                if part.height_m.size <= _WHOLE_CELLS:
                    break
            if not part.height_m.size:
                raise InputError(
                    f"{path}: is in {terrain_crs.name}, and has no cell at the place of the run: is that its CRS?"
                )
            rows, columns = part.height_m.shape
            check_size(raster, path, (rows, columns))
            left = round((part.x_min_m - transform.c) / transform.a)
            top = round((transform.f - part.y_max_m) / transform.a)
            scale, offset, band_unit = raster.scales[0], raster.offsets[0], raster.units[0] or ""
            is_plain = (scale, offset) == (1.0, 0.0)
            heights = raster.read(
                1,
                window=((top, top + rows), (left, left + columns)),
                out_dtype="float32" if is_plain else "float64",
                masked=True,
            ).filled(np.nan)
    if part is not all_cells:
        text = "note: %s: of its %d x %d cells, the %d x %d around the place of the run are read"
        log.info(text, path, *all_cells.height_m.shape[::-1], columns, rows)
    if stated is None:
        log.info("note: %s does not state its CRS; assuming %s", path, terrain_crs.name)
    if num_bands > 1:
        log.info("note: %s has %d bands; the first is taken for heights", path, num_bands)
    length_m = UNITS_M[unit] if unit else _stated_unit_m(stated, band_unit, path)
    length_m = unstated_m(terrain_crs) if length_m is None else length_m
    if not is_plain or length_m != 1.0:
        heights = ((heights.astype(np.float64) * scale + offset) * length_m).astype(np.float32)
    return without_impossible(replace(part, height_m=heights), path), terrain_crs


def height_scale(raster: rasterio.DatasetReader) -> tuple[float, float]:
    """(scale, offset) with which values of the first band are heights in metres, by what a raster states."""
    crs = None if raster.crs is None else pyproj.CRS.from_user_input(raster.crs)
    length_m = _stated_unit_m(crs, raster.units[0] or "", raster.name) or 1.0
    return raster.scales[0] * length_m, raster.offsets[0] * length_m


def _stated_unit_m(crs: pyproj.CRS | None, band_unit: str, path: str | Path) -> float | None:
    """Length in metres of the unit of heights that a raster states in its band or its CRS, the band's if they differ;
    None if it states none. Unknown units and differences are logged."""
    of_band = UNITS_M.get(band_unit.strip().lower().replace("_", " ").removesuffix("."))
    vertical = None if crs is None else vertical_part(crs)
    of_crs = None if vertical is None else unit_m(vertical)
    if band_unit and of_band is None and of_crs is None:
        log.warning(
            "warning: %s: its heights are in %s, an unknown unit (--terrain-unit states one)", path, band_unit
        )
    if of_band is not None and of_crs is not None and not np.isclose(of_band, of_crs, rtol=1e-6):
        text = (
            "warning: %s: heights are in %s by the band, in units of %.10g m by the CRS; the band's is taken"
        )
        log.warning(text + " (--terrain-unit overrides)", path, band_unit, of_crs)
    return of_crs if of_band is None else of_band


def without_impossible(terrain: Terrain, path: str | Path) -> Terrain:
    """The terrain with NaN in place of heights that cannot be, with a warning that names their number.

    These are heights below -500 m or above 9,000 m, and values that differ by more than 150 m from all other values
    beside them, wherever they occur.
    """
    height_m = terrain.height_m
    with np.errstate(invalid="ignore"):
        wrong = (height_m < _LOWEST_M) | (height_m > _HIGHEST_M) | np.isinf(height_m)
    height_m = np.where(wrong, np.float32(np.nan), height_m) if wrong.any() else height_m
    lone = _lone(height_m)
    if not (wrong.any() or lone.any()):
        return terrain
    values, counts = np.unique(terrain.height_m[wrong | lone], return_counts=True)
    number, most = int(counts.sum()), values[counts.argmax()]
    text = "warning: %s: no ground is at the heights of %d of its cells, such as %g m; they count as without data"
    if 2 * number > np.count_nonzero(~np.isnan(terrain.height_m)):
        text += " (--terrain-unit states their unit, if it is another)"
    log.warning(text, path, number, most)
    return replace(terrain, height_m=np.where(lone, np.float32(np.nan), height_m))


def _lone(height_m: np.ndarray) -> np.ndarray:
    """bool (rows, columns): the cells whose value differs by more than 150 m from every other value beside it, wherever
    this value occurs in the raster."""
    is_far, is_tied = np.zeros((2, *height_m.shape), bool)
    with np.errstate(invalid="ignore"):
        # by columns, too, in views that are turned
        for height, *results in ((height_m, is_far, is_tied), (height_m.T, is_far.T, is_tied.T)):
            step_m = np.abs(np.diff(height, axis=0))
            far, tied = step_m > _MAX_JUMP_M, (step_m > 0) & (step_m <= _MAX_JUMP_M)
            for result, found in zip(results, (far, tied), strict=True):
                result[:-1] |= found
                result[1:] |= found
    if not is_far.any():
        return is_far
    values = np.setdiff1d(height_m[is_far & ~is_tied], height_m[is_tied])
    lone = np.isin(height_m, values)
    # if no other value remains, the most frequent one is the ground
    levels, counts = np.unique(height_m[np.isfinite(height_m)], return_counts=True)
    if np.isfinite(height_m).sum() == lone.sum():
        lone &= height_m != levels[counts.argmax()]
    return lone


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
