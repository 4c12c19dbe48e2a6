"""``p2wss dvae``: train the discrete VAE that tokenises point patches."""

from __future__ import annotations

import argparse

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
    """Add ``p2wss dvae`` to the parser."""
    command = add_command(stages, "dvae", dvae, "train the discrete VAE that tokenises point patches")
    add_training(command)


def dvae(arguments: argparse.Namespace) -> None:
    """Train, then write the weights and the metrics."""
    set_num_threads(arguments.threads)
    from p2wss import dvae
    from p2wss.nets.training_lock import training_lock
    from p2wss.nets.weights import save_dvae

    config, code = read_training_config(arguments, "dvae").dvae, fingerprint("dvae")
    with training_lock(arguments.checkpoints):
        module = dvae.train(arguments.manifest, config, arguments.checkpoints, code)
        write_trained(arguments, lambda metrics: save_dvae(module, arguments.out, config, code, metrics))
