"""``p2wss fetch``: footprints, terrain and LiDAR of a region."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from p2wss.cli.common import Parsers, add_command, add_tile, bounds_of_tile, log, read_config
from p2wss.config import TILE_LISTS, Config, load, section_json
from p2wss.errors import InputError
from p2wss.provenance import fingerprint
from p2wss.storage import files


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss fetch`` to the parser."""
    parts = _add_fetch_group(stages)
    command = add_command(parts, "footprints", fetch_footprints, "get the footprints of the region")
    command.add_argument("--out", type=Path, help="GeoPackage to write", required=True)
    _add_downloads(command)
    command = add_command(parts, "dtm", fetch_dtm, "get the terrain of one tile and its margin")
    add_tile(command)
    command.add_argument(
        "--out",
        type=Path,
        help="GeoTIFF to write: float32 heights, NaN where there are no data",
        required=True,
    )
    _add_downloads(command)
    command = add_command(parts, "lidar", fetch_lidar, "get the LiDAR of one tile as it is delivered")
    add_tile(command)
    command.add_argument("--out", type=Path, help="LAZ file to write", required=True)
    _add_downloads(command)
    command = add_command(
        parts, "prepare", fetch_prepare, "crop the LiDAR of one tile and classify its ground points"
    )
    add_tile(command)
    command.add_argument(
        "--clouds",
        type=Path,
        nargs="+",
        required=True,
        help="delivered clouds, named TILE.laz: that of the tile first, then those of its neighbours",
    )
    command.add_argument(
        "--out",
        type=Path,
        required=True,
        help="LAZ file to write; if PDAL runs, its pipeline is stored beside it",
    )


def fetch_region(arguments: argparse.Namespace) -> None:
    """Estimate and download all data of a region; create its YAML file if it is new."""
    import yaml

    from p2wss.fetch import plan

    if arguments.region is None:
        raise InputError("fetch: give --region NAME, with --bbox for a new region; see p2wss fetch --help")
    path = Path("config/regions", f"{arguments.region}.yaml")
    if arguments.bbox is not None:
        text = plan.region_yaml(
            arguments.region, arguments.bbox, arguments.vintage, arguments.crs, arguments.lidar
        )
        config = load(yaml.safe_load(text))
    else:
        text, config = "", load(path)
    downloads = _downloads_folder(config, None)
    print(plan.format_estimates(config, plan.estimate_downloads(config)))
    if arguments.dry_run:
        return
    if text:
        if path.exists():
            raise InputError(
                f"{path}: already exists; choose another name, or omit --bbox to download this region"
            )
        files.write_text(path, text)
        print(f"wrote {path}")
    plan.download(config, downloads, log)
    print(f"all data are in {downloads}; now run: snakemake -c2 eval_report --configfile {path}")


def fetch_footprints(arguments: argparse.Namespace) -> None:
    """Write the footprints of the region as a GeoPackage."""
    from p2wss.data.tiling import grown
    from p2wss.fetch.bdtopo import normalise, write_footprints

    config = read_config(arguments)
    source = _open_source(config, arguments)
    features = source.footprints(grown(config.region.bounds_m, config.fetch.margin_m))
    is_folder = config.fetch.source == "folder"
    schema = config.fetch.folder.footprints_schema if is_folder else "bdtopo"
    frame = normalise(features, config.region.crs, source.name, schema)
    if not len(frame):
        raise InputError(f"{source.name}: no building in region.bounds_m {config.region.bounds_m}")
    log.info(f"{arguments.out.name}: {len(frame)} buildings from {source.name}")
    write_footprints(arguments.out, frame, _provenance(config))


def fetch_dtm(arguments: argparse.Namespace) -> None:
    """Write the terrain of a tile and its margin as a GeoTIFF."""
    from p2wss.data.terrain import write_terrain
    from p2wss.fetch.source import known_height_share

    config = read_config(arguments)
    source = _open_source(config, arguments)
    terrain = source.dtm(bounds_of_tile(arguments.tile, config, config.fetch.margin_m))
    share = known_height_share(
        terrain, bounds_of_tile(arguments.tile, config), f"terrain of tile {arguments.tile}"
    )
    log.info(
        f"{arguments.out.name}: {terrain.height_m.shape[1]} x {terrain.height_m.shape[0]} cells of "
        f"{terrain.cell_m} m; {share:.1%} of the tile has a height"
    )
    write_terrain(arguments.out, terrain, config.region.crs, _provenance(config))


