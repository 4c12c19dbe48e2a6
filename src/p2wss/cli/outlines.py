"""``p2wss outlines``: outlines of buildings from LiDAR alone."""

from pathlib import Path

import click

from p2wss.cli.common import classes_option, clouds_argument, config_option, crs_option, log
from p2wss.cli.parser import PATH, Command
from p2wss.config import Config
from p2wss.storage import files
from p2wss.storage.messages import InputError


@click.command(cls=Command)
@clouds_argument
@click.argument("out", type=PATH, metavar="OUT", help="GeoPackage to write (.gpkg)")
@crs_option
@classes_option
@config_option
def outlines(clouds: tuple[Path, ...], out: Path, crs: str | None, config: Config) -> None:
    """Derive building outlines from LiDAR, without footprints."""
    if out.suffix.lower() != ".gpkg":
        raise InputError(f"{out}: outlines are written as GeoPackage; name a file that ends in .gpkg")
    from p2wss.reconstruction.inputs import check_inputs, read_outlines

    _, features, _ = read_outlines(check_inputs(clouds, None, config, crs, model="none"), config)
    with files.atomic(out) as path, files.gdal_options():
        features.to_frame().to_file(path, driver="GPKG", layer="outlines")
    log.info("%s: %d outlines, %.0f m2", out, len(features), features["area_m2"].sum())
