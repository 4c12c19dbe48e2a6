"""``p2wss model``: train Point2WSS."""

from __future__ import annotations

import argparse
from pathlib import Path

from p2wss.cli.common import Parsers, add_command, add_training, read_training_config, set_num_threads
from p2wss.data import files
from p2wss.provenance import fingerprint


def add_parser(stages: Parsers) -> None:
    """Add ``p2wss model`` to the parser."""
    command = add_command(stages, "model", model, "train Point2WSS")
    command.add_argument("--manifest", type=Path, required=True, help="JSON written by p2wss crops manifest")
    command.add_argument("--dvae", type=Path, required=True, help="weights written by p2wss dvae")
    command.add_argument("--out", type=Path, required=True, help="safetensors file to write: the weights")
    command.add_argument(
        "--out-metrics", type=Path, required=True, help="JSON lines to write: losses during training"
    )
    add_training(command)


def model(arguments: argparse.Namespace) -> None:
    """Train, then write the weights and the metrics."""
    set_num_threads(arguments.threads)
    from p2wss import model
    from p2wss.nets import distributed
    from p2wss.nets.metrics_log import read_metrics
    from p2wss.nets.training_state import remove_checkpoints
    from p2wss.nets.weights import save_model

    config, code = read_training_config(arguments, "model").model, fingerprint("model")
    module, dvae_config = model.train(arguments.manifest, arguments.dvae, config, arguments.checkpoints, code)
    if not distributed.is_main_process():
        return
    metrics = read_metrics(arguments.checkpoints)
    files.write_text(arguments.out_metrics, metrics)
    save_model(module, arguments.out, config, dvae_config, code, metrics)
    remove_checkpoints(arguments.checkpoints)
