"""Shared by the commands: options, configs, threads and log lines."""

from __future__ import annotations

import argparse
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from p2wss.config import Config, load
from p2wss.data.tiling import Bounds, tile_bounds
from p2wss.errors import InputError
from p2wss.storage import files, integrity

DEVICES = ("auto", "cpu", "cuda")
Command = Callable[[argparse.Namespace], None]
Parsers = argparse._SubParsersAction
log = logging.getLogger("p2wss")


def add_group(parsers: Parsers, name: str, description: str) -> Parsers:
    """Add a command that consists of parts, ``p2wss NAME PART``; returns where its parts are added."""
    parser = parsers.add_parser(name, help=description, description=_sentence(description))
    return parser.add_subparsers(required=True, metavar="PART", title="parts")


def add_command(parsers: Parsers, name: str, run: Command, description: str) -> argparse.ArgumentParser:
    """Add a command that calls ``run`` with the parsed arguments; it has the option ``--config``."""
    parser = parsers.add_parser(name, help=description, description=_sentence(description))
    parser.add_argument(
        "--config",
        default="{}",
        help="YAML file, or sections as JSON, that override the built-in settings (config/default.yaml)",
    )
    parser.set_defaults(run=run)
    return parser


def add_place(command: argparse.ArgumentParser) -> None:
    """Add ``--place``, see :mod:`p2wss.config.places`."""
    command.add_argument(
        "--place",
        default="",
        help="member and draw of the tile in a data set of several regions, such as paris/2/",
    )


def add_tile(command: argparse.ArgumentParser) -> None:
    """Add the option ``--tile``."""
    command.add_argument(
        "--tile",
        required=True,
        help="name of the tile: its north-west corner in kilometres, such as 0652_6862",
    )


def add_threads(command: argparse.ArgumentParser) -> None:
    """Add the option ``--threads``."""
    command.add_argument(
        "--threads", type=_positive, default=1, metavar="N", help="number of CPU threads (default: 1)"
    )


def add_device(command: argparse.ArgumentParser) -> None:
    """Add the option ``--device`` for inference."""
    command.add_argument(
        "--device",
        choices=DEVICES,
        default="auto",
        help="where the network runs (default: a GPU if there is one)",
    )


def add_training(command: argparse.ArgumentParser) -> None:
    """Add the options of a training run."""
    command.add_argument("--manifest", type=Path, required=True, help="JSON written by p2wss crops manifest")
    command.add_argument("--out", type=Path, required=True, help="safetensors file to write: the weights")
    command.add_argument(
        "--out-metrics", type=Path, required=True, help="JSON lines to write: losses during training"
    )
    command.add_argument(
        "--checkpoints",
        type=Path,
        required=True,
        help="folder for checkpoints; an interrupted training resumes from it, a finished one deletes it",
    )
    add_threads(command)
    command.add_argument(
        "--device",
        choices=DEVICES,
        help="where the networks are trained (default: compute.device of the config)",
    )


def set_num_threads(num_threads: int) -> None:
    """Limit torch to ``num_threads``. To be called before torch is imported elsewhere.

    On shared cores, OpenMP threads that spin while they wait make small operations 40 times slower.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("GOMP_SPINCOUNT", "0")
    import torch

    torch.set_num_threads(num_threads)


def read_config(arguments: argparse.Namespace) -> Config:
    """The config of ``--config``. Raises :class:`InputError` that names the key with an invalid value."""
    return load(arguments.config)


def read_training_config(arguments: argparse.Namespace, stage: str) -> Config:
    """The config of ``--config``, with the device of ``--device`` for the training of ``stage``."""
    device = {} if arguments.device is None else {stage: {"compute": {"device": arguments.device}}}
    return load(arguments.config, device)


def write_trained(arguments: argparse.Namespace, save: Callable[[str], None]) -> None:
    """At the end of a training: the metrics, the weights by ``save(metrics)``, and no checkpoints any more.

    Of several processes the first writes.
    """
    from p2wss.nets import distributed
    from p2wss.nets.metrics_log import read_metrics
    from p2wss.nets.training_state import remove_checkpoints

    if not distributed.is_main_process():
        return
    metrics = read_metrics(arguments.checkpoints)
    files.write_text(arguments.out_metrics, metrics + integrity.JSON_LINES_TRAILER)
    save(metrics)
    remove_checkpoints(arguments.checkpoints)


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


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text}: at least 1")
    return number


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."
