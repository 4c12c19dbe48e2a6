"""``p2wss evaluate``: the buildings of a CityJSON file against point clouds."""

from pathlib import Path

import click

from p2wss.cli.common import classes_option, clouds_argument, config_option, crs_option
from p2wss.cli.parser import PATH, Command, option, setting
from p2wss.config import Config
from p2wss.storage import files


@click.command(cls=Command)
@click.argument("file", type=PATH, metavar="FILE", help="CityJSON file or CityJSON text sequence")
@click.argument("footprints", type=PATH, metavar="FOOTPRINTS", help="vector file with a polygon per building")
@clouds_argument
@setting(
    "reconstruct.id_field",
    metavar="COLUMN",
    more=False,
    help="column of FOOTPRINTS with the ids (default: recognised)",
)
@setting("reconstruct.footprint_layer", "--layer", metavar="NAME")
@crs_option
@setting("reconstruct.height_unit")
@classes_option
@config_option
@option("--csv", type=PATH, help="CSV to write: one row per building")
def evaluate(
    file: Path,
    footprints: Path,
    clouds: tuple[Path, ...],
    crs: str | None,
    config: Config,
    csv: Path | None,
) -> None:
    """Measure the buildings of a CityJSON file of any program against LiDAR.

    Chamfer distances of mesh and roof, distance from the points to the mesh, triangles, watertightness.
    """
    from p2wss.eval.files import evaluate, summary

    table = evaluate(file, footprints, clouds, config, crs=crs)
    if csv is not None:
        files.write_text(csv, table.to_csv(float_format="%.4f", lineterminator="\n"))
    counts = ", ".join(f"{count} {status}" for status, count in table["status"].value_counts().items())
    print(f"{len(table)} buildings: {counts}; {(table['is_watertight'] == True).sum()} watertight")  # noqa: E712
    print(summary(table).to_string(float_format="%.3f"))
