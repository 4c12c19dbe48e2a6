"""``p2wss reconstruct``: reconstruct buildings from LiDAR and footprints."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from p2wss.cli import argument_checks
from p2wss.cli.common import Parsers, add_command, add_device, add_threads, log, set_num_threads
from p2wss.cli.outlines import read_outlines
from p2wss.config import CLASSES_ALONE, OUTPUT_SUFFIXES, ClassPreset, Config, SchemaName, load, section_json
from p2wss.data.materials import MATERIALS
from p2wss.errors import InputError
from p2wss.provenance import fingerprint
from p2wss.storage import files

if TYPE_CHECKING:
    from p2wss.reconstruct.area import Area
    from p2wss.reconstruct.cloud_index import CloudIndex


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss reconstruct`` to the parser."""
    command = add_command(
        stages, "reconstruct", reconstruct, "reconstruct buildings from your own LiDAR and footprints"
    )
    command.usage = "p2wss reconstruct [-h] [options] CLOUD .. FOOTPRINTS OUT"
    _add_inputs(command)
    _add_outputs(command)
    command.add_argument(
        "--register",
        choices=["on", "off"],
        help="move footprints to where the clouds show the buildings, or not "
        "(default: reconstruct.registration of the config)",
    )
    add_threads(command)
    add_device(command)


def _add_inputs(command: argparse.ArgumentParser) -> None:
    """Which files are read, and how; and the folder to write."""
    command.add_argument(
        "inputs",
        type=Path,
        nargs="+",
        metavar="CLOUD .. FOOTPRINTS",
        help="LAS, LAZ or COPC files, or folders of them, and after these a vector file with polygons, reprojected if"
        " it is in another CRS",
    )
    command.add_argument("out", type=Path, metavar="OUT", help="folder to write")
    command.add_argument(
        "--no-footprints",
        action="store_true",
        help="omit FOOTPRINTS and use outlines derived from the points, as by p2wss outlines",
    )
    command.add_argument(
        "--model",
        type=Path,
        help="weights of the network (safetensors), or none to fit without a network "
        "(default: the weights that come with p2wss)",
    )
    command.add_argument(
        "--no-fit", action="store_true", help="keep the values predicted by the network, without the fit"
    )
    command.add_argument(
        "--id-field",
        metavar="COLUMN",
        help="column of FOOTPRINTS with building ids (default: that of the schema, otherwise feature numbers)",
    )
    command.add_argument(
        "--schema",
        choices=get_args(SchemaName),
        help="source of FOOTPRINTS, which defines its columns (default: reconstruct.footprint_schema of the config)",
    )
    command.add_argument(
        "--height-field",
        metavar="COLUMN",
        help="column of FOOTPRINTS with heights in metres, for buildings without points (default: that of the schema)",
    )
    command.add_argument(
        "--keep-columns",
        metavar="A,B,..",
        help="columns of FOOTPRINTS to copy to tables and CityJSON, or all "
        "(default: reconstruct.keep_columns of the config)",
    )
    command.add_argument(
        "--classes",
        choices=get_args(ClassPreset),
        help="classes of building, ground and ignored points (default: region.classes of the config)",
    )
    command.add_argument("--crs", help="CRS of clouds whose headers do not state it, for example EPSG:28992")
    command.add_argument(
        "--tile", help="reconstruct only the buildings of this tile; output files are named after it"
    )


