"""Two houses whose truth is known, as clouds, footprints and terrains that state their CRS and units in many ways.

A gable house of 12 x 8 m, eave 5.00 m and ridge 8.36 m above the ground, and a flat one of 10 x 10 x 6 m.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import geopandas as gpd
import laspy
import numpy as np
import pyproj
import rasterio
import shapely
from laspy.vlrs.geotiff import GeoKeyEntryStruct
from laspy.vlrs.known import GeoKeyDirectoryVlr, WktCoordinateSystemVlr
from rasterio.transform import from_origin

EAVE_M, RIDGE_M, FLAT_M, GROUND_M = 5.0, 8.36, 6.0, 100.0
GABLE, FLAT = shapely.box(-6, -4, 6, 4), shapely.box(15, -5, 25, 5)
VOLUME_M3 = {"gable": 12 * 8 * (EAVE_M + RIDGE_M) / 2, "flat": 10 * 10 * FLAT_M}
FOOT_M, SURVEY_FOOT_M = 0.3048, 1200 / 3937
HALF_M = 28.0
# the middle between the houses, in a CRS in metres of its place
PLACES = {"EPSG:2154": (652_000.0, 6_862_000.0), "EPSG:26910": (500_000.0, 4_100_000.0)}


def points(spacing_m: float = 0.8) -> tuple[np.ndarray, np.ndarray]:
    """(points (n, 3) around the origin, ground at 100 m; LAS classes)."""
    draw = np.random.default_rng(7)
    xy = np.stack(np.meshgrid(*2 * [np.arange(-HALF_M, HALF_M, spacing_m)]), axis=-1).reshape(-1, 2)
    xy = xy + draw.uniform(-0.3, 0.3, xy.shape) * spacing_m
    in_gable, in_flat = (shapely.contains_xy(each, *xy.T) for each in (GABLE, FLAT))
    z = np.where(in_gable, RIDGE_M - np.abs(xy[:, 1]) * (RIDGE_M - EAVE_M) / 4, 0.0)
    z = np.where(in_flat, FLAT_M, z) + GROUND_M + draw.normal(0, 0.02, len(xy))
    return np.column_stack([xy, z]), np.where(in_gable | in_flat, 6, 2).astype(np.uint8)


def placed(xy: np.ndarray, place: str, crs: Any) -> np.ndarray:
    """Local coordinates (n, 2), metres, at a place, in any CRS, x before y."""
    metres = xy + PLACES[place]
    if pyproj.CRS(place) == pyproj.CRS(crs):
        return metres
    return np.column_stack(pyproj.Transformer.from_crs(place, crs, always_xy=True).transform(*metres.T))


def header(
    wkt: str | None = None, keys: Mapping[int, int] | None = None, is_new: bool | None = None
) -> laspy.LasHeader:
    """A header that states WKT and GeoTIFF keys; LAS 1.4 by default with WKT, else LAS 1.2."""
    is_new = wkt is not None if is_new is None else is_new
    result = laspy.LasHeader(version="1.4" if is_new else "1.2", point_format=6 if is_new else 3)
    if wkt is not None:
        result.vlrs.append(WktCoordinateSystemVlr(wkt))
        result.global_encoding.wkt = is_new
    if keys is not None:
        record = GeoKeyDirectoryVlr()
        stated = {1024: 1, 1025: 1, **keys}
        record.geo_keys_header.number_of_keys = len(stated)
        record.geo_keys = [GeoKeyEntryStruct(key, 0, 1, value) for key, value in sorted(stated.items())]
        result.vlrs.append(record)
    return result


def write_cloud(
    path: Path,
    place: str = "EPSG:2154",
    crs: Any = None,
    height_unit_m: float = 1.0,
    stated: laspy.LasHeader | None = None,
    spacing_m: float = 0.8,
) -> Path:
    """A cloud in ``crs``, that of the place by default, which states what the header does, or ``crs`` as WKT."""
    crs = pyproj.CRS(place if crs is None else crs)
    xyz, classes = points(spacing_m)
    x, y = placed(xyz[:, :2], place, crs.sub_crs_list[0] if crs.is_compound else crs).T
    stated = header(crs.to_wkt()) if stated is None else stated
    is_degrees = np.abs(x).max() <= 180
    stated.scales = np.array([1e-8, 1e-8, 1e-3] if is_degrees else [1e-3] * 3)
    stated.offsets = np.array([np.floor(x[0]), np.floor(y[0]), 0.0])
    las = laspy.LasData(stated)
    las.x, las.y, las.z, las.classification = x, y, xyz[:, 2] / height_unit_m, classes
    las.write(path)
    return path


def footprints(place: str = "EPSG:2154", crs: Any = None, **columns: Sequence[Any]) -> gpd.GeoDataFrame:
    """Both footprints in ``crs``, that of the place by default."""
    shapes = [shapely.affinity.translate(each, *PLACES[place]) for each in (GABLE, FLAT)]
    frame = gpd.GeoDataFrame({"id": ["gable", "flat"], **columns}, geometry=shapes, crs=place)
    return frame if crs is None else frame.to_crs(crs)


def write_footprints(path: Path, place: str = "EPSG:2154", crs: Any = None, **columns: Sequence[Any]) -> Path:
    """A file of them."""
    footprints(place, crs, **columns).to_file(path)
    return path


def heights_m(cells: int = 60) -> np.ndarray:
    """A gentle slope, (cells, cells), about 100 m."""
    row, column = np.mgrid[:cells, :cells]
    return GROUND_M + 0.002 * (column - row)


def write_terrain(
    path: Path,
    values: np.ndarray,
    place: str = "EPSG:2154",
    crs: Any = None,
    scale: float = 1.0,
    offset: float = 0.0,
    unit: str | None = None,
    unit_of_plane_m: float = 1.0,
    **profile: Any,
) -> Path:
    """A raster of cells of 2 m around the place, which states what is given."""
    x, y = np.array(PLACES[place]) / unit_of_plane_m
    half, cell = len(values) / unit_of_plane_m, 2.0 / unit_of_plane_m
    options = {
        "driver": "GTiff",
        "dtype": values.dtype.name,
        "crs": place if crs is None else crs,
        "transform": from_origin(x - half, y + half, cell, cell),
        **profile,
    }
    rows, columns = values.shape
    with rasterio.open(path, "w", width=columns, height=rows, count=1, **options) as raster:
        raster.write(values, 1)
        if (scale, offset) != (1.0, 0.0):
            raster.scales, raster.offsets = (scale,), (offset,)
        if unit is not None:
            raster.units = (unit,)
    return path
