"""``p2wss config``: every setting."""

import click

from p2wss.cli.parser import Command, option


@click.command(cls=Command)
@option("--schema", is_flag=True, help="print the JSON schema instead, by which editors complete settings")
def config(schema: bool) -> None:
    """Print every setting with its default, unit and description, as YAML.

    A config needs only the settings that differ: p2wss config > my.yaml, delete the rest, p2wss reconstruct --config
    my.yaml.
    """
    from p2wss.config import generate

    print(generate.json_schema() if schema else generate.default_yaml(), end="")
