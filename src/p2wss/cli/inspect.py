"""``p2wss inspect``: the contents of files, and what a run would make of them together."""

import json
from pathlib import Path

import click

from p2wss.cli.common import classes_option, config_option, crs_option
from p2wss.cli.parser import PATH, Command, option, setting
from p2wss.config import Config
from p2wss.storage.messages import InputError


@click.command(cls=Command)
@click.argument(
    "files",
    type=PATH,
    nargs=-1,
    required=True,
    metavar="FILE ..",
    help="files to describe, each alone; or clouds, then footprints, then, if you like, a raster of terrain: what "
    "p2wss reconstruct would read and believe of them together",
)
@option(
    "--verify",
    is_flag=True,
    help="verify the checksums of files; the exit status is 2 if a file is damaged or has no checksum",
)
@option("--json", "as_json", is_flag=True, help="print one line of JSON per file")
@crs_option
@setting("reconstruct.height_unit")
@setting("reconstruct.terrain_unit")
@setting("reconstruct.footprint_layer", "--layer", metavar="NAME")
@classes_option
@config_option
def inspect(files: tuple[Path, ...], verify: bool, as_json: bool, crs: str | None, config: Config) -> int:
    """Describe the contents of files, or clouds, footprints and terrain together before they are reconstructed.

    If p2wss reconstruct would refuse the inputs, the reason follows, and the exit status is 2.
    """
    from p2wss.cli import inspection

    if verify:
        checks = [inspection.check(path) for path in files]
        for facts in checks:
            print(json.dumps(facts) if as_json else ": ".join(map(str, facts.values())))
        return 0 if all(facts["checksum"] == inspection.INTACT for facts in checks) else 2
    together = inspection.inputs_of_run(files)
    if together is not None:
        from p2wss.reconstruction.inputs import check_inputs
        from p2wss.reconstruction.look import look

        clouds, footprints, terrain = together
        facts, problem = look(check_inputs(clouds, footprints, config, crs, terrain, "none"), config)
        print(json.dumps(facts) if as_json else inspection.text(facts))
        if problem:
            raise InputError(problem)
        return 0
    for path in files:
        facts = inspection.describe(path)
        print(json.dumps(facts) if as_json else inspection.text(facts))
    return 0
