"""The buildings of BD TOPO, whatever file or service they come from, with the columns that we use."""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import pyproj
import shapely

from p2wss.data import files
from p2wss.data.clouds import same_crs
from p2wss.errors import InputError

# our column: spelling of WFS, GeoPackage and GeoParquet; spelling of the shapefile delivery
SPELLINGS = {
    "building_id": ("cleabs", "ID"),
    "hauteur_m": ("hauteur", "HAUTEUR"),
    "nature": ("nature", "NATURE"),
    "usage": ("usage_1", "USAGE1"),
    "num_floors": ("nombre_d_etages", "NB_ETAGES"),
    "altitude_minimale_sol_m": ("altitude_minimale_sol", "Z_MIN_SOL"),
    "altitude_minimale_toit_m": ("altitude_minimale_toit", "Z_MIN_TOIT"),
}
REQUIRED = ("building_id", "hauteur_m")
TEXT = ("building_id", "nature", "usage")


def normalise(frame: gpd.GeoDataFrame, crs: str, name: str) -> gpd.GeoDataFrame:
    """``frame`` with the columns of :data:`SPELLINGS` and 2D MultiPolygons, one row each, sorted by id.

    Attributes that are absent or not set are null (text) or NaN (numbers); a building that occurs twice is
    kept once. name: the file or service, for messages.

    Raises :class:`InputError` if a required column is missing or the CRS is another than ``crs``.
    """
    if frame.crs is None:
        raise InputError(f"{name}: has no CRS; set one with ogr2ogr -a_srs {crs}")
    wanted = pyproj.CRS.from_user_input(crs)
    if not same_crs(pyproj.CRS.from_user_input(frame.crs), wanted):
        raise InputError(
            f"{name}: is in {frame.crs.name}, but the region in {wanted.name}; reproject it or set region.crs"
        )
    found = {column.lower(): column for column in frame.columns if column != frame.geometry.name}
    columns: dict[str, pd.Series] = {}
    for ours, spellings in SPELLINGS.items():
        source = next((found[s.lower()] for s in spellings if s.lower() in found), None)
        if source is None and ours in REQUIRED:
            raise InputError(
                f"{name}: no column {' or '.join(spellings)}; it has {', '.join(found.values()) or 'none'}"
            )
        values = frame[source] if source is not None else pd.Series(None, index=frame.index, dtype=object)
        if ours in TEXT:
            columns[ours] = values.astype("string")
        else:
            columns[ours] = pd.to_numeric(values, errors="coerce").astype("float64")
    geometry = shapely.force_2d(frame.geometry.to_numpy())
    single = shapely.get_type_id(geometry) == shapely.GeometryType.POLYGON
    geometry[single] = [shapely.MultiPolygon([polygon]) for polygon in geometry[single]]
    result = gpd.GeoDataFrame(columns, geometry=geometry, crs=crs)
    if result["building_id"].isna().any():
        row = int(np.flatnonzero(result["building_id"].isna())[0])
        raise InputError(f"{name}: building number {row + 1} has no {SPELLINGS['building_id'][0]}")
    return result.drop_duplicates("building_id").sort_values("building_id").reset_index(drop=True)


def write_footprints(path: str | Path, frame: gpd.GeoDataFrame, metadata: dict[str, Any]) -> None:
    """Write a GeoPackage, layer ``footprints``, with ``metadata`` as JSON under the layer's key ``p2wss``."""
    # in memory first: SQLite reports a full disk by whatever statement happens to come next
    file = BytesIO()
    pyogrio.write_dataframe(
        frame, file, layer="footprints", driver="GPKG", layer_metadata={"p2wss": json.dumps(metadata)}
    )
    with files.atomic(path) as temporary:
        temporary.write_bytes(file.getbuffer())
