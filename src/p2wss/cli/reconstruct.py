"""``p2wss reconstruct``: buildings from LiDAR and footprints."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from p2wss.cli.common import (
    DEVICES,
    Parsers,
    add_command,
    log,
    read_config,
    set_num_threads,
)
from p2wss.config import OUTPUT_SUFFIXES, Config, section_json
from p2wss.data import files
from p2wss.errors import InputError
from p2wss.provenance import fingerprint


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss reconstruct`` to the parser."""
    command = add_command(stages, "reconstruct", reconstruct, "buildings from your own LiDAR and footprints")
    command.add_argument("clouds", type=Path, nargs="+", metavar="CLOUD", help="LAS, LAZ or COPC")
    command.add_argument("footprints", type=Path, help="any vector file, in the CRS of the clouds")
    command.add_argument("out", type=Path, help="folder")
    command.add_argument(
        "--model",
        type=Path,
        default=None,
        help="model.safetensors; none: fit only; default: the weights that came with p2wss, if any",
    )
    command.add_argument("--no-fit", action="store_true", help="leave the network's values as they are")
    command.add_argument(
        "--id-field", default=None, help="column of building ids; default: the usual names, else a number"
    )
    command.add_argument(
        "--crs", default=None, help="of the clouds, where their headers tell none, such as EPSG:28992"
    )
    command.add_argument(
        "--tile", default=None, help="only the buildings of this tile, whose name the outputs get"
    )
    command.add_argument(
        "--format",
        default=None,
        metavar="A,B,..",
        help=f"what to write: {', '.join(OUTPUT_SUFFIXES)}; default: reconstruct.outputs of the config",
    )
    command.add_argument("--per-building", action="store_true", help="meshes one by one too, in a folder")
    command.add_argument(
        "--terrain", type=Path, default=None, help="raster of heights: meshes stand in a closed block of it"
    )
    command.add_argument("--threads", type=int, default=1)
    command.add_argument("--device", choices=DEVICES, default="auto")


def reconstruct(arguments: argparse.Namespace) -> None:
    set_num_threads(arguments.threads)
    from p2wss import reconstruct
    from p2wss.data import clouds, footprints
    from p2wss.data.progress import Progress
    from p2wss.data.terrain import read_terrain
    from p2wss.nets.predictor import load_predictor
    from p2wss.reconstruct import exports

    config = _reconstruct_config(arguments)
    weights = reconstruct.weights_to_use(arguments.model, config.reconstruct)
    predictor = None if weights is None else load_predictor(weights)
    terrain, terrain_crs = (None, None) if arguments.terrain is None else read_terrain(arguments.terrain)
    read = footprints.read_footprints(arguments.footprints, arguments.id_field, needs_crs=False)
    frame = footprints.clean_footprints(read, config.scenes)
    if arguments.tile is not None:
        frame = reconstruct.of_tile(frame, arguments.tile, config.region.tile_size_m)
    cloud = clouds.read_clouds(arguments.clouds, reconstruct.window(frame))
    names = (str(arguments.clouds[0]), str(arguments.footprints))
    crs, note = reconstruct.common_crs(cloud.crs, frame.crs, arguments.crs, names)
    if note:
        log.info("note: %s", note)
    if terrain_crs is not None:
        exports.check_terrain(terrain_crs, crs, arguments.terrain)
    by = "fitted to the points alone" if weights is None else f"model {weights}"
    log.info("%d footprints, %d points around them; %s", len(frame), len(cloud), by)
    stem = arguments.tile or reconstruct.output_stem(arguments.clouds[0])
    with Progress("reconstruct", len(frame), "buildings") as progress:
        results = reconstruct.run(frame, cloud, predictor, stem, config.reconstruct, progress.update)
    if arguments.tile is None:
        reconstruct.check_overlap(results, arguments.clouds[0], arguments.footprints)
    if terrain is not None and (note := exports.terrain_note(results, terrain)):
        log.info("note: %s", note)
    made_by = section_json(config, "scenes", "reconstruct")
    code = fingerprint("reconstruct")
    facts = files.provenance(config=made_by, code=code, crs=crs.to_string(), model=weights and weights.name)
    written = exports.write(arguments.out, stem, results, crs, facts, config.reconstruct, terrain)
    log.info("%s: %s", arguments.out, ", ".join(written))
    log.info("%s", reconstruct.summary(results))


def _reconstruct_config(arguments: argparse.Namespace) -> Config:
    """The config with what the command line says of its section ``reconstruct``."""
    said: dict[str, Any] = {}
    if arguments.no_fit:
        said["fit"] = False
    if arguments.format is not None:
        said["outputs"] = [name.strip() for name in arguments.format.split(",") if name.strip()]
        unknown = [name for name in said["outputs"] if name not in OUTPUT_SUFFIXES]
        if unknown or not said["outputs"]:
            told = f"no format {unknown[0]}" if unknown else "names no format"
            raise InputError(f"--format {arguments.format}: {told}; choose from {', '.join(OUTPUT_SUFFIXES)}")
    if arguments.per_building:
        said["per_building"] = True
    config = read_config(arguments)
    return config.model_copy(update={"reconstruct": config.reconstruct.model_copy(update=said)})
