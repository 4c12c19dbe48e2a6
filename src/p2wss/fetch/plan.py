"""What a region will cost the service, before anything is asked for; and the file of a new region."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import yaml

from p2wss.config import Config, load
from p2wss.data.tiling import grown, tile_bounds, tiles_of_bounds
from p2wss.fetch import open_source
from p2wss.fetch.geoplateforme import GeoplateformeSource

# guesses, only for the plan: buildings of a dense town, a GeoJSON feature, a tile of LiDAR HD (86 to 340 MB)
_BUILDINGS_PER_KM2 = 2500
_FEATURE_BYTES = 2000
_LIDAR_TILE_MB = 205.0


@dataclass(frozen=True)
class Need:
    """One product of a region: how much of it is there, and what the rest costs."""

    product: str
    num_there: int
    num_missing: int
    num_requests: int
    size_mb: float
    about: str  # whence the size


def needs(config: Config, downloads: Path) -> list[Need]:
    """What the service will be asked for; nothing for files on disk. Sends no request."""
    region, fetch = config.region, config.fetch
    if fetch.source == "folder":
        return []
    settings = fetch.geoplateforme
    source = GeoplateformeSource(settings, region.crs, downloads, offline=True)
    windows = source.footprint_windows(grown(region.bounds_m, fetch.margin_m))
    lacking = [
        w for w in windows if not source.has_features(settings.footprints_type, w, settings.footprints_id)
    ]
    counts = [_BUILDINGS_PER_KM2 * (w[2] - w[0]) * (w[3] - w[1]) / 1e6 for w in lacking]
    pages = sum(max(1, math.ceil(count / settings.page_size)) for count in counts)
    found = [
        Need(
            "footprints",
            len(windows) - len(lacking),
            len(lacking),
            pages,
            sum(counts) * _FEATURE_BYTES / 1e6,
            f"guess: {_BUILDINGS_PER_KM2} buildings per km2",
        )
    ]
    maps = [source.map_requests(_bounds(config, tile, fetch.margin_m)) for tile in tiles(config)]
    missing = [[request for request in tile if not source.has_map(request)] for tile in maps]
    cells = sum(request.rows * request.columns for tile in missing for request in tile)
    num_missing = sum(map(bool, missing))
    found.append(
        Need(
            "terrain",
            len(maps) - num_missing,
            num_missing,
            sum(map(len, missing)),
            4 * cells / 1e6,
            f"4 bytes per cell of {settings.dtm_resolution_m} m",
        )
    )
    there = [source.has_lidar(_bounds(config, tile)) for tile in region.lidar_tiles]
    num_missing = there.count(False)
    found.append(
        Need(
            "LiDAR",
            there.count(True),
            num_missing,
            2 * num_missing,
            _LIDAR_TILE_MB * num_missing,
            "guess: 86 to 340 MB a tile",
        )
    )
    return found


def tiles(config: Config) -> list[str]:
    return config.region.tiles or list(tiles_of_bounds(config.region.bounds_m, config.region.tile_size_m))


def table(config: Config, found: Sequence[Need]) -> str:
    """``needs`` for people."""
    region, rate = config.region, config.fetch.geoplateforme.requests_per_s
    x_min, y_min, x_max, y_max = region.bounds_m
    lines = [
        f"region {region.name}: {len(tiles(config))} tiles of {region.tile_size_m:g} m in {x_min:.0f}..{x_max:.0f}, "
        f"{y_min:.0f}..{y_max:.0f} ({region.crs}), LiDAR of {len(region.lidar_tiles)}; vintage {region.vintage}"
    ]
    if not found:
        return "\n".join([*lines, "nothing to download: fetch.source is folder"])
    lines.append(f"{'':12}{'there':>7}{'missing':>9}{'requests':>10}{'MB':>9}{'seconds':>9}")
    lines += [
        f"{need.product:12}{need.num_there:7}{need.num_missing:9}{need.num_requests:10}{need.size_mb:9.0f}"
        f"{need.num_requests / rate:9.0f}  {need.about}"
        for need in found
    ]
    requests = sum(need.num_requests for need in found)
    lines.append(
        f"{'in all':12}{'':16}{requests:10}{sum(need.size_mb for need in found):9.0f}{requests / rate:9.0f}"
        f"  at {rate:g} requests per second, without the time of the transfer"
    )
    return "\n".join(lines)


def download(config: Config, downloads: Path, log: logging.Logger) -> None:
    """Everything of a region into ``downloads``, where the workflow finds it."""
    region, fetch = config.region, config.fetch
    source = open_source(region, fetch, downloads)
    log.info(f"{len(source.footprints(grown(region.bounds_m, fetch.margin_m)))} buildings")
    for number, tile in enumerate(wanted := tiles(config)):
        source.dtm(_bounds(config, tile, fetch.margin_m))
        log.info(f"terrain: {number + 1} of {len(wanted)} tiles")
    for number, tile in enumerate(region.lidar_tiles):
        source.lidar(_bounds(config, tile))
        log.info(f"LiDAR: {number + 1} of {len(region.lidar_tiles)} tiles")


def region_yaml(name: str, bbox: Sequence[float], vintage: str, crs: str, lidar_tiles: Sequence[str]) -> str:
    """The file of a new region on the Geoplateforme. Raises :class:`InputError` for what is no region."""
    size = 1000
    x_min, y_min = (math.floor(value / size) * size for value in bbox[:2])
    x_max, y_max = (math.ceil(value / size) * size for value in bbox[2:])
    region = {
        "name": name,
        "vintage": vintage or f"{datetime.now(UTC).year}",
        "crs": crs,
        "bounds_m": [x_min, y_min, x_max, y_max],
        "tiles": [],
        "lidar_tiles": list(lidar_tiles),
    }
    document = {"region": region, "fetch": {"source": "geoplateforme"}}
    load(document)  # a clear error now
    head = f"# {name}: {(x_max - x_min) * (y_max - y_min) / 1e6:g} km2\n"
    head += f"# snakemake eval_report --configfile config/regions/{name}.yaml\n"
    return head + yaml.safe_dump(document, sort_keys=False, default_flow_style=None)


def _bounds(config: Config, tile: str, margin_m: float = 0.0) -> tuple[float, float, float, float]:
    return tile_bounds(tile, config.region.tile_size_m, margin_m)
