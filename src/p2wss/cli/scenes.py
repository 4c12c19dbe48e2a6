"""``p2wss scenes``: cut tiles with clean footprints, heights and roof angles."""

from collections import Counter
from pathlib import Path

import click

from p2wss.cli.common import (
    bounds_of_tile,
    check_failures,
    config_option,
    log,
    log_status_counts,
    place_option,
    tile_option,
)
from p2wss.cli.parser import Group, file_option
from p2wss.config import OF_CLOUDS, TILE_LISTS, Config, member_places, place_config, section_json
from p2wss.data import reasons
from p2wss.data.tiling import tiles_of_bounds
from p2wss.storage import files, integrity
from p2wss.storage.messages import InputError
from p2wss.storage.provenance import fingerprint


@click.group(cls=Group)
def scenes() -> None:
    """Cut tiles, clean footprints, draw roof angles."""


@scenes.command("index")
@file_option(
    "--footprints",
    "GeoPackages written by p2wss fetch footprints, one per member of the data set, in their order",
    takes_list=True,
)
@file_option("--out", "TSV to write, with columns place, tile and num_buildings")
@config_option
def scenes_index(footprints: tuple[Path, ...], out: Path, config: Config) -> None:
    """Count the buildings of each tile."""
    from p2wss.footprints.cleaning import read_footprints
    from p2wss.scenes.cut import count_buildings

    places = member_places(config)
    if len(places) != len(footprints):
        raise InputError(f"--footprints: {len(footprints)} files for {len(places)} members")
    rows = []
    for place, path in zip(places, footprints, strict=True):
        member = place_config(config, place)
        counts = count_buildings(read_footprints(path), member.region.tile_size_m, member.scenes.min_area_m2)
        region_tiles = set(tiles_of_bounds(member.region.bounds_m, member.region.tile_size_m))
        rows += [f"{place}\t{tile}\t{number}\n" for tile, number in counts.items() if tile in region_tiles]
    log.info(f"{out.name}: {len(rows)} tiles with buildings")
    files.write_text(out, "place\ttile\tnum_buildings\n" + "".join(rows) + integrity.TABLE_TRAILER)


@scenes.command("cut")
@tile_option
@place_option
@file_option("--footprints", "GeoPackage written by p2wss fetch footprints")
@file_option("--dtm", "GeoTIFF written by p2wss fetch dtm for this tile")
@file_option("--out", "GeoParquet to write: the scene")
@file_option("--out-dtm", "GeoTIFF to write: the terrain of the scene")
@config_option
def scenes_cut(
    tile: str, place: str, footprints: Path, dtm: Path, out: Path, out_dtm: Path, config: Config
) -> None:
    """Cut the scene of one tile and its margin."""
    from p2wss.data.crs import check_crs
    from p2wss.data.terrain import read_terrain, write_terrain
    from p2wss.footprints.cleaning import read_whole_blocks
    from p2wss.scenes.cut import NEIGHBOUR_DISTANCE_M, cut_scene
    from p2wss.storage.schemas.scene import write_scene

    tile_size_m, margin_m = config.region.tile_size_m, config.scenes.margin_m
    bounds = bounds_of_tile(tile, config, margin_m + NEIGHBOUR_DISTANCE_M)
    features = read_whole_blocks(footprints, bounds, config.scenes.snap_m)
    terrain, dtm_crs = read_terrain(dtm)
    check_crs(dtm_crs, features.crs, dtm, f"{footprints} is", "reproject one of them")
    window = terrain.cut(bounds_of_tile(tile, config, margin_m))
    if not window.height_m.size:
        raise InputError(f"{dtm}: does not cover tile {tile}")
    scene = cut_scene(features, terrain, tile, tile_size_m, config.scenes)
    scene["tile"] = place + scene["tile"]
    if not scene["in_tile"].any():
        log.warning(f"{footprints}: has no building in tile {tile}: an empty scene")
    status = scene["status"][scene["in_tile"]].to_numpy()
    log_status_counts(out, status)
    # footprints that are too small count neither as buildings nor as failures
    counted = status[status != reasons.TOO_SMALL]
    check_failures(footprints, f"the footprints of tile {tile} were excluded", counted, "scenes", config)
    metadata = files.provenance(
        tile=tile,
        place=place,
        tile_size_m=tile_size_m,
        margin_m=margin_m,
        crs=config.region.crs,
        config=section_json(config, "region", "scenes", without=(*TILE_LISTS, *OF_CLOUDS)),
        code=fingerprint("scenes.cut"),
        num_by_status=dict(sorted(Counter(status).items())),
    )
    write_terrain(out_dtm, window, config.region.crs, metadata)
    write_scene(out, scene, metadata)
