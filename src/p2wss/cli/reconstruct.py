"""``p2wss reconstruct``: reconstruct buildings from LiDAR and footprints."""

import time
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from p2wss.cli import importing
from p2wss.cli.common import (
    check_arguments,
    classes_option,
    config_option,
    crs_option,
    device_option,
    inputs_argument,
    log_options,
    threads_option,
    write_run,
)
from p2wss.cli.parser import PATH, Command, Names, option, setting
from p2wss.config import Config, DeviceName
from p2wss.storage import files

# options that apply only to FOOTPRINTS, and --tile, which selects some of the footprints
OF_FOOTPRINTS = (
    "registration",
    "layer",
    "footprint_schema",
    "id_field",
    "height_field",
    "keep_columns",
    "tile",
)
# packages hidden while laspy and pyogrio are imported: they need them for clouds at URLs and for tables only
WITHOUT = ("requests", "pandas", "geopandas", "pyarrow")


@click.command(cls=Command)
@inputs_argument
@click.argument("out", type=PATH, metavar="OUT", help="folder to write")
@option(
    "--no-footprints",
    is_flag=True,
    help="omit FOOTPRINTS: derive outlines from the points",
)
@setting("reconstruct.outputs", "--outputs", "--format", more=False, help="formats to write")
@setting("reconstruct.detail", more=False, help="fewer triangles, or nearer to the points")
@option("--terrain", type=PATH, help="raster of heights; meshes then stand on a block of terrain")
@option(
    "--lines",
    type=PATH,
    more=True,
    help="vector file with lines of roofs, such as ridges, that planes may end at if the points do not contradict",
)
@setting("reconstruct.skin", more=False, help="merge the buildings of a block into one mesh")
@option("--ids", type=Names(), help="reconstruct only the buildings of these ids")
@option(
    "--bbox",
    type=float,
    nargs=4,
    metavar="X_MIN Y_MIN X_MAX Y_MAX",
    help="only those with their centre in this box, in the CRS of the clouds or in degrees (longitude, latitude)",
)
@option("--name", help="name of the files, without ending (default: that of the first cloud)")
@threads_option
@log_options
@config_option
@crs_option
@setting("reconstruct.registration", help="move footprints to where the points show the buildings")
@setting("reconstruct.vegetation", help="also write trees and clumps of plants, as closed volumes")
@option(
    "--model",
    type=PATH,
    more=True,
    help="weights of Point2WSS (safetensors), or point2wss for those that come with p2wss: buildings as the network "
    "predicts them; none: no network at all (default: a fit, and a network that completes roofs of few points)",
)
@device_option
@setting("reconstruct.roofs")
@setting("reconstruct.max_triangles", type=int, default="", metavar="N")
@setting("reconstruct.height_unit")
@setting("reconstruct.terrain_unit")
@setting("reconstruct.footprint_layer", "--layer", metavar="NAME")
@setting("reconstruct.footprint_schema")
@setting("reconstruct.id_field", metavar="COLUMN")
@setting("reconstruct.height_field", metavar="COLUMN")
@setting("reconstruct.keep_columns")
@classes_option
@option(
    "--tile", more=True, help="reconstruct only the buildings of this tile; output files are named after it"
)
@setting("reconstruct.attribute_names")
@setting("reconstruct.lods")
@setting("reconstruct.per_building")
@setting("reconstruct.wedges")
@setting(
    "reconstruct.materials",
    metavar="wall=A,roof=B,ground=C,vegetation=D",
    help="materials in mesh files: of the terrain, and of buildings whose footprints state none",
)
@setting("reconstruct.frequency_ghz", metavar="F")
@setting("reconstruct.split_materials")
@setting("reconstruct.max_failed_fraction", type=float, metavar="SHARE")
@setting("reconstruct.strict")
def reconstruct(
    inputs: tuple[Path, ...],
    out: Path,
    no_footprints: bool,
    crs: str | None,
    terrain: Path | None,
    lines: Path | None,
    threads: int,
    config: Config,
    model: Path | None,
    device: DeviceName,
    name: str | None,
    **chosen: Any,
) -> int:
    """Reconstruct buildings from your own LiDAR and footprints.

    In brackets: the setting of the config that an option overrides, and its default.
    """
    context = click.get_current_context()
    stated = [
        name for name in OF_FOOTPRINTS if context.get_parameter_source(name) == ParameterSource.COMMANDLINE
    ]
    if no_footprints and stated:
        raise click.UsageError(
            f"--{stated[0].replace('_', '-')}: has no effect with --no-footprints", context
        )
    clouds, footprints = (list(inputs), None) if no_footprints else (list(inputs[:-1]), inputs[-1])
    if not clouds:
        raise click.UsageError("CLOUD, FOOTPRINTS or OUT is missing", context)
    files.check_stem(name or "")
    check_arguments(out, terrain, chosen["tile"], config)
    with importing(*WITHOUT):
        from p2wss.reconstruction.inputs import check_inputs

    start = time.monotonic()
    may_be_empty = chosen["tile"] is not None
    checked = check_inputs(clouds, footprints, config, crs, terrain, model, may_be_empty, lines)
    with importing():
        from p2wss.reconstruction import run  # only now, as it takes a second
    machine = run.Machine(device, threads, files.existing_folder(out))
    if chosen["bbox"] is not None:
        from p2wss.fetching.area import bounds_of_bbox  # which loads pandas

        chosen["bbox"] = bounds_of_bbox(chosen["bbox"], checked.crs.to_string())
    with run.reconstruct(checked, config, run.Selection(**chosen), machine) as result:
        return write_run(out, result, start, name=name)
