"""``p2wss towns``: a synthetic town in IGN's file formats."""

from pathlib import Path

import click

from p2wss.cli.common import log
from p2wss.cli.parser import Command, file_option, option


@click.command(cls=Command)
@option(
    "--seed",
    type=click.IntRange(min=0),
    required=True,
    help="seed of the town; each seed gives a different town",
)
@file_option("--out", "output folder, with bdtopo/ and rgealti/")
def towns(seed: int, out: Path) -> None:
    """Generate a synthetic town: footprints and terrain in IGN's file formats."""
    from p2wss.towns import write_town

    town = write_town(out, seed)
    log.info(f"{out}: town {seed} with {len(town)} buildings")
