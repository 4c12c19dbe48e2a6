"""``p2wss inspect``: what a file holds."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from p2wss.cli.common import (
    Parsers,
)


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss inspect`` to the parser."""
    about = "what a file holds: ours, and those of IGN"
    command = stages.add_parser("inspect", help=about, description=about)
    command.add_argument("files", type=Path, nargs="+", metavar="FILE")
    command.add_argument("--json", action="store_true", help="one line of JSON per file")
    command.set_defaults(run=inspect)


def inspect(arguments: argparse.Namespace) -> None:
    from p2wss.data import inspection

    for path in arguments.files:
        facts = inspection.describe(path)
        print(json.dumps(facts) if arguments.json else inspection.text(facts))
