"""``p2wss fetch``: footprints, terrain and LiDAR of a region."""

from pathlib import Path
from typing import Any

import click

from p2wss.cli.common import bounds_of_tile, config_option, log, tile_option
from p2wss.cli.parser import Group, Names, file_option, option
from p2wss.config import ALL, OF_CLOUDS, TILE_LISTS, Config, load, section_json
from p2wss.storage import files
from p2wss.storage.messages import InputError
from p2wss.storage.provenance import fingerprint

_downloads_option = file_option(
    "--downloads",
    "folder in which downloads are stored (default: resources/ign/VINTAGE/downloads)",
    required=False,
)


@click.group(cls=Group, invoke_without_command=True, no_args_is_help=True)
@option(
    "--region",
    metavar="NAME",
    help="name of the region: a new one with --bbox, otherwise config/regions/NAME.yaml",
)
@option(
    "--bbox",
    type=float,
    nargs=4,
    metavar="X_MIN Y_MIN X_MAX Y_MAX",
    help="create a new region with these bounds, in metres in --crs or in degrees (longitude, latitude); rounded "
    "outwards to whole tiles",
)
@option(
    "--vintage",
    default="",
    help="edition of the data of a new region, which names its folder (default: this year)",
)
@option("--crs", default="EPSG:2154", help="projected CRS of a new region (default: EPSG:2154, Lambert-93)")
@option("--lidar", type=Names(), default=[], help="tiles of a new region whose LiDAR to download")
@option("--dry-run", is_flag=True, help="only show the estimate; send no request and write no file")
@click.pass_context
def fetch(
    context: click.Context,
    region: str | None,
    bbox: tuple[float, float, float, float] | None,
    vintage: str,
    crs: str,
    lidar: list[str],
    dry_run: bool,
) -> None:
    """Get footprints, terrain and LiDAR of a region from IGN's services or from files on disk.

    With --region: estimate and download everything, and create the YAML file of a region that is new. The commands
    are the individual steps of the workflow.
    """
    if context.invoked_subcommand:
        return
    import yaml

    from p2wss.fetching import plan
    from p2wss.fetching.area import bounds_of_bbox

    if region is None:
        raise InputError("fetch: give --region NAME, with --bbox for a new region; see p2wss fetch --help")
    path = Path("config/regions", f"{region}.yaml")
    if bbox is not None:
        text = plan.region_yaml(region, bounds_of_bbox(bbox, crs), vintage, crs, lidar)
        config = load(yaml.safe_load(text))
    else:
        text, config = "", load(path)
    if strangers := sorted(set(lidar) - {ALL, *plan.tiles(config)}):
        raise InputError(f"--lidar: not a tile of the region: {', '.join(strangers)}")
    downloads = _downloads_folder(config)
    print(plan.format_estimates(config, plan.estimate_downloads(config)))
    if dry_run:
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


@fetch.command("footprints")
@file_option("--out", "GeoPackage to write")
@_downloads_option
@config_option
def fetch_footprints(out: Path, downloads: Path | None, config: Config) -> None:
    """Get the footprints of the region."""
    from p2wss.data.tiling import grown
    from p2wss.fetching.bdtopo import write_footprints
    from p2wss.fetching.source import read_buildings

    source = _open_source(config, downloads)
    bounds = grown(config.region.bounds_m, config.fetch.margin_m)
    place = f"region.bounds_m {config.region.bounds_m}"
    frame = read_buildings(source, config.region, config.fetch, bounds, place)
    log.info(f"{out.name}: {len(frame)} buildings from {source.name}")
    write_footprints(out, frame, _provenance(config))


@fetch.command("dtm")
@tile_option
@file_option("--out", "GeoTIFF to write: float32 heights, NaN where there are no data")
@_downloads_option
@config_option
def fetch_dtm(tile: str, out: Path, downloads: Path | None, config: Config) -> None:
    """Get the terrain of one tile and its margin."""
    from p2wss.data.terrain import write_terrain
    from p2wss.fetching.source import known_height_share

    source = _open_source(config, downloads)
    terrain = source.dtm(bounds_of_tile(tile, config, config.fetch.margin_m))
    share = known_height_share(terrain, bounds_of_tile(tile, config), f"terrain of tile {tile}")
    log.info(
        f"{out.name}: {terrain.height_m.shape[1]} x {terrain.height_m.shape[0]} cells of "
        f"{terrain.cell_m} m; {share:.1%} of the tile has a height"
    )
    write_terrain(out, terrain, config.region.crs, _provenance(config))


@fetch.command("lidar")
@tile_option
@file_option("--out", "LAZ file to write")
@_downloads_option
@config_option
def fetch_lidar(tile: str, out: Path, downloads: Path | None, config: Config) -> None:
    """Get the LiDAR of one tile and its margin as it is delivered."""
    from p2wss.fetching.cloud import write_cloud
    from p2wss.fetching.source import delivery_window

    source = _open_source(config, downloads)
    paths = source.lidar(bounds_of_tile(tile, config))
    bounds_with_margin = bounds_of_tile(tile, config, config.fetch.margin_m)
    crs, bounds = delivery_window(config.region, config.fetch, bounds_with_margin)
    # the user's files are copied, not linked, because the user may change them later
    num_points = write_cloud(out, paths, bounds, crs, link=config.fetch.source != "folder")
    log.info(f"{out.name}: {num_points} points from {', '.join(path.name for path in paths)}")


@fetch.command("prepare")
@tile_option
@file_option(
    "--clouds",
    "delivered clouds, named TILE.laz: that of the tile first, then those of its neighbours",
    takes_list=True,
)
@file_option("--out", "LAZ file to write; if PDAL runs, its pipeline is stored beside it")
@config_option
def fetch_prepare(tile: str, clouds: tuple[Path, ...], out: Path, config: Config) -> None:
    """Crop the LiDAR of one tile and classify its ground points."""
    from p2wss.data.las_classes import class_set
    from p2wss.fetching.prepare import Window, prepare
    from p2wss.fetching.source import delivery_window

    holes = [bounds_of_tile(path.stem, config) for path in clouds[1:]]
    bounds = bounds_of_tile(tile, config, config.fetch.margin_m)
    crs, _ = delivery_window(config.region, config.fetch, bounds)
    window = Window(bounds, holes, config.region.crs, crs)
    ground = class_set(**config.region.classes.model_dump()).ground
    facts = prepare(out, clouds, window, config.fetch.prepare, ground)
    log.info(f"{out.name}: {', '.join(f'{name} {value}' for name, value in facts.items() if value)}")


def _open_source(config: Config, downloads: Path | None) -> Any:
    from p2wss.fetching.source import open_source

    return open_source(config.region, config.fetch, downloads or _downloads_folder(config))


def _downloads_folder(config: Config) -> Path:
    return Path("resources/ign", config.region.vintage, "downloads")


def _provenance(config: Config) -> dict[str, Any]:
    return files.provenance(
        vintage=config.region.vintage,
        crs=config.region.crs,
        # without what only clouds depend on, which state no provenance
        config=section_json(config, "region", "fetch", without=(*TILE_LISTS, *OF_CLOUDS, "prepare")),
        code=fingerprint("fetching"),
    )
