"""``p2wss check``: whether the solids of CityJSON files are valid."""

from pathlib import Path

import click

import p2wss
from p2wss.cli.common import city_files
from p2wss.cli.parser import PATH, Command
from p2wss.storage.messages import InputError


@click.command(cls=Command)
@click.argument(
    "files",
    type=PATH,
    nargs=-1,
    required=True,
    metavar="FILE|FOLDER ..",
    help="CityJSON files or CityJSON text sequences, or folders of them",
)
def check(files: tuple[Path, ...]) -> int:
    """Validate the solids of CityJSON files.

    The rules are those of ISO 19107, with the default tolerances of val3dity. Prints one line per invalid solid. The
    exit status is 1 if there is one.
    """
    num_invalid, paths = 0, list[Path]()
    for each in files:
        inside = city_files(each)
        if each.is_dir() and not inside:
            raise InputError(f"{each}: has no CityJSON files")
        paths += inside or [each]
    for path in paths:
        validity = p2wss.check(path)
        for name, errors in validity.invalid.items():
            print(f"{path}: {name}: {'; '.join(errors)}")
        print(f"{path}: {validity.num_solids} solids, {len(validity.invalid)} invalid")
        num_invalid += len(validity.invalid)
    return int(num_invalid > 0)
