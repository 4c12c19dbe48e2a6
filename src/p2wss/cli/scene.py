"""``p2wss scene``: from a place on the map to a scene for radar and radio simulation."""

import time
from datetime import UTC, datetime
from pathlib import Path

import click

from p2wss.cli.common import check_out, config_option, log_options, threads_option, write_run
from p2wss.cli.parser import PATH, Command, option, setting
from p2wss.config import ALL, IGN, Config, load
from p2wss.storage.messages import InputError

OUTPUTS = ["cityjson", "sionna", "glb", "report"]


@click.command(
    cls=Command,
    defaults={**IGN, "reconstruct": {"outputs": OUTPUTS, "skin": True}},
)
@click.argument("out", type=PATH, metavar="OUT", help="folder to write")
@option(
    "--bbox",
    type=float,
    nargs=4,
    metavar="X_MIN Y_MIN X_MAX Y_MAX",
    help="the place, in metres of region.crs or in degrees (longitude, latitude)",
)
@option(
    "--around",
    type=float,
    nargs=2,
    metavar="LATITUDE LONGITUDE",
    help="or the middle of the place, in degrees, or as X Y in metres of region.crs",
)
@option(
    "--radius",
    "radius_m",
    type=click.FloatRange(min=1),
    default=300,
    metavar="METRES",
    show_default=True,
    help="with --around: half the width of the place",
)
@option("--dry-run", is_flag=True, help="only show the estimate; send no request and write no file")
@setting("fetch.source", default="geoplateforme", more=False)
@setting("region.crs", more=False, help="CRS of the scene, in metres, and of the terrain")
@setting("reconstruct.outputs", "--outputs", "--format", default=OUTPUTS, more=False, help="formats to write")
@setting("reconstruct.detail", more=False, help="fewer triangles, or nearer to the points")
@setting("reconstruct.skin", default=True, more=False, help="merge the buildings of a block into one mesh")
@setting(
    "reconstruct.vegetation", more=False, help="also write trees and clumps of plants, as closed volumes"
)
@threads_option
@log_options
@config_option
@setting("region.classes.preset", "--classes")
@setting(
    "reconstruct.materials", metavar="wall=A,roof=B,ground=C,vegetation=D", help="materials in mesh files"
)
@setting("reconstruct.frequency_ghz", metavar="F")
def scene(
    out: Path,
    bbox: tuple[float, float, float, float] | None,
    around: tuple[float, float] | None,
    radius_m: float,
    dry_run: bool,
    threads: int,
    config: Config,
) -> int:
    """From a place on the map to a scene for radar: fetch its footprints, terrain and LiDAR, and reconstruct it.

    The data come from IGN's services (France), or with --source folder from your files (fetch.folder). They stay in
    OUT/data: a run that was interrupted, or a second one, fetches what is missing. In brackets: the setting of the
    config that an option overrides, and its default.
    """
    if (bbox is None) == (around is None):
        raise click.UsageError("name a place: --bbox or --around", click.get_current_context())
    import p2wss
    from p2wss.data.tiling import grown
    from p2wss.fetching import plan
    from p2wss.fetching.area import bounds_around, bounds_of_bbox, fetch_area

    crs = config.region.crs
    try:
        bounds = bounds_of_bbox(bbox, crs) if bbox else bounds_around(around or (0, 0), radius_m, crs)
    except InputError as error:
        if config.fetch.source == "folder":
            raise
        raise InputError(f"{error}; IGN's services are of France: elsewhere use p2wss reconstruct") from error
    place = {
        "name": "scene",
        "vintage": f"{datetime.now(UTC).year}",
        "bounds_m": bounds,
        "tiles": [],
        "lidar_tiles": [ALL],
    }
    config = load(config.model_dump(mode="json"), {"region": place})
    estimates = plan.estimate_downloads(config, [grown(bounds, config.fetch.margin_m)])
    print(plan.format_estimates(config, estimates), flush=True)
    if dry_run:
        return 0
    check_out(out, config)
    start = time.monotonic()
    data = fetch_area(bounds, crs, out / "data", config)
    with p2wss.reconstruct(
        data.clouds, data.footprints, terrain=data.terrain, config=config, threads=threads
    ) as result:
        return write_run(out, result, start, name="scene")
