"""``p2wss check``: whether the solids of CityJSON files are valid."""

from __future__ import annotations

from pathlib import Path

import click

from p2wss.cli.parser import PATH, Command, option


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
    from p2wss.formats.val3dity import report
    from p2wss.formats.validity import check_file

    num_invalid = 0
    for path in files:
        validity = check_file(path)
        for name, errors in validity.invalid.items():
            print(f"{path}: {name}: {'; '.join(errors)}")
        invalid = set(validity.invalid)
        if val3dity:
            for name, errors in report(val3dity, path).items():
                invalid.add(f"{name} (val3dity)")
                print(f"{path}: {name}: val3dity: {'; '.join(errors)}")
        print(f"{path}: {validity.num_solids} solids, {len(validity.invalid)} invalid")
        num_invalid += len(invalid)
    return int(num_invalid > 0)
