"""``p2wss demo``: a first run that needs no data."""

from __future__ import annotations

import time
from pathlib import Path

import click

from p2wss.cli.common import log, log_options, write_run
from p2wss.cli.parser import PATH, Command


@click.command(cls=Command)
@click.argument(
    "folder", type=PATH, default="p2wss-demo", metavar="[FOLDER]", help="folder to write (p2wss-demo)"
)
@log_options
def demo(folder: Path) -> int:
    """Draw a small town and its LiDAR, and reconstruct it."""
    import p2wss
    from p2wss.towns import write_demo

    num_buildings = write_demo(folder)
    cloud, footprints = folder / "lidar.laz", folder / "footprints.gpkg"
    log.info(
        "%s: %d drawn buildings, and LiDAR of them that is simulated; %s", cloud, num_buildings, footprints
    )
    start = time.monotonic()
    with p2wss.reconstruct(cloud, footprints) as scene:
        status = write_run(folder / "out", scene, start, ["cityjson", "glb", "gpkg", "report"])
    log.info("the same with files of your own: p2wss reconstruct %s %s %s", cloud, footprints, folder / "out")
    return status
