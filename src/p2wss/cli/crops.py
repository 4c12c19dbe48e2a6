"""``p2wss crops``: the points of each building."""

from collections import Counter
from itertools import compress
from pathlib import Path
from typing import Any

import click

from p2wss.cli.common import bounds_of_tile, config_option, log, log_status_counts, place_option, tile_option
from p2wss.cli.parser import Group, file_option, option
from p2wss.config import TILE_LISTS, Config, Reconstruct, section_json
from p2wss.storage import files
from p2wss.storage.messages import InputError
from p2wss.storage.provenance import fingerprint


@click.group(cls=Group)
def crops() -> None:
    """Crop the points of each building."""


@crops.command("simulated")
@file_option("--buildings", "Parquet written by p2wss buildings for the same tile")
@file_option("--scan", "LAZ file written by p2wss scans")
@file_option("--out", "Parquet to write: a shard of crops")
@config_option
def crops_simulated(buildings: Path, scan: Path, out: Path, config: Config) -> None:
    """Crop a simulated scan, with labels."""
    from p2wss.crops.rows import crop_simulated, scan_of
    from p2wss.storage.schemas.buildings import BUILDINGS

    facts = files.read_metadata(buildings)
    table = files.read_table(buildings, BUILDINGS)
    if facts["margin_m"] < config.crops.guard_m:
        raise InputError(
            f"{buildings}: its margin of {facts['margin_m']} m is smaller than crops.guard_m "
            f"{config.crops.guard_m}; raise scenes.margin_m"
        )
    columns, num_excluded = crop_simulated(table, scan_of(scan, facts["crs"]), config.crops)
    settings = section_json(config, "crops")
    tile = facts.get("place", "") + facts["tile"]
    _write_crops(out, columns, num_excluded, tile, facts["crs"], settings)


@crops.command("real")
@tile_option
@place_option
@file_option("--footprints", "GeoPackage written by p2wss fetch footprints")
@file_option("--clouds", "LAS, LAZ or COPC files of the tile and its margin", takes_list=True)
@file_option("--out", "Parquet to write: a shard of crops")
@config_option
def crops_real(
    tile: str, place: str, footprints: Path, clouds: tuple[Path, ...], out: Path, config: Config
) -> None:
    """Crop real LiDAR, without labels."""
    from p2wss.crops.rows import crop_real
    from p2wss.data.las_classes import class_set
    from p2wss.footprints import cleaning

    tile_size_m = config.region.tile_size_m
    bounds = bounds_of_tile(tile, config)
    features = cleaning.read_whole_blocks(footprints, bounds, config.scenes.snap_m)
    features = cleaning.clean_footprints(features, config.scenes)
    classes = class_set(**config.region.classes.model_dump())
    columns, num_excluded = crop_real(features, list(clouds), tile, tile_size_m, config.crops, classes)
    tile = place + tile
    columns["tile"] = [tile] * len(columns["num_points"])
    settings = section_json(config, "region", "scenes", "crops", without=TILE_LISTS)
    _write_crops(out, columns, num_excluded, tile, config.region.crs, settings)


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


@crops.command("labels")
@file_option("--crops", "shard written by p2wss crops real")
@option("--split", type=click.Choice(["train", "val", "test"]), required=True, help="of its buildings")
@file_option("--out", "Parquet to write: the shard with labels, for --simulated of p2wss crops manifest")
def crops_labels(crops: Path, split: str, out: Path) -> None:
    """Label crops that have no labels by the parametric roofs that are fitted to their points, to train on them.

    A crop for which no roof is fitted, for instance one with too few points, is left out.
    """
    from p2wss.eval.cases import from_crops
    from p2wss.reconstruction.product import reconstruct_buildings
    from p2wss.storage.schemas.crops import CROPS, REAL

    table = files.read_table(crops, CROPS)
    # a label has an angle for each edge of the footprint as it is
    config = Reconstruct(roofs="parametric", max_wall_shift_m=0)
    roofs = reconstruct_buildings([case.building for case in from_crops(table, REAL)], None, config)
    status = [roof.status for roof in roofs]
    log_status_counts(out, status)
    is_fitted = [each == "ok" for each in status]
    table, roofs = table.filter(is_fitted), list(compress(roofs, is_fitted))
    columns = {name: table[name].combine_chunks() for name in table.column_names} | {
        "split": [split] * len(table),
        "eave_height_m": [roof.eave_height_m for roof in roofs],
        "label_terrain_z_m": table["ground_z_m"].combine_chunks(),
        "angle_deg": [roof.angle_deg for roof in roofs],
    }
    metadata = files.read_metadata(crops)
    num_excluded = Counter(metadata.get("num_excluded", {})) + Counter(
        each for each in status if each != "ok"
    )
    metadata |= {"code": fingerprint("crops", "fit"), "num_excluded": dict(num_excluded)}
    files.write_table(out, columns, CROPS, metadata)


@crops.command("manifest")
@file_option("--simulated", "shards written by p2wss crops simulated", required=False, takes_list=True)
@file_option("--real", "shards written by p2wss crops real", required=False, takes_list=True)
@file_option("--out", "JSON to write: the manifest")
@config_option
def crops_manifest(simulated: tuple[Path, ...], real: tuple[Path, ...], out: Path, config: Config) -> None:
    """List the shards with their hashes and splits."""
    from p2wss.crops.manifest import list_shards
    from p2wss.storage.schemas.crops import REAL, SIMULATED

    shards = [(path, SIMULATED) for path in simulated] + [(path, REAL) for path in real]
    manifest = list_shards(shards, out.parent, config.dataset)
    for dataset, purposes in manifest.get("selection", {}).get("ranges", {}).items():
        for purpose, chosen in purposes.items():
            if chosen["num_buildings"] < chosen["num_wanted"]:
                log.warning(
                    f"{dataset}, {purpose}: only {chosen['num_buildings']} of {chosen['num_wanted']} buildings; "
                    "add members, tiles or draws to section dataset"
                )
    settings = section_json(config, "dataset", "crops", without=("members",))
    provenance = files.provenance(config=settings, code=fingerprint("crops"))
    files.write_json(out, manifest | provenance)
    log.info(f"{out.name}: {manifest['num_rows']} buildings, {manifest['splits']}")
