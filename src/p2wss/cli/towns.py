"""``p2wss towns``: a synthetic town in IGN's file formats."""

from __future__ import annotations

import argparse
from pathlib import Path

from p2wss.cli.common import Parsers, log


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss towns`` to the parser."""
    command = stages.add_parser(
        "towns",
        help="generate a synthetic town in IGN's file formats",
        description="Generate a synthetic town: footprints, terrain and stand-in LiDAR in IGN's file formats.",
    )
    command.add_argument(
        "--seed", type=int, required=True, help="seed of the town; each seed gives a different town"
    )
    command.add_argument(
        "--out", type=Path, required=True, help="output folder, with bdtopo/, rgealti/ and lidar/"
    )
    command.add_argument(
        "--lidar", action="store_true", help="also simulate stand-in LiDAR for tile 0653_6861"
    )
    command.set_defaults(run=towns)


def towns(arguments: argparse.Namespace) -> None:
    """Write a synthetic town."""
    from p2wss.towns import write_town

    num_buildings = write_town(arguments.out, arguments.seed, arguments.lidar)
    log.info(f"{arguments.out}: town {arguments.seed} with {num_buildings} buildings")
