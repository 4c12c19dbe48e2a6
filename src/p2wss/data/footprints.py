"""Footprints as they come to polygons for the kernel; each keeps its row, with a reason if it fails."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import shapely

from p2wss import skeleton
from p2wss.config import Scenes
from p2wss.data import polygon_arrays
from p2wss.data.tiling import Bounds
from p2wss.errors import InputError

ID_COLUMNS = ("building_id", "cleabs", "id", "identificatie", "gml_id", "osm_id", "fid")
_HOLD_POLYGONS = [
    shapely.GeometryType.POLYGON,
    shapely.GeometryType.MULTIPOLYGON,
    shapely.GeometryType.GEOMETRYCOLLECTION,
]
# an outline that touches itself is opened by this much: less would be closed again by the clean-up
_OPENING_M = 0.15


def read_footprints(
    path: str | Path,
    id_field: str | None = None,
    bounds: Bounds | None = None,
    needs_crs: bool = True,
) -> gpd.GeoDataFrame:
    """Any vector file with polygons: its columns, and ``building_id`` as text, in the order of the file.

    id_field: column of the ids; without it the first of :data:`ID_COLUMNS` (in any case of letters) whose
    values are all there and all different, else numbers from 1. bounds: only features that meet this window.

    Raises :class:`InputError` if the file is missing, broken or without CRS, or ``id_field`` is no id.
    """
    if not Path(path).exists():
        raise InputError(f"{path}: no such file")
    try:
        if str(path).endswith(".parquet"):
            frame = gpd.read_parquet(path, bbox=bounds)
        else:
            frame = pyogrio.read_dataframe(path, bbox=bounds)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable vector file: {' '.join(str(error).split())}") from error
    if not isinstance(frame, gpd.GeoDataFrame):
        raise InputError(f"{path}: has no geometry")
    shapes = shapely.get_type_id(frame.geometry.to_numpy())
    if len(frame) and not np.isin(shapes, _HOLD_POLYGONS).any():
        raise InputError(f"{path}: no polygons; footprints must be polygons")
    if frame.crs is None and needs_crs:
        raise InputError(f"{path}: has no CRS; set one with ogr2ogr -a_srs")
    if frame.crs is not None and frame.crs.is_geographic:
        raise InputError(
            f"{path}: is in {frame.crs.name}, in degrees; reproject it to a projected CRS in metres"
        )
    frame["building_id"] = _ids(frame, id_field, path)
    return frame


def _ids(frame: gpd.GeoDataFrame, id_field: str | None, path: str | Path) -> pd.Series:
    if id_field is not None:
        if id_field not in frame.columns:
            columns = ", ".join(map(str, frame.columns.drop(frame.geometry.name)))
            raise InputError(f"{path}: no column {id_field}; it has {columns or 'none'}")
        values = frame[id_field]
        if values.isna().any() or values.duplicated().any():
            twice = values[values.isna() | values.duplicated()].iloc[0]
            raise InputError(
                f"{path}: column {id_field} is no id: {twice} occurs more than once or is missing"
            )
        return values.astype(str)
    lower = {str(column).lower(): column for column in frame.columns}
    for name in ID_COLUMNS:
        values = frame[lower[name]] if name in lower else None
        if values is not None and not values.isna().any() and not values.duplicated().any():
            return values.astype(str)
    return pd.Series([str(number + 1) for number in range(len(frame))], index=frame.index, dtype=str)


def split_parts(frame: gpd.GeoDataFrame, min_area_m2: float) -> gpd.GeoDataFrame:
    """One row per polygon, 2D and valid; same columns, ``status``, and ``middle_x_m``, ``middle_y_m``.

    The middle is that of the bounding box, of the geometry as it came where it gives no polygon.

    Invalid outlines are repaired by shapely's ``make_valid`` (method "structure"). Where a multipolygon or a
    repair gives several polygons, the largest stays, and the others if they have ``min_area_m2``; their ids
    end in -1, -2, .. as they come. What gives no polygon keeps its row with an empty one and its ``status``.
    """
    shapes = shapely.force_2d(frame.geometry.to_numpy())
    status = np.full(len(frame), "ok", dtype=object)
    missing = shapely.is_missing(shapes) | shapely.is_empty(shapes)
    status[missing] = "empty"
    areal = np.isin(
        shapely.get_type_id(shapes), [shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON]
    )
    status[~missing & ~areal] = "not-a-polygon"
    middle = _middles(shapes)
    xy, owner = shapely.get_coordinates(shapes, return_index=True)
    status[np.unique(owner[~np.isfinite(xy).all(axis=1)])] = "non-finite"
    shapes[status != "ok"] = shapely.Polygon()
    invalid = ~shapely.is_valid(shapes)
    shapes[invalid] = shapely.make_valid(shapes[invalid], method="structure", keep_collapsed=False)

    parts, owner = shapely.get_parts(shapes, return_index=True)
    areal = (shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & ~shapely.is_empty(parts)
    parts, owner = parts[areal], owner[areal]
    area = shapely.area(parts)
    largest = np.zeros(len(frame))
    np.maximum.at(largest, owner, area)
    keep = (area >= min_area_m2) | (area >= largest[owner])
    parts, owner = parts[keep], owner[keep]
    # rows without any polygon take their place among the others
    bare = np.setdiff1d(np.arange(len(frame)), owner)
    status[bare[status[bare] == "ok"]] = "empty"
    owner = np.concatenate([owner, bare])
    order = np.argsort(owner, kind="stable")
    owner = owner[order]
    result = frame.iloc[owner].reset_index(drop=True)
    result = result.set_geometry(
        gpd.GeoSeries(np.concatenate([parts, np.full(len(bare), shapely.Polygon())])[order], crs=frame.crs)
    )
    number = np.arange(len(owner)) - np.searchsorted(owner, owner)
    several = np.bincount(owner, minlength=len(frame))[owner] > 1
    ids = result["building_id"].to_numpy(dtype=object)
    ids[several] = [f"{name}-{k + 1}" for name, k in zip(ids[several], number[several], strict=True)]
    result["building_id"] = ids
    result["status"] = status[owner]
    polygon = _middles(result.geometry.to_numpy())
    result["middle_x_m"], result["middle_y_m"] = np.where(np.isfinite(polygon), polygon, middle[owner]).T
    return result


def _middles(shapes: np.ndarray) -> np.ndarray:
    """Middle of each bounding box, (n, 2); NaN for an empty geometry."""
    bounds = shapely.bounds(shapes)
    return (bounds[:, :2] + bounds[:, 2:]) / 2


def clean_footprints(frame: gpd.GeoDataFrame, config: Scenes) -> gpd.GeoDataFrame:
    """Polygons ready for the kernel: exterior counter-clockwise, courtyards clockwise, no needless vertex.

    First :func:`split_parts`, then Douglas-Peucker (``simplify_tolerance_m``), then
    :func:`p2wss.skeleton.clean`. An outline that still touches itself is opened once. Every footprint
    keeps a row; ``status`` is "ok" or the reason, and a rejected one has an empty polygon.
    """
    result = split_parts(frame, config.min_area_m2)
    shapes = result.geometry.to_numpy().copy()
    status = result["status"].to_numpy(dtype=object).copy()
    todo = np.flatnonzero(status == "ok")
    codes = np.full(len(shapes), int(skeleton.Status.EMPTY))
    for attempt in range(2):
        outline = shapes[todo] if attempt == 0 else _opened(shapes[todo])
        simple = (
            shapely.simplify(outline, config.simplify_tolerance_m) if config.simplify_tolerance_m else outline
        )
        cleaned = skeleton.clean(
            polygon_arrays.to_polygons(simple), min_edge_m=config.min_edge_m, min_area_m2=config.min_area_m2
        )
        codes[todo] = cleaned.status
        fine = cleaned.status == skeleton.Status.OK
        shapes[todo[fine]] = polygon_arrays.to_geometries(polygon_arrays.take(cleaned.polygons, fine))
        todo = todo[np.isin(cleaned.status, [skeleton.Status.NOT_SIMPLE, skeleton.Status.COURTYARD_OUTSIDE])]
        if not len(todo):
            break
    tried = status == "ok"
    status[tried] = [skeleton.Status(code).reason if code else "ok" for code in codes[tried]]
    num_edges = shapely.get_num_coordinates(shapes) - shapely.get_num_interior_rings(shapes) - 1
    status[(status == "ok") & (num_edges > config.max_edges)] = skeleton.Status.TOO_MANY_EDGES.reason
    shapes[status != "ok"] = shapely.Polygon()
    result["status"] = status
    return result.set_geometry(gpd.GeoSeries(shapes, crs=frame.crs))


def _opened(shapes: np.ndarray) -> np.ndarray:
    """The largest piece of each polygon, its rings cut apart where they touch, and thin necks cut."""
    largest = np.full(len(shapes), shapely.Polygon(), dtype=object)
    for index, shape in enumerate(shapes):
        rings = shapely.get_rings(shape)
        touching = [first.intersection(second) for first, second in combinations(rings, 2)]
        apart = shape.difference(shapely.union_all(touching).buffer(2 * _OPENING_M, cap_style="square"))
        thin = apart.buffer(-_OPENING_M, join_style="mitre")
        pieces = shapely.get_parts(thin.buffer(_OPENING_M, join_style="mitre"))
        if len(pieces):
            largest[index] = pieces[np.argmax(shapely.area(pieces))]
    return largest
