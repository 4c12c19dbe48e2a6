"""``p2wss evaluate``: the buildings of a CityJSON file against point clouds."""

from __future__ import annotations

import argparse
from pathlib import Path

from p2wss.cli.common import Parsers
from p2wss.storage import files


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss evaluate`` to the parser."""
    command = stages.add_parser(
        "evaluate",
        help="measure the buildings of a CityJSON file of any program against LiDAR",
        description="Measure the buildings of a CityJSON file of any program against LiDAR: Chamfer distances"
        " of mesh and roof, distance from the points to the mesh, triangles, watertightness.",
    )
    command.add_argument("file", type=Path, metavar="FILE", help="CityJSON file or CityJSON text sequence")
    command.add_argument(
        "footprints", type=Path, metavar="FOOTPRINTS", help="vector file with a polygon per building"
    )
    command.add_argument(
        "clouds", type=Path, nargs="+", metavar="CLOUD", help="LAS, LAZ or COPC files, or folders of them"
    )
    command.add_argument(
        "--id-field", metavar="COLUMN", help="column of FOOTPRINTS with the ids (default: recognised)"
    )
    command.add_argument("--crs", help="CRS of clouds whose headers do not state it, for example EPSG:28992")
    command.add_argument("--csv", type=Path, help="CSV to write: one row per building")
    command.set_defaults(run=evaluate)


def evaluate(arguments: argparse.Namespace) -> None:
    """Print a summary, and write the rows."""
    from p2wss.eval.files import evaluate, summary

    options = {"id_field": arguments.id_field, "crs": arguments.crs}
    table = evaluate(arguments.file, arguments.footprints, arguments.clouds, **options)
    if arguments.csv is not None:
        files.write_text(arguments.csv, table.to_csv(float_format="%.4f", lineterminator="\n"))
    counts = ", ".join(f"{count} {status}" for status, count in table["status"].value_counts().items())
    print(f"{len(table)} buildings: {counts}; {(table['is_watertight'] == True).sum()} watertight")  # noqa: E712
    print(summary(table).to_string(float_format="%.3f"))
