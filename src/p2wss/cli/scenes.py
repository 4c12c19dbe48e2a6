"""``p2wss scenes``: cut tiles with clean footprints, heights and roof angles."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

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
from p2wss.config import TILE_LISTS, member_places, place_config, section_json
from p2wss.data.tiling import tiles_of_bounds
from p2wss.errors import InputError
from p2wss.provenance import fingerprint
from p2wss.storage import files, integrity


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss scenes`` to the parser."""
    parts = add_group(stages, "scenes", "cut tiles, clean footprints, draw roof angles")
    command = add_command(parts, "index", scenes_index, "count the buildings of each tile")
    command.add_argument(
        "--footprints",
        type=Path,
        nargs="+",
        required=True,
        help="GeoPackages written by p2wss fetch footprints, one per member of the data set, in their order",
    )
    command.add_argument(
        "--out", type=Path, required=True, help="TSV to write, with columns place, tile and num_buildings"
    )
    command = add_command(parts, "cut", scenes_cut, "cut the scene of one tile and its margin")
    add_tile(command)
    add_place(command)
    command.add_argument(
        "--footprints", type=Path, required=True, help="GeoPackage written by p2wss fetch footprints"
    )
    command.add_argument(
        "--dtm", type=Path, required=True, help="GeoTIFF written by p2wss fetch dtm for this tile"
    )
    command.add_argument("--out", type=Path, required=True, help="GeoParquet to write: the scene")
    command.add_argument(
        "--out-dtm", type=Path, required=True, help="GeoTIFF to write: the terrain of the scene"
    )


def scenes_index(arguments: argparse.Namespace) -> None:
    """Write the number of buildings of each tile of the region."""
    from p2wss.footprints.cleaning import read_footprints
    from p2wss.scenes import count_buildings

    config = read_config(arguments)
    places = member_places(config)
    if len(places) != len(arguments.footprints):
        raise InputError(f"--footprints: {len(arguments.footprints)} files for {len(places)} members")
    rows = []
    for place, path in zip(places, arguments.footprints, strict=True):
        region, scenes = place_config(config, place).region, place_config(config, place).scenes
        counts = count_buildings(read_footprints(path), region.tile_size_m, scenes.min_area_m2)
        region_tiles = set(tiles_of_bounds(region.bounds_m, region.tile_size_m))
        rows += [f"{place}\t{tile}\t{number}\n" for tile, number in counts.items() if tile in region_tiles]
    log.info(f"{arguments.out.name}: {len(rows)} tiles with buildings")
    files.write_text(arguments.out, "place\ttile\tnum_buildings\n" + "".join(rows) + integrity.TABLE_TRAILER)


def scenes_cut(arguments: argparse.Namespace) -> None:
    """Write the scene of a tile and its terrain."""
    from p2wss.clouds.reading import same_crs
    from p2wss.data.terrain import read_terrain, write_terrain
    from p2wss.footprints.cleaning import read_whole_blocks
    from p2wss.scenes import NEIGHBOUR_DISTANCE_M, cut_scene, failed_fraction
    from p2wss.storage.schemas.scene import write_scene

    config = read_config(arguments)
    tile, tile_size_m, margin_m = arguments.tile, config.region.tile_size_m, config.scenes.margin_m
    bounds = bounds_of_tile(tile, config, margin_m + NEIGHBOUR_DISTANCE_M)
    frame = read_whole_blocks(arguments.footprints, bounds, config.scenes.snap_m)
    terrain, dtm_crs = read_terrain(arguments.dtm)
    if not same_crs(dtm_crs, frame.crs):
        raise InputError(
            f"{arguments.dtm}: is in {dtm_crs.name}, but {arguments.footprints} is in {frame.crs.name}; "
            "reproject one of them"
        )
    window = terrain.cut(bounds_of_tile(tile, config, margin_m))
    if not window.height_m.size:
        raise InputError(f"{arguments.dtm}: does not cover tile {tile}")
    scene = cut_scene(frame, terrain, tile, tile_size_m, config.scenes)
    scene["tile"] = arguments.place + scene["tile"]
    if not scene["in_tile"].any():
        log.warning(f"{arguments.footprints}: has no building in tile {tile}: an empty scene")
    log_status_counts(arguments.out, scene["status"][scene["in_tile"]])
    failed = failed_fraction(scene)
    if failed > config.scenes.max_failed_fraction:
        raise InputError(
            f"{arguments.footprints}: {failed:.1%} of the footprints of tile {tile} were excluded, more than "
            f"scenes.max_failed_fraction {config.scenes.max_failed_fraction:.1%}; the reasons are listed above"
        )
    metadata = files.provenance(
        tile=tile,
        place=arguments.place,
        tile_size_m=tile_size_m,
        margin_m=margin_m,
        crs=config.region.crs,
        config=section_json(config, "region", "scenes", without=TILE_LISTS),
        code=fingerprint("scenes"),
        num_by_status=dict(sorted(Counter(scene["status"][scene["in_tile"]]).items())),
    )
    write_terrain(arguments.out_dtm, window, config.region.crs, metadata)
    write_scene(arguments.out, scene, metadata)
