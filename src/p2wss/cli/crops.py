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
    add_place,
    add_tile,
    bounds_of_tile,
    log,
    log_status_counts,
    read_config,
)
from p2wss.config import TILE_LISTS, section_json
from p2wss.errors import InputError
from p2wss.provenance import fingerprint
from p2wss.storage import files


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss crops`` to the parser."""
    parts = add_group(stages, "crops", "crop the points of each building")
    command = add_command(parts, "simulated", crops_simulated, "crop a simulated scan, with labels")
    command.add_argument(
        "--buildings", type=Path, required=True, help="Parquet written by p2wss buildings for the same tile"
    )
    command.add_argument("--scan", type=Path, required=True, help="LAZ file written by p2wss scans")
    command.add_argument("--out", type=Path, required=True, help="Parquet to write: a shard of crops")
    command = add_command(parts, "real", crops_real, "crop real LiDAR, without labels")
    add_tile(command)
    add_place(command)
    command.add_argument(
        "--footprints", type=Path, required=True, help="GeoPackage written by p2wss fetch footprints"
    )
    command.add_argument(
        "--clouds",
        type=Path,
        nargs="+",
        required=True,
        help="LAS, LAZ or COPC files of the tile and its margin",
    )
    command.add_argument("--out", type=Path, required=True, help="Parquet to write: a shard of crops")
    command = add_command(parts, "manifest", crops_manifest, "list the shards with their hashes and splits")
    command.add_argument(
        "--simulated",
        type=Path,
        nargs="*",
        default=[],
        help="shards written by p2wss crops simulated",
        metavar="SHARD",
    )
    command.add_argument(
        "--real", type=Path, nargs="*", default=[], help="shards written by p2wss crops real", metavar="SHARD"
    )
    command.add_argument("--out", type=Path, required=True, help="JSON to write: the manifest")


def crops_simulated(arguments: argparse.Namespace) -> None:
    """Write the crops of a simulated scan."""
    from p2wss import crops
    from p2wss.storage.schemas.buildings import BUILDINGS
    from p2wss.storage.schemas.scan import read_scan

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
    columns, num_excluded = crops.crop_simulated(table, scan, config.crops)
    settings = section_json(config, "crops")
    tile = facts.get("place", "") + facts["tile"]
    _write_crops(arguments.out, columns, num_excluded, tile, facts["crs"], settings)


def crops_real(arguments: argparse.Namespace) -> None:
    """Write the crops of real LiDAR."""
    from p2wss import crops
    from p2wss.clouds.las_classes import class_set
    from p2wss.footprints import cleaning as footprints

    config = read_config(arguments)
    tile_size_m = config.region.tile_size_m
    bounds = bounds_of_tile(arguments.tile, config)
    features = footprints.read_whole_blocks(arguments.footprints, bounds, config.scenes.snap_m)
    frame = footprints.clean_footprints(features, config.scenes)
    columns, num_excluded = crops.crop_real(
        frame,
        arguments.clouds,
        arguments.tile,
        tile_size_m,
        config.crops,
        class_set(config.region.classes),
    )
    tile = arguments.place + arguments.tile
    columns["tile"] = [tile] * len(columns["num_points"])
    settings = section_json(config, "region", "scenes", "crops", without=TILE_LISTS)
    _write_crops(arguments.out, columns, num_excluded, tile, config.region.crs, settings)


def _write_crops(
    out: Path, columns: dict[str, Any], num_excluded: Counter[str], tile: str, crs: str, settings: str
) -> None:
    from p2wss.storage.schemas.crops import CROPS

    counts = +num_excluded
    log_status_counts(out, ["ok"] * len(columns["num_points"]) + list(counts.elements()))
    metadata = files.provenance(
        config=settings, code=fingerprint("crops"), tile=tile, crs=crs, num_excluded=dict(counts)
    )
    files.write_table(out, columns, CROPS, metadata)


def crops_manifest(arguments: argparse.Namespace) -> None:
    """Write the manifest of all shards."""
    from p2wss.crops.manifest import list_shards
    from p2wss.storage.schemas.crops import REAL, SIMULATED

    config = read_config(arguments)
    shards = [(path, SIMULATED) for path in arguments.simulated] + [(path, REAL) for path in arguments.real]
    manifest = list_shards(shards, arguments.out.parent, config.dataset)
    for dataset, purposes in manifest.get("selection", {}).get("ranges", {}).items():
        for purpose, chosen in purposes.items():
            if chosen["num_buildings"] < chosen["num_wanted"]:
                log.warning(
                    f"{dataset}, {purpose}: only {chosen['num_buildings']} of {chosen['num_wanted']} buildings; "
                    "add members, tiles or draws to section dataset"
                )
    settings = section_json(config, "dataset", "crops", without=("members",))
    provenance = files.provenance(config=settings, code=fingerprint("crops"))
    files.write_json(arguments.out, manifest | provenance)
    log.info(f"{arguments.out.name}: {manifest['num_rows']} buildings, {manifest['splits']}")
