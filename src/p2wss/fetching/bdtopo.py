"""The buildings of BD TOPO (layer ``batiment``) or of another source, with the columns that we use."""

import json
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import pyproj
import shapely

from p2wss.data.crs import check_crs
from p2wss.footprints.schemas import FootprintSchema, building_ids, schema_of, stated_heights_m
from p2wss.storage import files
from p2wss.storage.features import Features
from p2wss.storage.messages import InputError

# as p2wss.formats.materials knows them
_MATERIALS = {
    "materiaux_des_murs": ("materiaux_des_murs", "MAT_MURS"),
    "materiaux_de_la_toiture": ("materiaux_de_la_toiture", "MAT_TOITS"),
}
# our column: (name in WFS, GeoPackage and GeoParquet; name in IGN's shapefiles)
SPELLINGS = {
    "building_id": ("cleabs", "ID"),
    "hauteur_m": ("hauteur", "HAUTEUR"),
    "nature": ("nature", "NATURE"),
    "usage": ("usage_1", "USAGE1"),
    "num_floors": ("nombre_d_etages", "NB_ETAGES"),
    "altitude_minimale_sol_m": ("altitude_minimale_sol", "Z_MIN_SOL"),
    "altitude_minimale_toit_m": ("altitude_minimale_toit", "Z_MIN_TOIT"),
    **_MATERIALS,
}
REQUIRED = ("building_id", "hauteur_m")
TEXT = ("building_id", "nature", "usage", *_MATERIALS)


def normalise(frame: gpd.GeoDataFrame, crs: str, name: str, schema: str = "bdtopo") -> gpd.GeoDataFrame:
    """``frame`` with the columns of :data:`SPELLINGS` and 2D MultiPolygons, sorted by ``building_id``.

    Missing attributes become null (text) or NaN (numbers). One row is kept of a building that occurs more than once.
    name: the file or service, used in messages. schema: one of :data:`p2wss.footprints.schemas.SCHEMAS`, or "auto";
    schemas other than "bdtopo" give ids, heights, floors and materials, and repeated ids are reported.

    Raises :class:`InputError` if a required column is missing, a building has no id, or the CRS is missing or differs
    from ``crs``.
    """
    if frame.crs is None:
        raise InputError(f"{name}: has no CRS; set one with ogr2ogr -a_srs {crs}")
    check_crs(pyproj.CRS.from_user_input(frame.crs), crs, name)
    if schema != "bdtopo":
        frame = _as_in_bdtopo(frame, schema, name)
    file_columns = {column.lower(): column for column in frame.columns if column != frame.geometry.name}
    columns: dict[str, pd.Series] = {}
    for column, spellings in SPELLINGS.items():
        source = next((file_columns[s.lower()] for s in spellings if s.lower() in file_columns), None)
        if source is None and column in REQUIRED:
            raise InputError(
                f"{name}: has no column {' or '.join(spellings)}; "
                f"its columns are {', '.join(file_columns.values()) or 'none'}"
            )
        values = frame[source] if source is not None else pd.Series(None, index=frame.index, dtype=object)
        as_numbers = pd.to_numeric(values, errors="coerce").astype("float64")
        columns[column] = values.astype("string") if column in TEXT else as_numbers
    geometry = shapely.force_2d(frame.geometry.to_numpy())
    is_polygon = shapely.get_type_id(geometry) == shapely.GeometryType.POLYGON
    geometry[is_polygon] = [shapely.MultiPolygon([polygon]) for polygon in geometry[is_polygon]]
    result = gpd.GeoDataFrame(columns, geometry=geometry, crs=crs)
    if result["building_id"].isna().any():
        row = int(np.flatnonzero(result["building_id"].isna())[0])
        raise InputError(f"{name}: building number {row + 1} has no {SPELLINGS['building_id'][0]} (its id)")
    return result.drop_duplicates("building_id").sort_values("building_id").reset_index(drop=True)


def _as_in_bdtopo(frame: gpd.GeoDataFrame, schema: str, name: str) -> gpd.GeoDataFrame:
    """The ids, heights, floors and materials of footprints of another schema, under BD TOPO's names.

    A feature with the same id and geometry as an earlier one, as at the seams of files, is dropped.
    """
    columns = schema_of(list(frame.columns), schema)
    by_name = {str(column).lower(): column for column in frame.columns}
    id_column = next((by_name[column] for column in columns.ids if column in by_name), None)
    if id_column is not None:
        keys = pd.DataFrame({"id": frame[id_column], "shape": shapely.to_wkb(frame.geometry.to_numpy())})
        frame = frame[~(keys.duplicated().to_numpy() & keys["id"].notna().to_numpy())]
    features, number = Features.of(frame), frame.index.to_numpy()
    result = {
        "cleabs": building_ids(features.columns, number, columns, None, name),
        "hauteur": stated_heights_m(features, replace(columns, floors=()), None, name),
        "nombre_d_etages": stated_heights_m(features, FootprintSchema((), (), columns.floors), None, name),
    }
    materials = [
        by_name[each.lower()] for names in _MATERIALS.values() for each in names if each.lower() in by_name
    ]
    result |= {column: features[column] for column in materials}
    return gpd.GeoDataFrame(result, geometry=frame.geometry.to_numpy(), crs=frame.crs)


def write_footprints(path: str | Path, frame: gpd.GeoDataFrame, metadata: dict[str, Any]) -> None:
    """Write a GeoPackage with a layer ``footprints``; ``metadata`` is stored as JSON under the key ``p2wss``."""
    # built in memory, because SQLite reports a full disk as an error of some later, unrelated statement
    file = BytesIO()
    with files.gdal_options():
        pyogrio.write_dataframe(
            frame, file, layer="footprints", driver="GPKG", layer_metadata={"p2wss": json.dumps(metadata)}
        )
    files.write_bytes(path, file.getbuffer(), seal=True)