def fetch_lidar(arguments: argparse.Namespace) -> None:
    """Write the LiDAR of a tile and its margin as one LAZ file, as delivered."""
    from p2wss.fetch.cloud import write_cloud
    from p2wss.fetch.source import delivery_window

    config = read_config(arguments)
    source = _open_source(config, arguments)
    paths = source.lidar(bounds_of_tile(arguments.tile, config))
    bounds_with_margin = bounds_of_tile(arguments.tile, config, config.fetch.margin_m)
    crs, bounds = delivery_window(config.region, config.fetch, bounds_with_margin)
    # the user's files are copied, not linked, because the user may change them later
    num_points = write_cloud(arguments.out, paths, bounds, crs, link=config.fetch.source != "folder")
    log.info(f"{arguments.out.name}: {num_points} points from {', '.join(path.name for path in paths)}")


def fetch_prepare(arguments: argparse.Namespace) -> None:
    """Write the LiDAR of a tile, cropped and with ground points."""
    from p2wss.clouds.las_classes import class_set
    from p2wss.fetch.pdal import Window
    from p2wss.fetch.prepare import prepare
    from p2wss.fetch.source import delivery_window

    config = read_config(arguments)
    holes = [bounds_of_tile(path.stem, config) for path in arguments.clouds[1:]]
    bounds = bounds_of_tile(arguments.tile, config, config.fetch.margin_m)
    crs, _ = delivery_window(config.region, config.fetch, bounds)
    window = Window(bounds, holes, config.region.crs, crs)
    ground = class_set(config.region.classes).ground
    facts = prepare(arguments.out, arguments.clouds, window, config.fetch.prepare, ground)
    log.info(
        f"{arguments.out.name}: {', '.join(f'{name} {value}' for name, value in facts.items() if value)}"
    )


def _open_source(config: Config, arguments: argparse.Namespace) -> Any:
    from p2wss.fetch.source import open_source

    return open_source(config.region, config.fetch, _downloads_folder(config, arguments.downloads))


def _downloads_folder(config: Config, folder: Path | None) -> Path:
    return folder or Path("resources/ign", config.region.vintage, "downloads")


def _provenance(config: Config) -> dict[str, Any]:
    return files.provenance(
        vintage=config.region.vintage,
        crs=config.region.crs,
        config=section_json(config, "region", "fetch", without=TILE_LISTS),
        code=fingerprint("fetch"),
    )


def _add_fetch_group(stages: Parsers) -> Parsers:
    """Add ``p2wss fetch --region ..``, for users, and the group ``p2wss fetch PART ..``, for the workflow."""
    parser = stages.add_parser(
        "fetch",
        help="get footprints, terrain and LiDAR of a region",
        description="Get footprints, terrain and LiDAR of a region from IGN's services or from files on disk. "
        "With --region: estimate and download everything. The parts are the individual steps of the workflow.",
    )
    parser.add_argument(
        "--bbox",
        type=float,
        nargs=4,
        metavar=("X_MIN", "Y_MIN", "X_MAX", "Y_MAX"),
        help="create a new region with these bounds, in metres in --crs; rounded outwards to whole tiles",
    )
    parser.add_argument(
        "--region",
        metavar="NAME",
        help="name of the region: a new one with --bbox, otherwise config/regions/NAME.yaml",
    )
    parser.add_argument(
        "--vintage",
        default="",
        help="edition of the data of a new region, which names its folder (default: this year)",
    )
    parser.add_argument(
        "--crs", default="EPSG:2154", help="projected CRS of a new region (default: EPSG:2154, Lambert-93)"
    )
    parser.add_argument(
        "--lidar", nargs="*", default=[], metavar="TILE", help="tiles of a new region whose LiDAR to download"
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="only show the estimate; send no request and write no file"
    )
    parser.set_defaults(run=fetch_region)
    return parser.add_subparsers(metavar="PART", title="parts")


def _add_downloads(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--downloads",
        type=Path,
        help="folder in which downloads are stored (default: resources/ign/VINTAGE/downloads)",
    )
