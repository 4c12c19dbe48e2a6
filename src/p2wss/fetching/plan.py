"""Estimate the downloads of a region before the first request, download them, and create a region's file."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import yaml

from p2wss.config import ALL, Config, load
from p2wss.data.tiling import Bounds, bounds_text, grown, tile_bounds, tiles_of_bounds
from p2wss.fetching.geoplateforme import GeoplateformeSource
from p2wss.fetching.source import open_source

# rough values, used only for the estimate: buildings of a dense town, bytes of a building's GeoJSON feature,
# and a tile of LiDAR HD (86 to 340 MB)
_BUILDINGS_PER_KM2 = 2500
_FEATURE_BYTES = 2000
_LIDAR_TILE_MB = 205.0


@dataclass(frozen=True)
class Estimate:
    """Downloads of one product. num_files: number of stored files. basis: how ``size_mb`` was estimated."""

    product: str
    num_files: int
    num_requests: int
    size_mb: float
    basis: str


def estimate_downloads(config: Config, terrain: Sequence[Bounds] | None = None) -> list[Estimate]:
    """One estimate per product of the downloads into an empty folder; an empty list for files on disk.

    terrain: windows of the terrain; by default the tiles with their margins.
    """
    region, fetch = config.region, config.fetch
    if fetch.source == "folder":
        return []
    settings = fetch.geoplateforme
    source = GeoplateformeSource(settings, region.crs, Path())
    windows = source.footprint_windows(grown(region.bounds_m, fetch.margin_m))
    counts = [_BUILDINGS_PER_KM2 * (w[2] - w[0]) * (w[3] - w[1]) / 1e6 for w in windows]
    pages = sum(max(1, math.ceil(count / settings.page_size)) for count in counts)
    if terrain is None:
        terrain = [tile_bounds(tile, region.tile_size_m, fetch.margin_m) for tile in tiles(config)]
    maps = [request for window in terrain for request in source.map_requests(window)]
    terrain_mb = sum(4 * m.rows * m.columns for m in maps) / 1e6
    num_clouds = len(lidar_tiles(config))
    return [
        Estimate(
            "footprints",
            len(windows),
            pages,
            sum(counts) * _FEATURE_BYTES / 1e6,
            f"assuming {_BUILDINGS_PER_KM2} buildings per km2",
        ),
        Estimate(
            "terrain", len(maps), len(maps), terrain_mb, f"4 bytes per cell of {settings.dtm_resolution_m} m"
        ),
        Estimate(
            "LiDAR", num_clouds, 2 * num_clouds, _LIDAR_TILE_MB * num_clouds, "assuming 86 to 340 MB per tile"
        ),
    ]


def tiles(config: Config) -> list[str]:
    """The names of the region's tiles: ``region.tiles``, or every tile of its bounds."""
    if config.region.tiles not in ([], [ALL]):
        return config.region.tiles
    return list(tiles_of_bounds(config.region.bounds_m, config.region.tile_size_m))


def lidar_tiles(config: Config) -> list[str]:
    """The names of the tiles whose LiDAR is wanted."""
    return tiles(config) if config.region.lidar_tiles == [ALL] else config.region.lidar_tiles


def format_estimates(config: Config, estimates: Sequence[Estimate]) -> str:
    """The region and its estimates as a table for the terminal."""
    region, rate = config.region, config.fetch.geoplateforme.requests_per_s
    lines = [
        f"region {region.name}: {len(tiles(config))} tiles of {region.tile_size_m:g} m in "
        f"{bounds_text(region.bounds_m)} ({region.crs}), LiDAR for {len(lidar_tiles(config))}; vintage {region.vintage}"
    ]
    if not estimates:
        return "\n".join([*lines, "nothing to download: fetch.source is folder"])
    lines.append(f"{'':12}{'files':>7}{'requests':>10}{'MB':>9}{'seconds':>9}")
    lines += [
        f"{e.product:12}{e.num_files:7}{e.num_requests:10}{e.size_mb:9.0f}"
        f"{e.num_requests / rate:9.0f}  {e.basis}"
        for e in estimates
    ]
    num_requests = sum(e.num_requests for e in estimates)
    lines.append(
        f"{'total':12}{'':7}{num_requests:10}{sum(e.size_mb for e in estimates):9.0f}{num_requests / rate:9.0f}"
        f"  at {rate:g} requests per second, transfer time not included"
    )
    return "\n".join(lines)


def download(config: Config, downloads: Path, log: logging.Logger) -> None:
    """Download everything of a region into ``downloads``, where the workflow looks for it."""
    region, fetch = config.region, config.fetch
    source = open_source(region, fetch, downloads)
    log.info(f"{len(source.footprints(grown(region.bounds_m, fetch.margin_m)))} buildings")
    for number, tile in enumerate(names := tiles(config)):
        source.dtm(tile_bounds(tile, region.tile_size_m, fetch.margin_m))
        log.info(f"terrain: {number + 1} of {len(names)} tiles")
    for number, tile in enumerate(names := lidar_tiles(config)):
        source.lidar(tile_bounds(tile, region.tile_size_m))
        log.info(f"LiDAR: {number + 1} of {len(names)} tiles")


def region_yaml(name: str, bbox: Sequence[float], vintage: str, crs: str, lidar_tiles: Sequence[str]) -> str:
    """The YAML file of a new region on the Geoplateforme; ``bbox`` is rounded outwards to whole kilometres.

    Raises :class:`InputError` if the name or the bounds are not valid.
    """
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
    load(document)  # report invalid values now
    head = f"# {name}: {(x_max - x_min) * (y_max - y_min) / 1e6:g} km2\n"
    head += f"# snakemake eval_report --configfile config/regions/{name}.yaml\n"
    return head + yaml.safe_dump(document, sort_keys=False, default_flow_style=None)
