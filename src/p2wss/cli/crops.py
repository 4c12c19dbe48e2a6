"""``p2wss crops``: the points of each building."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import Any

from p2wss.cli.common import (
    Parsers,
    add_command,
    add_group,
    bounds_of_tile,
    log,
    log_status_counts,
    read_config,
)
from p2wss.config import section_json
from p2wss.data import files
from p2wss.errors import InputError
from p2wss.provenance import fingerprint


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss crops`` to the parser."""
    crops = add_group(stages, "crops", "points of each building")
    command = add_command(crops, "simulated", crops_simulated, "from a simulated scan, with labels")
    command.add_argument("--buildings", type=Path, required=True)
    command.add_argument("--scan", type=Path, required=True)
    command.add_argument("--out", type=Path, help="Parquet shard", required=True)
    command = add_command(crops, "real", crops_real, "from real LiDAR, without labels")
    command.add_argument("--tile", help="buildings of this tile", required=True)
    command.add_argument("--footprints", type=Path, required=True)
    command.add_argument("--out", type=Path, help="Parquet shard", required=True)
    command.add_argument("--clouds", type=Path, nargs="+", help="LAS, LAZ or COPC", required=True)
    command = add_command(crops, "manifest", crops_manifest, "list shards, with hashes and splits")
    command.add_argument("--out", type=Path, help="manifest.json", required=True)
    command.add_argument("--simulated", type=Path, nargs="*", default=[], help="shards of simulated scans")
    command.add_argument("--real", type=Path, nargs="*", default=[], help="shards of real LiDAR")


def crops_simulated(arguments: argparse.Namespace) -> None:
    from p2wss import crops
    from p2wss.data.schemas.buildings import BUILDINGS
    from p2wss.data.schemas.scan import read_scan

    config = read_config(arguments)
    facts = files.read_metadata(arguments.buildings)
    table = files.read_table(arguments.buildings, BUILDINGS)
    if facts["margin_m"] < config.crops.guard_m:
        raise InputError(
            f"{arguments.buildings}: its margin of {facts['margin_m']} m is smaller than crops.guard_m "
            f"{config.crops.guard_m}; raise scenes.margin_m"
        )
    scan = read_scan(arguments.scan)
    crops.check_crs(scan[0].crs, facts["crs"], str(arguments.scan))
    columns, left_out = crops.crop_simulated(table, scan, config.crops)
    _write_crops(arguments.out, columns, left_out, facts["tile"], facts["crs"], section_json(config, "crops"))


def crops_real(arguments: argparse.Namespace) -> None:
    from p2wss import crops
    from p2wss.data import footprints

    config = read_config(arguments)
    tile_size_m = config.region.tile_size_m
    bounds = bounds_of_tile(arguments.tile, config)
    frame = footprints.clean_footprints(
        footprints.read_footprints(arguments.footprints, bounds=bounds), config.scenes
    )
    columns, left_out = crops.crop_real(frame, arguments.clouds, arguments.tile, tile_size_m, config.crops)
    made_by = section_json(config, "region", "scenes", "crops")
    _write_crops(arguments.out, columns, left_out, arguments.tile, config.region.crs, made_by)


def _write_crops(
    out: Path, columns: dict[str, Any], left_out: Counter[str], tile: str, crs: str, config: str
) -> None:
    from p2wss.data.schemas.crops import CROPS

    found = {reason: count for reason, count in left_out.items() if count}
    log_status_counts(out, ["ok"] * len(columns["num_points"]) + list(Counter(found).elements()))
    metadata = files.provenance(config=config, code=fingerprint("crops"), tile=tile, crs=crs, left_out=found)
    files.write_table(out, columns, CROPS, metadata)


def crops_manifest(arguments: argparse.Namespace) -> None:
    from p2wss.crops.manifest import list_shards
    from p2wss.data.schemas.crops import REAL, SIMULATED

    config = read_config(arguments)
    shards = [(path, SIMULATED) for path in arguments.simulated] + [(path, REAL) for path in arguments.real]
    listed = list_shards(shards, arguments.out.parent)
    made_by = files.provenance(config=section_json(config, "crops"), code=fingerprint("crops"))
    files.write_json(arguments.out, listed | made_by)
    log.info(f"{arguments.out.name}: {listed['num_rows']} buildings, {listed['splits']}")