def _add_outputs(command: argparse.ArgumentParser) -> None:
    """Which files are written, and what they contain."""
    command.add_argument(
        "--format",
        metavar="A,B,..",
        help=f"formats to write, from {', '.join(OUTPUT_SUFFIXES)} (default: reconstruct.outputs of the config)",
    )
    command.add_argument(
        "--attributes",
        choices=("p2wss", "3dbag"),
        help="attribute names: those of p2wss, or those of 3DBAG where 3DBAG has one (default: p2wss)",
    )
    command.add_argument(
        "--lod",
        metavar="A,B",
        help="levels of detail in CityJSON, from 1.2 and 2.0 (default: 2.0)",
    )
    command.add_argument(
        "--per-building", action="store_true", help="also write one mesh file per building, in a subfolder"
    )
    command.add_argument(
        "--terrain",
        type=Path,
        help="raster of terrain heights; meshes then stand on a closed block of terrain",
    )
    command.add_argument(
        "--skin",
        action="store_true",
        help="in mesh files, merge the buildings of a block into one closed skin without party walls",
    )
    command.add_argument(
        "--wedges", action="store_true", help="also write the convex edges of the skin to a Parquet file"
    )
    command.add_argument(
        "--materials",
        metavar="wall=A,roof=B,ground=C",
        help="materials in mesh files: of the terrain, and of buildings whose footprints state none "
        "(default: reconstruct.materials of the config)",
    )
    command.add_argument(
        "--frequency-ghz",
        type=float,
        metavar="F",
        help="frequency for which the materials of a Sionna scene are defined "
        "(default: reconstruct.frequency_ghz of the config)",
    )
    command.add_argument(
        "--split-materials",
        action="store_true",
        help="one shape per material in Sionna scenes; edges between walls and roofs then do not diffract",
    )


def reconstruct(arguments: argparse.Namespace) -> None:
    """Reconstruct the buildings and write the output files."""
    _split_inputs(arguments)
    config = _reconstruct_config(arguments)
    inputs = argument_checks.check(arguments, config)
    set_num_threads(arguments.threads)
    from p2wss.footprints import cleaning as footprints
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

    weights, crs, terrain = inputs.weights, inputs.crs, inputs.terrain
    predictor = None if weights is None else load_predictor(weights, arguments.device)
    settings = config.reconstruct
    cloud = None
    if arguments.no_footprints:
        cloud, features = read_outlines(config, inputs)
    else:
        features = footprints.read_footprints(
            arguments.footprints,
            settings.id_field or None,
            needs_crs=False,
            schema=settings.footprint_schema,
            height_field=settings.height_field or None,
            metric=inputs.metric,
        )
    frame = footprints.clean_footprints(features, footprint_settings(config))
    area = reconstruct_Area(frame, in_tile(frame, arguments.tile, config.region.tile_size_m), settings)
    folder = argument_checks.existing_folder(arguments.out)
    with (
        CloudIndex(area.boxes, folder, adds_classes=cloud is None) as points,
        Spool[Result](len(area.numbers), folder) as store,
    ):
        if cloud is None:
            _read_clouds(arguments, config, inputs, area, points)
            # points classified by p2wss, and not by the producer, move footprints only on request
            registers = area.may_move(points) | (settings.registration and arguments.register == "on")
        else:
            points.append(cloud)
            cloud, registers = None, area.is_chosen & False
        chosen = frame[area.is_chosen]
        if terrain is not None:
            exports.check_coverage(terrain, chosen, arguments.terrain)
        for note in exports.notes(settings, chosen, terrain is not None):
            log.info("note: %s", note)
        method = "fit to the points without a network" if weights is None else f"model {weights}"
        log.info("%d footprints, %d points around them; %s", len(chosen), points.num_points, method)
        stem = arguments.tile or output_stem(arguments.clouds[0])
        with Progress("reconstruct", len(area.numbers), "buildings") as progress:
            run_area(area, points, predictor, stem, settings, store, registers, progress.update, terrain)
        results = store[: len(chosen)]
        if registers[area.is_chosen].any():
            log.info("%s", registration_summary(result.registration for result in results))
        if arguments.tile is None and not arguments.no_footprints:
            check_overlap(results, arguments.clouds[0], arguments.footprints)
        if terrain is not None and (difference := exports.terrain_note(results, terrain)):
            log.info("note: %s", difference)
        sections = section_json(config, "region", "scenes", "reconstruct", without=CLASSES_ALONE)
        code = fingerprint("reconstruct")
        facts = files.provenance(
            config=sections, code=code, crs=crs.to_string(), model=weights and weights.name
        )
        facts["clouds"] = [header.path.name for header in inputs.clouds]
        outputs = exports.write(arguments.out, stem, results, crs, facts, settings, terrain)
        log.info("%s: %s", arguments.out, ", ".join(outputs))
        log.info("%s", summary(results))


