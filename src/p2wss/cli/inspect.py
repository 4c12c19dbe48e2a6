"""``p2wss inspect``: the contents of a file."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from p2wss.cli.common import Parsers


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss inspect`` to the parser."""
    command = stages.add_parser(
        "inspect",
        help="describe the contents of files",
        description="Describe the contents of files: results of p2wss, and data of IGN.",
    )
    command.add_argument("files", type=Path, nargs="+", metavar="FILE", help="files to describe")
    command.add_argument(
        "--verify",
        action="store_true",
        help="verify the checksums of files; the exit status is 2 if a file is damaged or has no checksum",
    )
    command.add_argument("--json", action="store_true", help="print one line of JSON per file")
    command.set_defaults(run=inspect)


def inspect(arguments: argparse.Namespace) -> int:
    """Describe or verify the files. Returns the exit status."""
    from p2wss.cli import inspection

    if arguments.verify:
        checks = [inspection.check(path) for path in arguments.files]
        for facts in checks:
            print(json.dumps(facts) if arguments.json else ": ".join(map(str, facts.values())))
        return 0 if all(facts["checksum"] == inspection.INTACT for facts in checks) else 2
    for path in arguments.files:
        facts = inspection.describe(path)
        print(json.dumps(facts) if arguments.json else inspection.text(facts))
    return 0
