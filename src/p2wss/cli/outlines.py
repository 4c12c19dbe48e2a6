"""``p2wss outlines``: outlines of buildings from LiDAR alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from p2wss.cli import argument_checks
from p2wss.cli.common import classes_option, config_option, crs_option, log
from p2wss.cli.parser import PATH, Command
from p2wss.config import Config
from p2wss.errors import InputError
from p2wss.storage import files

if TYPE_CHECKING:
    import geopandas as gpd

    from p2wss.clouds.reading import Cloud


@click.command(cls=Command)
@click.argument(
    "clouds",
    type=PATH,
    nargs=-1,
    required=True,
    metavar="CLOUD ..",
    help="LAS, LAZ or COPC files, or folders of them",
)
@click.argument("out", type=PATH, metavar="OUT", help="GeoPackage to write (.gpkg)")
@crs_option
@classes_option
@config_option
def outlines(clouds: tuple[Path, ...], out: Path, crs: str | None, config: Config) -> None:
    """Derive building outlines from LiDAR, without footprints."""
    if out.suffix.lower() != ".gpkg":
        raise InputError(f"{out}: outlines are written as GeoPackage; name a file that ends in .gpkg")
    headers, metric = argument_checks.check_clouds(clouds, crs)
    inputs = argument_checks.Inputs(headers, None, metric, None)
    _, frame = read_outlines(config, inputs)
    with files.atomic(out) as path:
        frame.to_file(path, driver="GPKG", layer="outlines")
    log.info("%s: %d outlines, %.0f m2", out, len(frame), frame.area.sum())


def read_outlines(config: Config, inputs: argument_checks.Inputs) -> tuple[Cloud, gpd.GeoDataFrame]:
    """The whole cloud, and the outlines in it as footprints."""
    from p2wss.clouds import reading as clouds
    from p2wss.clouds.las_classes import class_set
    from p2wss.reconstruct import unclassified
    from p2wss.reconstruct.outlines import outline_frame

    settings = config.reconstruct
    paths = [header.path for header in inputs.clouds]
    cloud = clouds.read_clouds(paths, None, class_set(config.region.classes))
    cloud, warnings = unclassified.with_classes(inputs.metric.cloud(cloud))
    for warning in warnings:
        log.warning("warning: %s", warning)
    return cloud, outline_frame(cloud, settings.outlines, inputs.crs)
