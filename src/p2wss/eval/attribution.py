"""The sources of a region's data and the attributions that their licences require, from ``config/sources.csv``."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from p2wss.config import Config, member_places, place_config
from p2wss.errors import InputError

UNKNOWN_LIDAR = "Real LiDAR"
COLUMNS = ("product", "vintage", "service", "layer", "licence", "attribution")


def attribution(config: Config, table: str) -> list[str]:
    """One line per source that the region, or any member of the data set, uses: attribution, edition and licence.

    table: the text of ``config/sources.csv``. A source is identified by its layer: a type or layer of the service,
    or a path of the config or a folder above it. For a source that is not in the table the line says so.
    """
    rows = _rows(table, config.fetch.sources)
    lines = []
    for region in _regions(config):
        for layers in _used(region):
            row = _row_of(layers, rows)
            if row is None:
                lines.append(f"{layers[0]}: add its licence and attribution to {config.fetch.sources}")
                continue
            vintage = region.region.vintage if region.fetch.source == "geoplateforme" else row["vintage"]
            lines.append(f"{row['attribution']} ({vintage}), {row['licence']}")
    return list(dict.fromkeys(lines))


def lidar_name(config: Config, table: str) -> str:
    """What the report calls the clouds: ``eval.lidar_name``, or the products that they are, from the table."""
    rows = _rows(table, config.fetch.sources)
    products = [
        row["product"] if (row := _row_of(_used(region)[2], rows)) else UNKNOWN_LIDAR
        for region in _regions(config)
        if region.region.lidar_tiles
    ]
    return config.eval.lidar_name or ", ".join(dict.fromkeys(products)) or UNKNOWN_LIDAR


def read(path: str | Path) -> str:
    """The text of the table. Raises :class:`InputError` if it cannot be read."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; set fetch.sources") from error


def _regions(config: Config) -> list[Config]:
    return [place_config(config, place) for place in member_places(config)]


def _rows(table: str, name: str) -> dict[str, dict[str, str]]:
    """The rows of the table by layer."""
    reader = csv.DictReader(io.StringIO(table))
    if tuple(reader.fieldnames or ()) != COLUMNS:
        raise InputError(f"{name}: expected the columns {','.join(COLUMNS)}")
    return {row["layer"]: row for row in reader}


def _row_of(layers: list[str], rows: dict[str, dict[str, str]]) -> dict[str, str] | None:
    """The row of the first layer that has one, or else of a folder above it."""
    candidates = [*layers, *(str(folder) for layer in layers for folder in Path(layer).parents)]
    return next((rows[layer] for layer in candidates if layer in rows), None)


def _used(config: Config) -> list[list[str]]:
    """Per product of the region, the layers or paths that it may come from."""
    if config.fetch.source == "folder":
        folder = config.fetch.folder
        used = [[folder.footprints], [folder.dtm], [folder.lidar]]
    else:
        service = config.fetch.geoplateforme
        used = [[service.footprints_type], [service.dtm_layer], list(service.lidar_types)]
    return used if config.region.lidar_tiles else used[:2]
