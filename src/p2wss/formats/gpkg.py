"""GeoPackage tables, written completely or not at all."""

import json
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import shapely

from p2wss.storage import files
from p2wss.storage.features import Features, without_none

# SQLite need not wait for the disk at each step, nor be able to undo it, as ``atomic`` puts the complete file in place
_OPTIONS = {"OGR_SQLITE_SYNCHRONOUS": "OFF", "OGR_SQLITE_JOURNAL": "OFF"}
# the table of styles, as QGIS creates it
_STYLES = """
CREATE TABLE layer_styles (
    id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT(256), f_table_schema TEXT(256),
    f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT, styleSLD TEXT,
    useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30), update_time DATETIME
)
"""
_STATE = (
    "CASE WHEN status != 'ok' THEN status "
    "WHEN not_representable OR footprint_flags IS NOT NULL THEN 'flagged' ELSE 'ok' END"
)
# colour and words by state, as STATES of assets/viewer.js
STATES = {
    "ok": ("#7fa88b", "reconstructed"),
    "flagged": ("#d98e04", "to be checked"),
    "flat": ("#7b5ea7", "flat roof instead"),
    "none": ("#9aa4ab", "no mesh"),
}
_CATEGORY = '<category type="string" render="true" value="{}" label="{}" symbol="{}"/>'
_SYMBOL = (
    '<symbol type="fill" name="{}"><layer class="SimpleFill" enabled="1">'
    '<prop k="color" v="{}"/><prop k="outline_color" v="#404040"/><prop k="outline_width" v="0.1"/>'
    "</layer></symbol>"
)
_CATEGORIES = "".join(_CATEGORY.format(state, text, state) for state, (_, text) in STATES.items())
_SYMBOLS = "".join(_SYMBOL.format(state, color) for state, (color, _) in STATES.items())
# the QML style with which QGIS opens the table of a run: what to check, in the colours and words of the run's page.
# Without the version, QGIS takes it for a style of its first version; without the type of layer, for a style of points
STYLE = (
    '<!DOCTYPE qgis><qgis version="3.28.0" styleCategories="Symbology">'
    f'<renderer-v2 type="categorizedSymbol" attr="{_STATE}">'
    f"<categories>{_CATEGORIES}</categories><symbols>{_SYMBOLS}</symbols></renderer-v2>"
    "<layerGeometryType>2</layerGeometryType></qgis>"
)


def write(
    path: Path,
    features: Features,
    facts: dict[str, Any],
    layer: str = "buildings",
    more: Mapping[str, Features] | None = None,
    style: str = "",
) -> None:
    """Write a layer of polygons, and after it the layers ``more``, by their names. The metadata of the file have
    ``facts`` as JSON under the key ``p2wss``. style: QML, with which QGIS opens the first layer.

    Raises :class:`InputError` that names ``path`` if it cannot be written.
    """
    with files.atomic(path, seal=True) as temporary:
        # GDAL creates the file itself, and refuses an empty one
        temporary.unlink()
        try:
            with files.gdal_options(**_OPTIONS):
                metadata = {"p2wss": json.dumps(facts, sort_keys=True)}
                _add_layer(temporary, layer, features, dataset_metadata=metadata)
                for name, rows in (more or {}).items():
                    _add_layer(temporary, name, rows, append=True)
            if style:
                _add_style(temporary, layer, style)
        except (RuntimeError, sqlite3.Error) as error:  # raised for a full disk, for instance
            raise OSError(str(error)) from error


def _add_layer(path: Path, name: str, features: Features, **options: Any) -> None:
    code = features.crs and features.crs.to_epsg()
    columns = [without_none(column) for column in features.columns.values()]
    pyogrio.raw.write(
        path,
        shapely.to_wkb(features.geometry),
        [values for values, _ in columns],
        list(features.columns),
        field_mask=[missing if missing.any() else None for _, missing in columns],
        layer=name,
        driver="GPKG",
        geometry_type="Polygon" if np.any(features.geometry) else "Unknown",
        crs=f"EPSG:{code}" if code else features.crs and features.crs.to_wkt("WKT1_GDAL"),
        **options,
    )


def _add_style(path: Path, layer: str, style: str) -> None:
    """Store a style in the table in which QGIS looks for the style of a layer."""
    with closing(sqlite3.connect(path)) as file, file:
        file.execute("PRAGMA synchronous = OFF")
        file.execute(_STYLES)
        file.execute(
            "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName, "
            "styleQML, styleSLD, useAsDefault, update_time) VALUES ('', '', ?, 'geom', ?, ?, '', 1, ?)",
            (layer, layer, style, files.GPKG_DATE),
        )
        file.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, last_change) "
            "VALUES ('layer_styles', 'attributes', 'layer_styles', ?)",
            (files.GPKG_DATE,),
        )
