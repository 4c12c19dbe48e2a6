"""``p2wss explain``: why the roof of a building is as it is."""

from pathlib import Path

import click

from p2wss.cli.common import classes_option, config_option, crs_option, inputs_argument, log
from p2wss.cli.parser import PATH, Command, option, setting
from p2wss.config import Config
from p2wss.storage import files
from p2wss.storage.messages import InputError


@click.command(cls=Command)
@inputs_argument
@click.argument("building_id", metavar="ID", help="of the building, as in the results of the run")
@option("--out", type=PATH, metavar="FILE", help="picture to write, .svg or .png")
@crs_option
@setting("reconstruct.detail")
@setting("reconstruct.registration")
@option("--lines", type=PATH, help="vector file with lines of roofs, as for p2wss reconstruct")
@setting("reconstruct.height_unit")
@setting("reconstruct.footprint_layer", "--layer", metavar="NAME")
@setting("reconstruct.footprint_schema")
@setting("reconstruct.id_field", metavar="COLUMN")
@classes_option
@config_option
def explain(
    inputs: tuple[Path, ...],
    building_id: str,
    out: Path | None,
    lines: Path | None,
    crs: str | None,
    config: Config,
) -> None:
    """Reconstruct one building, and show why its roof is as it is: its points by plane, the lines along which planes
    may end, what each plane saves, and what the prices are."""
    if len(inputs) < 2:
        raise click.UsageError("CLOUD, FOOTPRINTS or ID is missing", click.get_current_context())
    if out is not None and out.suffix not in (".svg", ".png"):
        raise InputError(f"{out}: a picture is a .svg or a .png file")
    from p2wss.reconstruction.inputs import check_inputs

    checked = check_inputs(list(inputs[:-1]), inputs[-1], config, crs, lines=lines)
    from p2wss.reconstruction import explain  # only now, as it takes a second

    explanation = explain.explain(checked, config, building_id)
    click.echo(explanation)
    if out is not None:
        with files.atomic(out) as temporary:
            explanation.plot().savefig(temporary, format=out.suffix[1:], dpi=100, metadata={"Date": None})
        log.info("%s", out)
