"""``p2wss model``: train Point2WSS."""

from __future__ import annotations

import argparse
from pathlib import Path

from p2wss.cli.common import (
    Parsers,
    add_command,
    add_training,
    read_training_config,
    set_num_threads,
    write_trained,
)
from p2wss.provenance import fingerprint


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss model`` to the parser."""
    command = add_command(stages, "model", model, "train Point2WSS")
    command.add_argument("--dvae", type=Path, required=True, help="weights written by p2wss dvae")
    add_training(command)


def model(arguments: argparse.Namespace) -> None:
    """Train, then write the weights and the metrics."""
    set_num_threads(arguments.threads)
    from p2wss import model
    from p2wss.nets.training_lock import training_lock
    from p2wss.nets.weights import save_model

    config, code = read_training_config(arguments, "model").model, fingerprint("model")
    with training_lock(arguments.checkpoints):
        module, dvae_config = model.train(
            arguments.manifest, arguments.dvae, config, arguments.checkpoints, code
        )
        write_trained(
            arguments, lambda metrics: save_model(module, arguments.out, config, dvae_config, code, metrics)
        )
