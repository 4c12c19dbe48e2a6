"""Files that are already on disk: BD TOPO, RGE ALTI and LiDAR HD as delivered, or others like them."""

from __future__ import annotations

import logging
from glob import glob
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import pyproj
import rasterio
import rasterio.merge
import shapely
from rasterio.enums import Resampling
from rasterio.io import DatasetReader

from p2wss.config import Folder
from p2wss.data.archives import is_archive, unpack
from p2wss.data.clouds import same_crs
from p2wss.data.terrain import Terrain
from p2wss.data.tiling import Bounds, tile_bounds, tiles_of_bounds
from p2wss.errors import InputError
from p2wss.fetch import parquet
from p2wss.fetch.cloud import read_header

log = logging.getLogger(__name__)
VECTOR = (".gpkg", ".shp", ".parquet", ".geojson", ".fgb")
RASTER = (".asc", ".tif", ".tiff", ".vrt", ".7z", ".7z.001")
CLOUD = (".laz", ".las")


class FolderSource:
    """See :class:`p2wss.fetch.Source`."""

    def __init__(self, config: Folder, crs: str, unpacked: Path) -> None:
        self.config = config
        self.crs = crs
        self.name = config.footprints
        self.unpacked = unpacked  # where grids out of archives are kept

    def footprints(self, bounds: Bounds) -> gpd.GeoDataFrame:
        files = _files(self.config.footprints, VECTOR, "fetch.folder.footprints")
        return pd.concat(
            [read_footprint_window(path, self.config.footprints_layer, bounds, self.crs) for path in files],
            ignore_index=True,
        )

    def dtm(self, bounds: Bounds) -> Terrain:
        files = []
        for path in _files(self.config.dtm, RASTER, "fetch.folder.dtm"):
            if is_archive(path):
                files += unpack(path, bounds, self.unpacked / path.name.split(".7z")[0])
            else:
                files.append(path)
        return mosaic(files, bounds, self.crs, self.config.dtm)

    def lidar(self, bounds: Bounds) -> list[Path]:
        files = _files(self.config.lidar, CLOUD, "fetch.folder.lidar")
        found = [path for path in files if _overlaps(path, self._clouds_bounds(bounds))]
        if not found:
            x_min, y_min, x_max, y_max = bounds
            raise InputError(
                f"{self.config.lidar}: none of its {len(files)} files has points in "
                f"{x_min:.0f}..{x_max:.0f}, {y_min:.0f}..{y_max:.0f}"
            )
        return found

    def _clouds_bounds(self, bounds: Bounds) -> Bounds:
        return in_crs(bounds, self.crs, self.config.lidar_crs or self.crs)


def in_crs(bounds: Bounds, crs: str, other: Any) -> Bounds:
    """The window of ``other`` that holds ``bounds`` of ``crs``; x comes first in both."""
    target = pyproj.CRS.from_user_input(other)
    if same_crs(pyproj.CRS.from_user_input(crs), target):
        return bounds
    transformer = pyproj.Transformer.from_crs(crs, target, always_xy=True)
    west, south, east, north = transformer.transform_bounds(*bounds, densify_pts=21)
    return west, south, east, north


def read_footprint_window(path: Path, layer: str, bounds: Bounds, crs: str) -> gpd.GeoDataFrame:
    """The features of a vector file that meet ``bounds``; the file's index is used, so it may be large.

    layer: used if the file has a layer of that name, else its only layer. A file in degrees, such as IGN's
    national GeoParquet, is brought into ``crs``; one in another projection comes as it is.

    Raises :class:`InputError` for a file that is broken or has several layers of other names.
    """
    try:
        if path.suffix == ".parquet":
            frame = parquet.read_window(path, lambda found: _window(bounds, crs, found))
        else:
            layers = [str(name) for name in pyogrio.list_layers(path)[:, 0]]
            if layer not in layers and len(layers) != 1:
                raise InputError(
                    f"{path}: no layer {layer}, but {', '.join(layers)}; set fetch.folder.footprints_layer"
                )
            name = layer if layer in layers else layers[0]
            window = _window(bounds, crs, pyogrio.read_info(path, layer=name)["crs"])
            # IGN's shapefiles are in UTF-8, without the .cpg file that would say so
            encoding = "utf-8" if path.suffix == ".shp" and not path.with_suffix(".cpg").exists() else None
            try:
                frame = pyogrio.read_dataframe(path, layer=name, bbox=window, encoding=encoding)
            except UnicodeDecodeError:
                frame = pyogrio.read_dataframe(path, layer=name, bbox=window)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable vector file: {' '.join(str(error).split())}") from error
    if frame.crs is None or not frame.crs.is_geographic:
        return frame
    frame = frame.to_crs(crs)
    return frame[frame.intersects(shapely.box(*bounds))]


