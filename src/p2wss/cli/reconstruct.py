"""``p2wss reconstruct``: reconstruct buildings from LiDAR and footprints."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, get_args

from p2wss.cli import argument_checks
from p2wss.cli.common import Parsers, add_command, add_device, add_threads, log, set_num_threads
from p2wss.cli.outlines import read_outlines
from p2wss.config import CLASSES_ALONE, OUTPUT_SUFFIXES, ClassPreset, Config, SchemaName, load, section_json
from p2wss.data import files
from p2wss.data.materials import MATERIALS
from p2wss.errors import InputError
from p2wss.provenance import fingerprint


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss reconstruct`` to the parser."""
    command = add_command(
        stages, "reconstruct", reconstruct, "reconstruct buildings from your own LiDAR and footprints"
    )
    command.add_argument(
        "clouds", type=Path, nargs="+", metavar="CLOUD", help="LAS, LAZ or COPC files, or folders of them"
    )
    footprints = command.add_argument(
        "footprints",
        type=Path,
        metavar="FOOTPRINTS",
        help="vector file with polygons; those in another CRS than the clouds are reprojected",
    )
    command.add_argument("out", type=Path, metavar="OUT", help="folder to write")
    command.add_argument(
        "--no-footprints",
        action="store_true",
        help="without FOOTPRINTS: outlines from the points, as by p2wss outlines",
    )
    _allow_no_footprints(command, footprints)
    command.add_argument(
        "--model",
        type=Path,
        help="weights of the network (safetensors), or none to fit without a network "
        "(default: the weights that come with p2wss)",
    )
    command.add_argument("--no-fit", action="store_true", help="keep the network's values, do not fit them")
    command.add_argument(
        "--id-field",
        metavar="COLUMN",
        help="column of FOOTPRINTS with building ids (default: that of the schema, else the numbers of features)",
    )
    command.add_argument(
        "--schema",
        choices=get_args(SchemaName),
        help="columns of FOOTPRINTS: ids, heights, floors (default: reconstruct.footprint_schema of the config)",
    )
    command.add_argument(
        "--height-field",
        metavar="COLUMN",
        help="column of FOOTPRINTS with heights in metres, for buildings without points (default: that of the schema)",
    )
    command.add_argument(
        "--keep-columns",
        metavar="A,B,..",
        help="columns of FOOTPRINTS to pass through to tables and CityJSON, or all "
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
    command.add_argument(
        "--format",
        metavar="A,B,..",
        help=f"formats to write, from {', '.join(OUTPUT_SUFFIXES)} (default: reconstruct.outputs of the config)",
    )
    command.add_argument(
        "--attributes",
        choices=("p2wss", "3dbag"),
        help="names of attributes: ours, or those of 3DBAG where it has a name (default: p2wss)",
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
        help="join the buildings of a block into one closed skin without party walls, in mesh files",
    )
    command.add_argument(
        "--wedges", action="store_true", help="also write the convex edges of the skin, as Parquet"
    )
    command.add_argument(
        "--materials",
        metavar="wall=A,roof=B,ground=C",
        help="materials in mesh files of buildings whose footprints state none, and of the terrain "
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
        help="a shape per material in Sionna scenes; loses the diffracting edges between walls and roofs",
    )
    command.add_argument(
        "--register",
        choices=["on", "off"],
        help="whether to move footprints to where the clouds show the buildings "
        "(default: reconstruct.registration of the config)",
    )
    add_threads(command)
    add_device(command)


def _allow_no_footprints(command: argparse.ArgumentParser, footprints: argparse.Action) -> None:
    """With ``--no-footprints`` the last argument but one is a cloud."""
    parse = command.parse_known_args

    def parse_known_args(args: Any = None, namespace: Any = None) -> Any:
        footprints.nargs = "?" if "--no-footprints" in (args or ()) else None
        return parse(args, namespace)

    command.parse_known_args = parse_known_args  # type: ignore[method-assign]


def reconstruct(arguments: argparse.Namespace) -> None:
    """Reconstruct the buildings and write the output files."""
    config = _reconstruct_config(arguments)
    inputs = argument_checks.check(arguments, config)
    set_num_threads(arguments.threads)
    from p2wss import reconstruct
    from p2wss.data import clouds, footprints, unclassified
    from p2wss.data.las_classes import BUILDING_CLASS, class_set
    from p2wss.data.progress import Progress
    from p2wss.nets.predictor import load_predictor
    from p2wss.reconstruct import exports

    weights, crs, terrain = inputs.weights, inputs.crs, inputs.terrain
    predictor = None if weights is None else load_predictor(weights, arguments.device)
    settings = config.reconstruct
    classes = class_set(**dict(config.region.classes))
    tile = (arguments.tile, config.region.tile_size_m)
    can_register = False
    if arguments.no_footprints:
        cloud, outlines = read_outlines(config, inputs)
        around = footprints.clean_footprints(outlines, reconstruct.footprint_settings(config))
    else:
        features = footprints.read_footprints(
            arguments.footprints,
            settings.id_field or None,
            needs_crs=False,
            schema=settings.footprint_schema,
            height_field=settings.height_field or None,
            metric=inputs.metric,
        )
        frame = footprints.clean_footprints(features, reconstruct.footprint_settings(config))
        around = (
            frame if arguments.tile is None else reconstruct.around_tile(frame, *tile, config.reconstruct)
        )
        window_of_clouds = inputs.metric.window_of_clouds(reconstruct.window(around))
        near = [header for header in inputs.clouds if header.overlaps(window_of_clouds)]
        if not near and arguments.tile is None:
            raise InputError(reconstruct.no_overlap(len(frame), arguments.clouds[0], arguments.footprints))
        cloud = clouds.read_clouds([header.path for header in near], window_of_clouds, classes)
        # points that are not the producer's move footprints only if that is asked for
        can_register = bool((cloud.classification == BUILDING_CLASS).any()) or arguments.register == "on"
        cloud, warnings = unclassified.with_classes(inputs.metric.cloud(cloud))
        for warning in warnings:
            log.warning("warning: %s", warning)
    if terrain is not None:
        exports.check_coverage(terrain, around, arguments.terrain)
    if settings.registration and can_register:
        around = reconstruct.register(around, cloud)
    frame = around if arguments.tile is None else reconstruct.of_tile(around, *tile)
    if settings.registration and can_register:
        log.info("%s", reconstruct.registration_summary(frame))
    for note in exports.notes(config.reconstruct, frame, terrain is not None):
        log.info("note: %s", note)
    method = "fit to the points without a network" if weights is None else f"model {weights}"
    log.info("%d footprints, %d points around them; %s", len(frame), len(cloud), method)
    stem = arguments.tile or reconstruct.output_stem(arguments.clouds[0])
    with Progress("reconstruct", len(frame), "buildings") as progress:
        results = reconstruct.run(frame, cloud, predictor, stem, settings, progress.update, terrain)
    if arguments.tile is None and not arguments.no_footprints:
        reconstruct.check_overlap(results, arguments.clouds[0], arguments.footprints)
    if terrain is not None and (difference := exports.terrain_note(results, terrain)):
        log.info("note: %s", difference)
    sections = section_json(config, "region", "scenes", "reconstruct", without=CLASSES_ALONE)
    code = fingerprint("reconstruct")
    facts = files.provenance(config=sections, code=code, crs=crs.to_string(), model=weights and weights.name)
    facts["clouds"] = [header.path.name for header in inputs.clouds]
    outputs = exports.write(arguments.out, stem, results, crs, facts, config.reconstruct, terrain)
    log.info("%s: %s", arguments.out, ", ".join(outputs))
    log.info("%s", reconstruct.summary(results))


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
