"""GeoPackage tables, written whole or not at all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import geopandas as gpd

from p2wss.data import files


def write(path: Path, frame: gpd.GeoDataFrame, facts: dict[str, Any], layer: str = "buildings") -> None:
    """Write one layer, with ``facts`` as JSON in the metadata of the file, under the key ``p2wss``.

    Raises :class:`InputError` that names ``path`` if it cannot be written.
    """
    with files.atomic(path) as temporary:
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
        except RuntimeError as error:  # pyogrio's errors, a full disk among them, are not OSErrors
            raise OSError(str(error)) from error