def _window(bounds: Bounds, crs: str, found: Any) -> Bounds:
    if found is None or not pyproj.CRS.from_user_input(found).is_geographic:
        return bounds
    return in_crs(bounds, crs, found)


def mosaic(files: list[Path], bounds: Bounds, crs: str, name: str) -> Terrain:
    """Heights of all rasters that meet ``bounds``, on the grid of the first; NaN where no file has any.

    They are copied where the grids agree, and interpolated bilinearly where not.

    Raises :class:`InputError` if no file meets ``bounds``, or one that does is unreadable or in another CRS.
    """
    wanted = pyproj.CRS.from_user_input(crs)
    rasters: list[DatasetReader] = []
    try:
        for path in files:
            try:
                raster = rasterio.open(path)
            except rasterio.errors.RasterioIOError as error:
                raise InputError(f"{path}: not a readable raster: {error}") from error
            if rasterio.coords.disjoint_bounds(raster.bounds, bounds):
                raster.close()
                continue
            rasters.append(raster)
            found = pyproj.CRS.from_user_input(raster.crs) if raster.crs else wanted  # .asc files tell none
            if not same_crs(found, wanted):
                raise InputError(
                    f"{path}: is in {found.name}, the region in {wanted.name}; reproject it or set region.crs"
                )
        if not rasters:
            x_min, y_min, x_max, y_max = bounds
            raise InputError(
                f"{name}: none of its {len(files)} files covers "
                f"{x_min:.0f}..{x_max:.0f}, {y_min:.0f}..{y_max:.0f}"
            )
        _warn_of_gaps([raster.bounds for raster in rasters], bounds, name)
        return _merged(rasters, bounds)
    finally:
        for raster in rasters:
            raster.close()


def _merged(rasters: list[DatasetReader], bounds: Bounds) -> Terrain:
    grid = rasters[0].transform
    cell = grid.a
    # outwards to whole cells of the first raster's grid
    left = grid.c + np.floor((bounds[0] - grid.c) / cell) * cell
    right = grid.c + np.ceil((bounds[2] - grid.c) / cell) * cell
    bottom = grid.f - np.ceil((grid.f - bounds[1]) / cell) * cell
    top = grid.f - np.floor((grid.f - bounds[3]) / cell) * cell
    try:
        heights, transform = rasterio.merge.merge(
            rasters,
            bounds=(left, bottom, right, top),
            res=(cell, cell),
            nodata=np.nan,
            dtype="float32",
            indexes=[1],
            resampling=Resampling.bilinear,
        )
    except (rasterio.errors.RasterioIOError, rasterio.errors.RasterioError) as error:
        raise InputError(f"{rasters[0].name} or a neighbour: unreadable or truncated: {error}") from error
    return Terrain(heights[0], transform.c, transform.f, cell)


def _warn_of_gaps(covered: list[Bounds], bounds: Bounds, name: str) -> None:
    """Name the square kilometres of ``bounds`` that no file meets, as IGN names its tiles."""
    missing = [
        tile
        for tile in tiles_of_bounds(bounds, 1000)
        if all(rasterio.coords.disjoint_bounds(other, tile_bounds(tile, 1000, -10)) for other in covered)
    ]
    if missing:
        log.warning(f"{name}: no file for {', '.join(missing)}; no terrain there")


def _overlaps(path: Path, bounds: Bounds) -> bool:
    """Whether a cloud and ``bounds`` share more than an edge."""
    header = read_header(path)
    low, high = header.mins, header.maxs
    return bool(
        header.point_count > 0
        and min(high[0], bounds[2]) - max(low[0], bounds[0]) > 0.5
        and min(high[1], bounds[3]) - max(low[1], bounds[1]) > 0.5
    )


def _files(where: str, suffixes: tuple[str, ...], key: str) -> list[Path]:
    """The files that a path, a folder (with those inside) or a pattern names, in order of their names."""
    path = Path(where)
    if path.is_dir():
        found = [file for file in path.rglob("*") if file.name.lower().endswith(suffixes) and file.is_file()]
    else:
        found = [Path(name) for name in glob(where, recursive=True) if Path(name).is_file()]
    if not found:
        raise InputError(f"{key}: {where}: no such file, and no folder or pattern with {', '.join(suffixes)}")
    return sorted(found)
