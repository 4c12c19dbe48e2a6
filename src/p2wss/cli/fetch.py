"""``p2wss fetch``: footprints, terrain and LiDAR of a region."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from p2wss.cli.common import (
    Parsers,
    add_command,
    bounds_of_tile,
    config_of,
    log,
)
from p2wss.config import Config, load, section_json
from p2wss.data import files
from p2wss.errors import InputError
from p2wss.provenance import fingerprint


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss fetch`` to the parser."""
    fetch = _fetch_group(stages)
    command = add_command(fetch, "footprints", fetch_footprints, "footprints of the region")
    command.add_argument("--out", type=Path, help="footprints.gpkg", required=True)
    _downloads(command)
    command = add_command(fetch, "dtm", fetch_dtm, "terrain of one tile and its margin")
    command.add_argument("--tile", help="name of the tile, such as 0652_6862", required=True)
    command.add_argument(
        "--out", type=Path, help="GeoTIFF, float32, NaN where there is no data", required=True
    )
    _downloads(command)
    command = add_command(fetch, "lidar", fetch_lidar, "LiDAR of one tile, as delivered")
    command.add_argument("--tile", help="name of the tile, such as 0652_6862", required=True)
    command.add_argument("--out", type=Path, help="LAZ or COPC", required=True)
    _downloads(command)
    command = add_command(
        fetch, "prepare", fetch_prepare, "LiDAR of one tile, cropped and with ground points"
    )
    command.add_argument("--tile", help="name of the tile, such as 0652_6862", required=True)
    command.add_argument(
        "--out", type=Path, help="LAZ; where PDAL was run its pipeline stands beside it", required=True
    )
    command.add_argument(
        "--clouds", type=Path, nargs="+", help="TILE.laz of the tile and of its neighbours", required=True
    )


def fetch_region(arguments: argparse.Namespace) -> None:
    import yaml

    from p2wss.fetch import plan

    if arguments.region is None:
        raise InputError("fetch: give --region NAME, and --bbox for a new one; p2wss fetch --help")
    path = Path("config/regions", f"{arguments.region}.yaml")
    if arguments.bbox is not None:
        text = plan.region_yaml(
            arguments.region, arguments.bbox, arguments.vintage, arguments.crs, arguments.lidar
        )
        config = load(yaml.safe_load(text))
    else:
        text, config = "", load(path)
    downloads = _downloads_of(config, None)
    needs = plan.needs(config, downloads)
    print(plan.table(config, needs))
    if arguments.dry_run:
        return
    if text:
        if path.exists():
            raise InputError(
                f"{path}: is there; take another name, or `p2wss fetch --region NAME` without --bbox"
            )
        files.write_text(path, text)
        print(f"{path} written")
    plan.download(config, downloads, log)
    print(f"everything is in {downloads}; now: snakemake -c2 eval_report --configfile {path}")


def fetch_footprints(arguments: argparse.Namespace) -> None:
    from p2wss.data.tiling import grown
    from p2wss.fetch import normalise, write_footprints

    config = config_of(arguments)
    source = _source(config, arguments)
    found = source.footprints(grown(config.region.bounds_m, config.fetch.margin_m))
    frame = normalise(found, config.region.crs, source.name)
    if not len(frame):
        raise InputError(f"{source.name}: no building in region.bounds_m {config.region.bounds_m}")
    log.info(f"{arguments.out.name}: {len(frame)} buildings from {source.name}")
    write_footprints(arguments.out, frame, _fetched(config))


def fetch_dtm(arguments: argparse.Namespace) -> None:
    from p2wss.data.terrain import write_terrain
    from p2wss.fetch import check_terrain

    config = config_of(arguments)
    source = _source(config, arguments)
    terrain = source.dtm(bounds_of_tile(arguments.tile, config, config.fetch.margin_m))
    share = check_terrain(
        terrain, bounds_of_tile(arguments.tile, config), f"terrain of tile {arguments.tile}"
    )
    log.info(
        f"{arguments.out.name}: {terrain.height_m.shape} heights, {terrain.cell_m} m apart, {share:.1%} known"
    )
    write_terrain(arguments.out, terrain, config.region.crs, _fetched(config))


def fetch_lidar(arguments: argparse.Namespace) -> None:
    from p2wss.fetch import delivered, write_cloud

    config = config_of(arguments)
    source = _source(config, arguments)
    paths = source.lidar(bounds_of_tile(arguments.tile, config))
    around = bounds_of_tile(arguments.tile, config, config.fetch.margin_m)
    crs, bounds = delivered(config.region, config.fetch, around)
    # files of the user's own are copied: they may be changed one day
    num_points = write_cloud(arguments.out, paths, bounds, crs, link=config.fetch.source != "folder")
    log.info(f"{arguments.out.name}: {num_points} points from {', '.join(path.name for path in paths)}")


def fetch_prepare(arguments: argparse.Namespace) -> None:
    from p2wss.fetch import delivered
    from p2wss.fetch.prepare import prepare

    config = config_of(arguments)
    holes = [bounds_of_tile(path.stem, config) for path in arguments.clouds[1:]]
    bounds = bounds_of_tile(arguments.tile, config, config.fetch.margin_m)
    crs, _ = delivered(config.region, config.fetch, bounds)
    facts = prepare(
        arguments.out, arguments.clouds, bounds, holes, config.region.crs, crs, config.fetch.prepare
    )
    log.info(
        f"{arguments.out.name}: {', '.join(f'{name} {value}' for name, value in facts.items() if value)}"
    )


def _source(config: Config, arguments: argparse.Namespace) -> Any:
    from p2wss.fetch import open_source

    offline = config.fetch.offline if arguments.offline is None else bool(arguments.offline)
    fetch = config.fetch.model_copy(update={"offline": offline})
    return open_source(config.region, fetch, _downloads_of(config, arguments.downloads))


def _downloads_of(config: Config, folder: Path | None) -> Path:
    return folder or Path("resources/ign", config.region.vintage, "downloads")


def _fetched(config: Config) -> dict[str, Any]:
    return files.provenance(
        vintage=config.region.vintage,
        crs=config.region.crs,
        config=section_json(config, "region", "fetch"),
        code=fingerprint("fetch"),
    )


def _fetch_group(stages: argparse._SubParsersAction) -> argparse._SubParsersAction:
    """``p2wss fetch PART ..`` for the workflow, ``p2wss fetch --bbox ..`` for people."""
    about = "get footprints, terrain and LiDAR of the region"
    parser = stages.add_parser("fetch", help=about, description=about)
    parser.add_argument(
        "--bbox",
        type=float,
        nargs=4,
        metavar=("X_MIN", "Y_MIN", "X_MAX", "Y_MAX"),
        help="a new region: metres in --crs, rounded outwards to whole tiles",
    )
    parser.add_argument("--region", metavar="NAME", help="its name; of a region there is without --bbox")
    parser.add_argument("--vintage", default="", help="names resources/ign/VINTAGE; default: this year")
    parser.add_argument("--crs", default="EPSG:2154", help="of the region; default: Lambert-93")
    parser.add_argument("--lidar", nargs="*", default=[], metavar="TILE", help="tiles whose LiDAR is wanted")
    parser.add_argument(
        "--dry-run", action="store_true", help="only show what would be downloaded; no request, no file"
    )
    parser.set_defaults(run=fetch_region)
    return parser.add_subparsers(metavar="PART")


def _downloads(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--downloads",
        type=Path,
        help="folder of what was downloaded; default: resources/ign/VINTAGE/downloads",
    )
    command.add_argument(
        "--offline", type=int, choices=(0, 1), help="1: send no request; default: fetch.offline of the config"
    )
