"""Source ``folder``: files on disk, such as BD TOPO, RGE ALTI and LiDAR HD as IGN delivers them."""

from contextlib import ExitStack
from dataclasses import replace
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
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT

from p2wss.config import Folder
from p2wss.data.crs import bounds_in_crs, check_crs, reprojected
from p2wss.data.listing import CLOUD, RASTER, VECTOR, list_files
from p2wss.data.terrain import Terrain, check_north_up, height_scale, without_impossible
from p2wss.data.tiling import Bounds, are_near, bounds_text, tile_bounds, tiles_of_bounds
from p2wss.fetching.cloud import extent_of, read_header
from p2wss.footprints.vector_files import decoded, layer_info, layers_of
from p2wss.storage.las_crs import horizontal, same_crs
from p2wss.storage.messages import InputError, log, reading

# rasters have the same grid if their cells differ by less, in cells
_SAME_CELL = 1e-3


class FolderSource:
    """Files on disk, see :class:`p2wss.fetching.source.Source`."""

    def __init__(self, config: Folder, crs: str) -> None:
        self.config = config
        self.crs = crs
        self.name = config.footprints

    def footprints(self, bounds: Bounds) -> gpd.GeoDataFrame:
        """See :class:`p2wss.fetching.source.Source`. Raises :class:`InputError` if a file is missing or not usable."""
        files = list_files(self.config.footprints, VECTOR, "fetch.folder.footprints")
        frames = [
            read_footprint_window(path, self.config.footprints_layer, bounds, self.crs) for path in files
        ]
        if len(files) > 1:
            # ids of a source without ids are numbers of features, which repeat from file to file; so may names of files
            stems = [path.stem for path in files]
            names = [
                stem if stems.count(stem) == 1 else f"{number + 1}-{stem}"
                for number, stem in enumerate(stems)
            ]
            frames = [
                frame.set_axis([f"{name}-{number}" for number in frame.index])
                for name, frame in zip(names, frames, strict=True)
            ]
        return pd.concat(frames)

    def dtm(self, bounds: Bounds) -> Terrain:
        """See :class:`p2wss.fetching.source.Source`. Raises :class:`InputError` if a file is missing or not usable."""
        files = list_files(self.config.dtm, RASTER, "fetch.folder.dtm")
        return mosaic(files, bounds, self.crs, self.config.dtm)

    def lidar(self, bounds: Bounds) -> list[Path]:
        """See :class:`p2wss.fetching.source.Source`. Raises :class:`InputError` if no file overlaps ``bounds``."""
        files = list_files(self.config.lidar, CLOUD, "fetch.folder.lidar")
        window = bounds_in_crs(bounds, self.crs, self.config.lidar_crs or self.crs)
        paths = [path for path in files if _overlaps(path, window)]
        if not paths:
            raise InputError(
                f"{self.config.lidar}: none of its {len(files)} files has points in {bounds_text(bounds)}"
            )
        return paths


def read_footprint_window(path: Path, layer: str, bounds: Bounds, crs: str) -> gpd.GeoDataFrame:
    """The features of a vector file that intersect ``bounds``, read through the file's spatial index.

    layer: name of the layer; a file with a single layer may use another name. Features in another CRS, such as IGN's
    national GeoParquet in degrees, are reprojected to ``crs``, with a note (:func:`p2wss.data.crs.reprojected`);
    features without a CRS are returned as they are.

    Raises :class:`InputError` if the file is broken, has several layers and none is called ``layer``, or is in a CRS
    that cannot be transformed.
    """
    with reading(path, "a readable vector file"):
        if path.suffix == ".parquet":
            frame = _read_geoparquet(path, bounds, crs)
        else:
            layers = [name for name, _ in layers_of(path)]
            if layer not in layers and len(layers) != 1:
                raise InputError(
                    f"{path}: has no layer {layer}, but {', '.join(layers)}; "
                    "set fetch.folder.footprints_layer"
                )
            name = layer if layer in layers else layers[0]
            window = _window(path, bounds, crs, decoded(path, pyogrio.read_info, layer=name)["crs"])
            frame = decoded(path, pyogrio.read_dataframe, layer=name, bbox=window, fid_as_index=True)
    region_crs = horizontal(pyproj.CRS.from_user_input(crs))
    if frame.crs is None:
        return frame
    if same_crs(frame.crs, region_crs):
        return frame.set_crs(region_crs, allow_override=True)
    shapes = reprojected(frame.geometry.to_numpy(), frame.crs, region_crs, path)
    frame = frame.set_geometry(shapes).set_crs(region_crs, allow_override=True)
    return frame[frame.intersects(shapely.box(*bounds))]


def _read_geoparquet(path: Path, bounds: Bounds, crs: str) -> gpd.GeoDataFrame:
    """The features whose bounding boxes intersect ``bounds``.

    If the file has the bounding boxes in a covering column, as IGN's files do, only the row groups that intersect
    ``bounds`` are read.
    """
    window = _window(path, bounds, crs, layer_info(path)["crs"])
    try:
        return gpd.read_parquet(path, bbox=window)
    except ValueError as error:
        if "bbox" not in str(error):
            raise
    frame = gpd.read_parquet(path)
    return frame[frame.intersects(shapely.box(*window))]


