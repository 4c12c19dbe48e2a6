"""``p2wss reconstruct``: reconstruct buildings from LiDAR and footprints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from p2wss.cli import argument_checks
from p2wss.cli.argument_checks import Request
from p2wss.cli.common import (
    classes_option,
    config_option,
    crs_option,
    device_option,
    log,
    set_num_threads,
    threads_option,
)
from p2wss.cli.outlines import read_outlines
from p2wss.cli.parser import PATH, Command, option, setting
from p2wss.config import CLASSES_ALONE, Config, section_json
from p2wss.errors import InputError
from p2wss.provenance import fingerprint
from p2wss.storage import files

if TYPE_CHECKING:
    from p2wss.nets.compute import DeviceName
    from p2wss.reconstruct.area import Area
    from p2wss.reconstruct.cloud_index import CloudIndex

# settings of FOOTPRINTS, and --tile, which selects some of them
OF_FOOTPRINTS = ("registration", "footprint_schema", "id_field", "height_field", "keep_columns", "tile")


@click.command(cls=Command)
@click.argument(
    "inputs",
    type=PATH,
    nargs=-1,
    required=True,
    metavar="CLOUD .. FOOTPRINTS",
    help="LAS, LAZ or COPC files, or folders of them; then a vector file with polygons, reprojected if it is in "
    "another CRS",
)
@click.argument("out", type=PATH, metavar="OUT", help="folder to write")
@option(
    "--no-footprints",
    is_flag=True,
    help="omit FOOTPRINTS: derive outlines from the points",
)
@crs_option
@setting("reconstruct.outputs", "--outputs", "--format", more=False, help="formats to write")
@setting("reconstruct.detail", more=False, help="fewer triangles, or nearer to the points")
@setting(
    "reconstruct.registration", more=False, help="move footprints to where the points show the buildings"
)
@option("--terrain", type=PATH, help="raster of heights; meshes then stand on a block of terrain")
@setting("reconstruct.skin", more=False, help="merge the buildings of a block into one mesh")
@threads_option
@config_option
@option(
    "--model",
    type=PATH,
    more=True,
    help="weights of the network (safetensors), or none to fit without a network (default: the weights that come "
    "with p2wss)",
)
@device_option
@setting("reconstruct.fit")
@setting("reconstruct.max_parts", metavar="N")
@setting("reconstruct.dormers")
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
    metavar="wall=A,roof=B,ground=C",
    help="materials in mesh files: of the terrain, and of buildings whose footprints state none",
)
@setting("reconstruct.frequency_ghz", metavar="F")
@setting("reconstruct.split_materials")
def reconstruct(
    inputs: tuple[Path, ...],
    out: Path,
    no_footprints: bool,
    crs: str | None,
    terrain: Path | None,
    threads: int,
    config: Config,
    model: Path | None,
    device: DeviceName,
    tile: str | None,
) -> None:
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
        raise click.UsageError("FOOTPRINTS or CLOUD is missing", context)
    request = Request(clouds, footprints, out, crs, terrain, model, device, tile)
    checked = argument_checks.check(request, config)
    set_num_threads(threads)
    from p2wss.footprints.cleaning import clean_footprints, read_footprints
    from p2wss.nets.predictor import load_predictor
    from p2wss.reconstruct import exports
    from p2wss.reconstruct.area import Area as reconstruct_Area
    from p2wss.reconstruct.area import run_area
    from p2wss.reconstruct.cloud_index import CloudIndex
    from p2wss.reconstruct.inputs import footprint_settings, in_tile, output_stem
    from p2wss.reconstruct.pipeline import Result, check_overlap, summary
    from p2wss.reconstruct.registration import summary as registration_summary
    from p2wss.reconstruct.spool import Spool
    from p2wss.storage.progress import Progress

    weights, land = checked.weights, checked.terrain
    predictor = None if weights is None else load_predictor(weights, device)
    settings = config.reconstruct
    cloud = None
    if footprints is None:
        cloud, features = read_outlines(config, checked)
    else:
        features = read_footprints(
            footprints,
            settings.id_field or None,
            needs_crs=False,
            schema=settings.footprint_schema,
            height_field=settings.height_field or None,
            metric=checked.metric,
        )
    frame = clean_footprints(features, footprint_settings(config))
    area = reconstruct_Area(frame, in_tile(frame, tile, config.region.tile_size_m), settings)
    folder = argument_checks.existing_folder(out)
    with (
        CloudIndex(area.boxes, folder, adds_classes=cloud is None) as points,
        Spool[Result](len(area.numbers), folder) as store,
    ):
        if cloud is None:
            _read_clouds(request, config, checked, area, points)
            # points classified by p2wss, and not by the producer, move footprints only on request
            registers = area.may_move(points) | (settings.registration and "registration" in stated)
        else:
            points.append(cloud)
            cloud, registers = None, area.is_chosen & False
        chosen = frame[area.is_chosen]
        if land is not None and terrain is not None:
            exports.check_coverage(land, chosen, terrain)
        for note in exports.notes(settings, chosen, land is not None):
            log.info("note: %s", note)
        method = "fit to the points without a network" if weights is None else f"model {weights}"
        log.info("%d footprints, %d points around them; %s", len(chosen), points.num_points, method)
        stem = tile or output_stem(clouds[0])
        with Progress("reconstruct", len(area.numbers), "buildings") as progress:
            run_area(area, points, predictor, stem, settings, store, registers, progress.update, land)
        results = store[: len(chosen)]
        if registers[area.is_chosen].any():
            log.info("%s", registration_summary(result.registration for result in results))
        if tile is None and footprints is not None:
            check_overlap(results, clouds[0], footprints)
        if land is not None and (difference := exports.terrain_note(results, land)):
            log.info("note: %s", difference)
        sections = section_json(config, "region", "scenes", "reconstruct", without=CLASSES_ALONE)
        code = fingerprint("reconstruct")
        facts = files.provenance(
            config=sections, code=code, crs=checked.crs.to_string(), model=weights and weights.name
        )
        facts["clouds"] = [header.path.name for header in checked.clouds]
        outputs = exports.write(out, stem, results, checked.crs, facts, settings, land)
        log.info("%s: %s", out, ", ".join(outputs))
        log.info("%s", summary(results))


def _read_clouds(
    request: Request,
    config: Config,
    checked: argument_checks.Inputs,
    area: Area,
    points: CloudIndex,
) -> None:
    """Put the points of the clouds into the index, with warnings where they lack classes.

    Raises :class:`InputError` if no cloud is near the footprints; a tile may be empty."""
    from p2wss.clouds import reading as clouds
    from p2wss.clouds.las_classes import class_set
    from p2wss.reconstruct import unclassified
    from p2wss.reconstruct.inputs import window as reconstruct_window
    from p2wss.reconstruct.pipeline import no_overlap

    metric, frame = checked.metric, area.frame
    window = metric.window_of_clouds(reconstruct_window(frame))
    if (
        request.footprints is not None
        and request.tile is None
        and not any(header.overlaps(window) for header in checked.clouds)
    ):
        raise InputError(no_overlap(len(frame), request.clouds[0], request.footprints))
    window = metric.window_of_clouds(points.bounds)
    near = [header.path for header in checked.clouds if header.overlaps(window)]
    for chunk in clouds.read_in_chunks(near, window, class_set(config.region.classes)):
        points.append(metric.cloud(chunk))
    for warning in unclassified.warnings(*area.missing_classes(points)):
        log.warning("warning: %s", warning)
