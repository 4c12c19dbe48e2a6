"""The command line, one module per command. A command reads files, calls its stage and writes files.

Commands import heavy modules when they run, so that ``p2wss --help`` responds at once. Whatever decides a
result belongs in the package of the stage.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys

from p2wss import __version__
from p2wss.cli import (
    buildings,
    check,
    crops,
    dvae,
    evaluate,
    fetch,
    inspect,
    model,
    outlines,
    plan,
    reconstruct,
    scans,
    scenes,
    towns,
    warm_up,
)
from p2wss.cli import eval as evaluation
from p2wss.errors import InputError

# in the order of the pipeline
COMMANDS = (
    towns,
    fetch,
    scenes,
    buildings,
    scans,
    crops,
    dvae,
    model,
    evaluation,
    outlines,
    reconstruct,
    plan,
    inspect,
    check,
    evaluate,
    warm_up,
)


def main(arguments: list[str] | None = None) -> int:
    """Run one command. Returns the exit status: that of the command, 0 unless it says otherwise, or 2 for an error that
    the user can fix."""
    parser = _parser()
    parsed, rest = parser.parse_known_args(arguments)
    if rest:
        # argparse takes paths for several arguments from one place only
        hint = (
            ""
            if rest[0].startswith("-")
            else "; give all paths together, with the options before or after them"
        )
        parser.error(f"unrecognized arguments: {' '.join(rest)}{hint}")
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(message)s")
    # laspy both logs and raises errors of broken files; the exception is reported below
    logging.getLogger("laspy").setLevel(logging.CRITICAL)
    logging.getLogger("pyogrio").setLevel(logging.WARNING)  # pyogrio reports every file that it writes
    try:
        status = parsed.run(parsed) or 0
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # whoever reads what this prints has stopped, as head does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except InputError as error:
        print(f"p2wss: error: {error}", file=sys.stderr)
        return 2


class _Parser(argparse.ArgumentParser):
    """A parser that reads arguments from files too: Linux starts no program with more than 2 MB of arguments."""

    def convert_arg_line_to_args(self, arg_line: str) -> list[str]:
        return [arg_line] if arg_line else []


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="p2wss",
        description="Watertight LoD2 buildings from building footprints and aerial LiDAR.",
        epilog="p2wss COMMAND --help describes a command; the Snakemake workflow runs them in order. "
        "@FILE stands for arguments that are listed in a file, one per line.",
        fromfile_prefix_chars="@",
    )
    parser.add_argument("--version", action="version", version=f"p2wss {__version__}")
    commands = parser.add_subparsers(
        title="commands, in the order of the pipeline", required=True, metavar="COMMAND"
    )
    for command in COMMANDS:
        command.add_parser(commands)
    return parser
