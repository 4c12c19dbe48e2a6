"""``p2wss demo``: a first run that needs no data."""

import time
from importlib import resources
from pathlib import Path

import click

from p2wss.cli.common import log, log_options, write_run
from p2wss.cli.parser import PATH, Command
from p2wss.storage import files


@click.command(cls=Command)
@click.argument(
    "folder", type=PATH, default="p2wss-demo", metavar="[FOLDER]", help="folder to write (p2wss-demo)"
)
@log_options
def demo(folder: Path) -> int:
    """Write a small drawn town and its LiDAR, and reconstruct it."""
    import p2wss

    cloud, footprints = write_inputs(folder)
    log.info("%s: LiDAR of drawn buildings that is simulated; %s", cloud, footprints)
    start = time.monotonic()
    with p2wss.reconstruct(cloud, footprints) as scene:
        status = write_run(folder / "out", scene, start, ["cityjson", "glb", "gpkg", "report"])
    log.info("the same with files of your own: p2wss reconstruct %s %s %s", cloud, footprints, folder / "out")
    return status


def write_inputs(folder: Path) -> list[Path]:
    """Write a cloud and its footprints into a folder (``make mini`` draws them), and return their paths."""
    paths = [folder / "lidar.laz", folder / "footprints.gpkg"]
    for path in paths:
        content = resources.files("p2wss.cli").joinpath("assets", path.name).read_bytes()
        files.write_bytes(path, content)
    return paths
