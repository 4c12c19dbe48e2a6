"""``p2wss check``: whether the solids of CityJSON files are valid."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import click

from p2wss.cli.parser import PATH, Command, option
from p2wss.errors import InputError


@click.command(cls=Command)
@click.argument(
    "files",
    type=PATH,
    nargs=-1,
    required=True,
    metavar="FILE ..",
    help="CityJSON files or CityJSON text sequences",
)
@option("--val3dity", metavar="PROGRAM", help="also run this installation of val3dity and print its report")
def check(files: tuple[Path, ...], val3dity: str | None) -> int:
    """Validate the solids of CityJSON files.

    The rules are those of ISO 19107, with the default tolerances of val3dity. Prints one line per invalid solid. The
    exit status is 1 if there is one.
    """
    from p2wss.formats import cityjson_read
    from p2wss.formats.val3dity import report
    from p2wss.mesh.rules import MEANINGS, breaches

    num_invalid = 0
    for path in files:
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
        if val3dity:
            for name, errors in report(val3dity, path).items():
                invalid.add(f"{name} (val3dity)")
                print(f"{path}: {name}: val3dity: {'; '.join(errors)}")
        print(f"{path}: {num_solids} solids, {len(codes)} invalid")
        num_invalid += len(invalid)
    return int(num_invalid > 0)
