"""The command line: a module per command, each a few lines that read files, call the stage and write files.

Heavy modules are imported inside the commands, so that ``p2wss --help`` answers at once. Everything here is
glue: what decides a result belongs in the stage's package.
"""

from __future__ import annotations

import argparse
import logging
import sys

from p2wss import __version__
from p2wss.cli import buildings, crops, dvae, fetch, inspect, model, reconstruct, scans, scenes, towns
from p2wss.cli import eval as evaluation
from p2wss.errors import InputError

# in the order of the pipeline
COMMANDS = (towns, fetch, scenes, buildings, scans, crops, dvae, model, evaluation, reconstruct, inspect)


def main(arguments: list[str] | None = None) -> int:
    """Run one sub-command. Returns the exit status: 0, or 2 for input that the user can mend."""
    parsed = _parser().parse_args(arguments)
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(message)s")
    # what laspy logs of a broken file it raises too, which becomes the one line below
    logging.getLogger("laspy").setLevel(logging.CRITICAL)
    logging.getLogger("pyogrio").setLevel(logging.WARNING)  # it reports every file that it writes
    try:
        parsed.run(parsed)
    except InputError as error:
        print(f"p2wss: error: {error}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="p2wss", description="Footprints and LiDAR to watertight LoD2 buildings."
    )
    parser.add_argument("--version", action="version", version=f"p2wss {__version__}")
    stages = parser.add_subparsers(title="stages, in order", required=True, metavar="STAGE")
    for command in COMMANDS:
        command.add_parser(stages)
    return parser
