"""``p2wss outlines``: outlines of buildings from LiDAR alone."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from p2wss.cli import argument_checks
from p2wss.cli.common import Parsers, add_command, log
from p2wss.config import ClassPreset, Config, load
from p2wss.errors import InputError
from p2wss.storage import files

if TYPE_CHECKING:
    import geopandas as gpd

    from p2wss.clouds.reading import Cloud


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss outlines`` to the parser."""
    command = add_command(
        stages, "outlines", outlines, "derive building outlines from LiDAR, without footprints"
    )
    command.add_argument(
        "clouds", type=Path, nargs="+", metavar="CLOUD", help="LAS, LAZ or COPC files, or folders of them"
    )
    command.add_argument("out", type=Path, metavar="OUT", help="GeoPackage to write (.gpkg)")
    command.add_argument("--crs", help="CRS of clouds whose headers do not state it, for example EPSG:28992")
    command.add_argument(
        "--classes",
        choices=get_args(ClassPreset),
        help="classes of building, ground and ignored points (default: region.classes of the config)",
    )


def outlines(arguments: argparse.Namespace) -> None:
    """Write the outlines."""
    if arguments.out.suffix.lower() != ".gpkg":
        raise InputError(
            f"{arguments.out}: outlines are written as GeoPackage; name a file that ends in .gpkg"
        )
    options = {} if arguments.classes is None else {"classes": {"preset": arguments.classes}}
    config = load(arguments.config, {"region": options})
    headers, metric = argument_checks.check_clouds(arguments)
    inputs = argument_checks.Inputs(headers, None, metric, None)
    _, frame = read_outlines(config, inputs)
    with files.atomic(arguments.out) as path:
        frame.to_file(path, driver="GPKG", layer="outlines")
    log.info("%s: %d outlines, %.0f m2", arguments.out, len(frame), frame.area.sum())


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
