"""The sources of a region's data and the attributions that their licences require, from ``config/sources.csv``."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from p2wss.config import Config
from p2wss.errors import InputError

COLUMNS = ("product", "vintage", "service", "layer", "licence", "attribution")


def attribution(config: Config, table: str) -> list[str]:
    """One line per source that the region uses: attribution, edition and licence.

    table: the text of ``config/sources.csv``. A source is identified by its layer: a type or layer of the service,
    or a path of the config. For a source that is not in the table the line says so.
    """
    rows = {row["layer"]: row for row in _rows(table, config.fetch.sources)}
    lines = []
    for layers in _used(config):
        row = next((rows[layer] for layer in layers if layer in rows), None)
        if row is None:
            lines.append(f"{layers[0]}: add its licence and attribution to {config.fetch.sources}")
            continue
        vintage = config.region.vintage if config.fetch.source == "geoplateforme" else row["vintage"]
        lines.append(f"{row['attribution']} ({vintage}), {row['licence']}")
    return list(dict.fromkeys(lines))


def read(path: str | Path) -> str:
    """The text of the table. Raises :class:`InputError` if it cannot be read."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; set fetch.sources") from error


def _rows(table: str, name: str) -> list[dict[str, str]]:
    reader = csv.DictReader(io.StringIO(table))
    if tuple(reader.fieldnames or ()) != COLUMNS:
        raise InputError(f"{name}: expected the columns {','.join(COLUMNS)}")
    return list(reader)


def _used(config: Config) -> list[list[str]]:
    """Per product of the region, the layers or paths that it may come from."""
    if config.fetch.source == "folder":
        folder = config.fetch.folder
        used = [[folder.footprints], [folder.dtm], [folder.lidar]]
    else:
        service = config.fetch.geoplateforme
        used = [[service.footprints_type], [service.dtm_layer], list(service.lidar_types)]
    return used if config.region.lidar_tiles else used[:2]
