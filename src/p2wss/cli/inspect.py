"""``p2wss inspect``: the contents of a file."""

from __future__ import annotations

import json
from pathlib import Path

import click

from p2wss.cli.parser import PATH, Command, option


@click.command(cls=Command)
@click.argument("files", type=PATH, nargs=-1, required=True, metavar="FILE ..", help="files to describe")
@option(
    "--verify",
    is_flag=True,
    help="verify the checksums of files; the exit status is 2 if a file is damaged or has no checksum",
)
@option("--json", "as_json", is_flag=True, help="print one line of JSON per file")
def inspect(files: tuple[Path, ...], verify: bool, as_json: bool) -> int:
    """Describe the contents of files: results of p2wss, and data of IGN."""
    from p2wss.cli import inspection

    if verify:
        checks = [inspection.check(path) for path in files]
        for facts in checks:
            print(json.dumps(facts) if as_json else ": ".join(map(str, facts.values())))
        return 0 if all(facts["checksum"] == inspection.INTACT for facts in checks) else 2
    for path in files:
        facts = inspection.describe(path)
        print(json.dumps(facts) if as_json else inspection.text(facts))
    return 0
