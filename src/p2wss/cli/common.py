"""Shared by the commands: options, threads and log lines."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import click

from p2wss.cli.parser import PATH, file_option, option, setting
from p2wss.config import Config
from p2wss.data.tiling import Bounds, tile_bounds
from p2wss.storage import files, integrity
from p2wss.storage.errors import InputError, reading

log = logging.getLogger("p2wss")

config_option = option(
    "--config",
    multiple=True,
    metavar="FILE|JSON",
    help="YAML file, or sections as JSON, over the defaults (p2wss config); may be repeated, later ones win",
)
place_option = option(
    "--place",
    default="",
    help="member and draw of the tile in a data set of several regions, such as paris/2/",
)
tile_option = option(
    "--tile", required=True, help="name of the tile: its north-west corner in kilometres, such as 0652_6862"
)
threads_option = option(
    "--threads",
    type=click.IntRange(min=1),
    default=1,
    metavar="N",
    show_default=True,
    help="number of CPU threads",
)
device_option = option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda"]),
    default="auto",
    more=True,
    help="where the network runs; auto: on a GPU if there is one",
)
crs_option = option("--crs", help="CRS of clouds that do not state it, such as EPSG:28992")
clouds_argument = click.argument(
    "clouds",
    type=PATH,
    nargs=-1,
    required=True,
    metavar="CLOUD ..",
    help="LAS, LAZ or COPC files, or folders of them",
)
classes_option = setting("region.classes.preset", "--classes")
manifest_option = file_option("--manifest", "JSON written by p2wss crops manifest")
out_metrics_option = file_option("--out-metrics", "JSON lines to write: losses during training")
weights_option = file_option("--out", "safetensors file to write: the weights")
checkpoints_option = file_option(
    "--checkpoints",
    "folder for checkpoints; an interrupted training resumes from it, a finished one deletes it",
)


def write_trained(checkpoints: Path, out_metrics: Path, save: Callable[[str], None]) -> None:
    """At the end of a training: the metrics, the weights by ``save(metrics)``, and no checkpoints any more.

    Of several processes the first writes.
    """
    from p2wss.nets import distributed
    from p2wss.training.state import METRICS_NAME, remove_checkpoints

    if not distributed.is_main_process():
        return
    path = checkpoints / METRICS_NAME
    with reading(path, "readable metrics; delete it"):
        metrics = path.read_text(encoding="utf-8")
    files.write_text(out_metrics, metrics + integrity.JSON_LINES_TRAILER)
    save(metrics)
    remove_checkpoints(checkpoints)


def bounds_of_tile(tile: str, config: Config, margin_m: float = 0.0) -> Bounds:
    """Bounds of a tile and its margin, metres. Raises :class:`InputError` if ``tile`` is not a tile name."""
    try:
        return tile_bounds(tile, config.region.tile_size_m, margin_m)
    except ValueError as error:
        raise InputError(str(error)) from error


def log_status_counts(out: Path, status: Iterable[str]) -> None:
    """Log one line: the number of buildings with status ok, and the number of others per reason."""
    counts = Counter(map(str, status))
    num_ok = counts.pop("ok", 0)
    reasons = ", ".join(f"{count} {reason}" for reason, count in counts.most_common()) or "none"
    log.info(f"{out.name}: {num_ok} buildings ok, {counts.total()} excluded ({reasons})")
