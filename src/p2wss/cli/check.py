"""``p2wss check``: whether the solids of CityJSON files are valid."""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

from p2wss.cli.common import Parsers
from p2wss.errors import InputError


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss check`` to the parser."""
    command = stages.add_parser(
        "check",
        help="validate the solids of CityJSON files",
        description="Validate the solids of CityJSON files against the rules of ISO 19107, with the default tolerances "
        "of val3dity. Prints one line per invalid solid. The exit status is 1 if there is one.",
    )
    command.add_argument(
        "files", type=Path, nargs="+", metavar="FILE", help="CityJSON files or CityJSON text sequences"
    )
    command.add_argument(
        "--val3dity",
        metavar="PROGRAM",
        help="also run this installation of val3dity and print its report",
    )
    command.set_defaults(run=check)


def check(arguments: argparse.Namespace) -> int:
    """Print the invalid solids of all files. Returns the exit status: 1 if there is one."""
    from p2wss.formats import cityjson_read, val3dity
    from p2wss.mesh.rules import MEANINGS, breaches

    num_invalid = 0
    for path in arguments.files:
        num_solids, codes = 0, defaultdict(set)
        for shell in cityjson_read.shells(path):
            num_solids += shell.number == 0
            place = f"{shell.name} (LoD {shell.lod})" if shell.lod else shell.name
            for breach in breaches(shell.vertex_m, shell.surfaces, is_outer=shell.number == 0):
                codes[place].add(breach.code)
        if not num_solids:
            raise InputError(f"{path}: has no solids to check")
        for place, numbers in codes.items():
            text = "; ".join(f"{code} {MEANINGS[code]}" for code in sorted(numbers))
            print(f"{path}: {place}: {text}")
        invalid = set(codes)
        if arguments.val3dity:
            for name, errors in val3dity.report(arguments.val3dity, path).items():
                invalid.add(f"{name} (val3dity)")
                print(f"{path}: {name}: val3dity: {'; '.join(errors)}")
        print(f"{path}: {num_solids} solids, {len(codes)} invalid")
        num_invalid += len(invalid)
    return int(num_invalid > 0)
