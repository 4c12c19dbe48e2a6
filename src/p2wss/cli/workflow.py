"""``p2wss workflow``: a project of the Snakemake workflow, which comes with the package."""

import shutil
import sysconfig
from pathlib import Path

import click

import p2wss
from p2wss.cli.common import log
from p2wss.cli.parser import PATH, Command, Group
from p2wss.storage.messages import InputError, writing

PARTS = ("Snakefile", "workflow", "config", "profiles", "envs", "tests/mini")


@click.group(cls=Group)
def workflow() -> None:
    """Begin a project of the Snakemake workflow."""


@workflow.command("init", cls=Command)
@click.argument("folder", type=PATH, metavar="FOLDER", help="folder of the project")
def workflow_init(folder: Path) -> None:
    """Write rules, configs, profiles, the miniature and weights into a folder, where snakemake then runs."""
    sources = {name: _origin() / name for name in PARTS} | {"models": Path(p2wss.__file__).parent / "weights"}
    if taken := [name for name in sources if (folder / name).exists()]:
        raise InputError(f"{folder / taken[0]}: exists; name a folder without a project")
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, source in sources.items():
            copy = shutil.copytree if source.is_dir() else shutil.copy
            copy(source, folder / name)
    log.info(
        "%s: rules, configs, profiles and the miniature; next: cd %s && snakemake -c2 eval_report",
        folder,
        folder,
    )


def _origin() -> Path:
    """Where the files of the workflow are: in the checkout, or beside the installed package."""
    checkout = Path(p2wss.__file__).parents[2]
    return (
        checkout if (checkout / "Snakefile").is_file() else Path(sysconfig.get_path("data"), "share", "p2wss")
    )