def _window(path: Path, bounds: Bounds, crs: str, file_crs: Any) -> Bounds:
    """``bounds`` in the CRS of a file; unchanged for a file without a CRS."""
    if file_crs is None:
        return bounds
    try:
        window = bounds_in_crs(bounds, crs, file_crs)
    except pyproj.exceptions.ProjError:
        window = (np.inf, np.inf, np.inf, np.inf)
    if not np.isfinite(window).all():
        name = pyproj.CRS.from_user_input(file_crs).name
        raise InputError(f"{path}: is in {name}, to which the bounds of the region cannot be transformed")
    return window


def mosaic(files: list[Path], bounds: Bounds, crs: str, name: str) -> Terrain:
    """Heights from all rasters that intersect ``bounds``, on the grid of the first; NaN where none has data.

    Rasters on the same grid are copied, others are interpolated bilinearly. Heights become metres by the unit, scale
    and offset that the rasters state. name: used in messages.

    Raises :class:`InputError` if no file covers ``bounds``, or if one that does is unreadable, in another CRS than
    ``crs``, or in another unit than the others.
    """
    rasters: list[DatasetReader] = []
    with ExitStack() as stack:
        for path in files:
            with reading(path, "a readable raster"):
                raster = stack.enter_context(rasterio.open(path))
            check_north_up(raster.transform, path)
            if rasterio.coords.disjoint_bounds(raster.bounds, bounds):
                continue
            rasters.append(raster)
            # .asc files do not state a CRS
            check_crs(pyproj.CRS.from_user_input(raster.crs) if raster.crs else None, crs, path)
        if not rasters:
            raise InputError(f"{name}: none of its {len(files)} files covers {bounds_text(bounds)}")
        _warn_of_gaps([raster.bounds for raster in rasters], bounds, name)
        paths = {height_scale(raster): raster.name for raster in reversed(rasters)}
        if len(paths) > 1:
            *_, other, first = paths.values()
            raise InputError(f"{other}: its heights have another unit, scale or offset than those of {first}")
        terrain, ((scale, offset),) = _merged(rasters, bounds, crs), paths
        height_m = terrain.height_m * np.float32(scale) + np.float32(offset)
        return without_impossible(replace(terrain, height_m=height_m), name)


def _merged(rasters: list[DatasetReader], bounds: Bounds, crs: str) -> Terrain:
    grid = rasters[0].transform
    cell = grid.a
    # extended outwards to whole cells of the first raster's grid
    left = grid.c + np.floor((bounds[0] - grid.c) / cell) * cell
    right = grid.c + np.ceil((bounds[2] - grid.c) / cell) * cell
    bottom = grid.f - np.ceil((grid.f - bounds[1]) / cell) * cell
    top = grid.f - np.floor((grid.f - bounds[3]) / cell) * cell
    with (
        reading(f"{rasters[0].name} or a neighbouring file", "a readable raster, or truncated"),
        ExitStack() as stack,
    ):
        heights, transform = rasterio.merge.merge(
            [stack.enter_context(_on_grid(raster, grid, crs)) for raster in rasters],
            bounds=(left, bottom, right, top),
            res=(cell, cell),
            nodata=np.nan,
            dtype="float32",
            indexes=[1],
        )
    return Terrain(heights[0], transform.c, transform.f, cell)


def _on_grid(raster: DatasetReader, grid: Affine, crs: str) -> WarpedVRT:
    """The raster on whole cells of ``grid``: copied if its own cells are cells of the grid, else interpolated. Merging
    alone would stretch its rows and columns to whole cells."""
    own, (left, bottom, right, top) = raster.transform, raster.bounds
    corner, last = (np.array((~grid) * xy) for xy in ((left, top), (right, bottom)))
    is_copy = np.isclose(own.a, grid.a) and np.allclose(corner, np.rint(corner), atol=_SAME_CELL)
    (west, north), (east, south) = np.floor(corner + _SAME_CELL), np.ceil(last - _SAME_CELL)
    return WarpedVRT(
        raster,
        src_crs=crs,
        crs=crs,
        transform=grid * Affine.translation(west, north),
        width=int(east - west),
        height=int(south - north),
        nodata=np.nan,
        dtype="float32",
        resampling=Resampling.nearest if is_copy else Resampling.bilinear,
    )


def _warn_of_gaps(raster_bounds: list[Bounds], bounds: Bounds, name: str) -> None:
    """Warn of the square kilometres of ``bounds`` that no file covers, by IGN's names of tiles."""
    missing_tiles = [
        tile
        for tile in tiles_of_bounds(bounds, 1000)
        if all(rasterio.coords.disjoint_bounds(b, tile_bounds(tile, 1000, -10)) for b in raster_bounds)
    ]
    if missing_tiles:
        log.warning(f"{name}: no file covers {', '.join(missing_tiles)}; the terrain is unknown there")


def _overlaps(path: Path, bounds: Bounds) -> bool:
    """Whether the extent of a cloud and ``bounds`` overlap by more than half a metre. A cloud without a stated extent,
    or with a wrong one, may overlap; an empty cloud does not."""
    stated = extent_of(path)
    return read_header(path).point_count > 0 and (stated is None or are_near(stated, bounds, -0.5))
