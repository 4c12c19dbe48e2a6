"""What the commands share: options, configs, threads and what they log."""

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

DEVICES = ("auto", "cpu", "cuda")
Command = Callable[[argparse.Namespace], None]
Parsers = argparse._SubParsersAction
log = logging.getLogger("p2wss")


def add_group(stages: Parsers, name: str, about: str) -> Parsers:
    parser = stages.add_parser(name, help=about, description=about)
    return parser.add_subparsers(required=True, metavar="PART")


def add_command(group: Parsers, name: str, run: Command, about: str) -> argparse.ArgumentParser:
    parser = group.add_parser(name, help=about, description=about)
    parser.add_argument(
        "--config", default="{}", help="a YAML file, or sections as JSON; default: the built-in values"
    )
    parser.set_defaults(run=run)
    return parser


def add_training(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--checkpoints", type=Path, required=True, help="folder to resume from; kept until the end"
    )
    command.add_argument("--threads", type=int, default=1)
    command.add_argument("--device", choices=DEVICES, help="default: compute.device of the config")


def use_threads(num_threads: int) -> None:
    """Before torch is imported: on shared cores OpenMP threads that spin make small operations 40 times slower."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("GOMP_SPINCOUNT", "0")
    import torch

    torch.set_num_threads(num_threads)


def config_of(arguments: argparse.Namespace) -> Config:
    return load(arguments.config)


def bounds_of_tile(tile: str, config: Config, margin_m: float = 0.0) -> Bounds:
    try:
        return tile_bounds(tile, config.region.tile_size_m, margin_m)
    except ValueError as error:
        raise InputError(str(error)) from error


def log_counts(out: Path, status: Iterable[str]) -> None:
    """One line: how many rows are ok, and how many are not for which reason."""
    counts = Counter(map(str, status))
    num_ok = counts.pop("ok", 0)
    reasons = ", ".join(f"{count} {reason}" for reason, count in counts.most_common()) or "none"
    log.info(f"{out.name}: {num_ok} buildings kept, {sum(counts.values())} rejected ({reasons})")


def config_on_device(arguments: argparse.Namespace, stage: str) -> Config:
    """The config with the device of ``--device`` for the training of ``stage``."""
    device = {} if arguments.device is None else {stage: {"compute": {"device": arguments.device}}}
    return load(arguments.config, device)