def _split_inputs(arguments: argparse.Namespace) -> None:
    """Split the paths before OUT into ``clouds`` and ``footprints``, which is None with ``--no-footprints``."""
    arguments.clouds, arguments.footprints = arguments.inputs, None
    if not arguments.no_footprints:
        *arguments.clouds, arguments.footprints = arguments.inputs
    if not arguments.clouds:
        raise InputError("FOOTPRINTS or CLOUD is missing: p2wss reconstruct CLOUD .. FOOTPRINTS OUT")


def _read_clouds(
    arguments: argparse.Namespace,
    config: Config,
    inputs: argument_checks.Inputs,
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

    metric, frame = inputs.metric, area.frame
    window = metric.window_of_clouds(reconstruct_window(frame))
    if arguments.tile is None and not any(header.overlaps(window) for header in inputs.clouds):
        raise InputError(no_overlap(len(frame), arguments.clouds[0], arguments.footprints))
    window = metric.window_of_clouds(points.bounds)
    near = [header.path for header in inputs.clouds if header.overlaps(window)]
    for chunk in clouds.read_in_chunks(near, window, class_set(config.region.classes)):
        points.append(metric.cloud(chunk))
    for warning in unclassified.warnings(*area.missing_classes(points)):
        log.warning("warning: %s", warning)


def _reconstruct_config(arguments: argparse.Namespace) -> Config:
    """The config, with the options of the command line in its section ``reconstruct``."""
    options: dict[str, Any] = {}
    if arguments.no_fit:
        options["fit"] = False
    if arguments.format is not None:
        options["outputs"] = [name.strip() for name in arguments.format.split(",") if name.strip()]
        unknown = [name for name in options["outputs"] if name not in OUTPUT_SUFFIXES]
        if unknown or not options["outputs"]:
            reason = f"unknown format {unknown[0]}" if unknown else "no format"
            raise InputError(
                f"--format {arguments.format}: {reason}; choose from {', '.join(OUTPUT_SUFFIXES)}"
            )
    if arguments.attributes is not None:
        options["attribute_names"] = arguments.attributes
    if arguments.lod is not None:
        options["lods"] = [name.strip() for name in arguments.lod.split(",")]
        if not set(options["lods"]) <= {"1.2", "2.0"}:
            raise InputError(f"--lod {arguments.lod}: choose from 1.2, 2.0")
    for name in ("per_building", "skin", "wedges"):
        if getattr(arguments, name):
            options[name] = True
    for name, value in (
        ("id_field", arguments.id_field),
        ("height_field", arguments.height_field),
        ("footprint_schema", arguments.schema),
    ):
        if value is not None:
            options[name] = value
    if arguments.keep_columns is not None:
        options["keep_columns"] = [name.strip() for name in arguments.keep_columns.split(",") if name.strip()]
    if arguments.frequency_ghz is not None:
        options["frequency_ghz"] = arguments.frequency_ghz
    if arguments.split_materials:
        options["split_materials"] = True
    if arguments.register is not None:
        options["registration"] = arguments.register == "on"
    if arguments.materials is not None:
        options["materials"] = _materials(arguments.materials)
    classes = {} if arguments.classes is None else {"classes": {"preset": arguments.classes}}
    return load(arguments.config, {"reconstruct": options, "region": classes})


def _materials(text: str) -> dict[str, str]:
    """The materials by surface of ``--materials``. Raises :class:`InputError` that names what may be stated."""
    result = {}
    for pair in filter(None, map(str.strip, text.split(","))):
        surface, _, material = map(str.strip, pair.partition("="))
        if surface not in ("wall", "roof", "ground"):
            raise InputError(f"--materials {pair}: state materials as wall=A,roof=B,ground=C")
        if material not in MATERIALS:
            raise InputError(f"--materials {pair}: no such material; choose from {', '.join(MATERIALS)}")
        result[surface] = material
    return result
