"""GeoPackage tables, written completely or not at all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import geopandas as gpd

from p2wss.storage import files


def write(
    path: Path,
    frame: gpd.GeoDataFrame,
    facts: dict[str, Any],
    layer: str = "buildings",
    more: Mapping[str, gpd.GeoDataFrame] | None = None,
) -> None:
    """Write a layer, with ``facts`` as JSON in the metadata of the file, under the key ``p2wss``, and after it those
    of ``more`` by their names.

    Raises :class:`InputError` that names ``path`` if it cannot be written.
    """
    with files.atomic(path, seal=True) as temporary:
        # GDAL creates the file itself, and refuses an empty one
        temporary.unlink()
        try:
            frame.to_file(
                temporary,
                driver="GPKG",
                layer=layer,
                engine="pyogrio",
                dataset_metadata={"p2wss": json.dumps(facts, sort_keys=True)},
            )
            for name, rows in (more or {}).items():
                rows.to_file(temporary, driver="GPKG", layer=name, engine="pyogrio", mode="a")
        except RuntimeError as error:  # pyogrio's errors, a full disk among them, are not OSErrors
            raise OSError(str(error)) from error
