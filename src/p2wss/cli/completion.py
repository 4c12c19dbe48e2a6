"""``p2wss completion``: train the network that completes roofs of few points."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from p2wss.cli import common
from p2wss.cli.parser import Command, option
from p2wss.config import DeviceName
from p2wss.nets.threads import set_num_threads
from p2wss.storage.provenance import fingerprint


@click.command(cls=Command)
@common.weights_option
@common.out_metrics_option
@common.checkpoints_option
@common.threads_option
@option(
    "--num-steps", type=click.IntRange(min=1), default=13_000, show_default=True, help="batches to train on"
)
@option(
    "--batch-size", type=click.IntRange(min=2), default=1024, show_default=True, help="buildings of a batch"
)
@option(
    "--compile",
    "is_compiled",
    is_flag=True,
    more=True,
    help="compile the network at first: faster steps on a GPU",
)
@common.device_option
def completion(
    out: Path,
    out_metrics: Path,
    checkpoints: Path,
    threads: int,
    num_steps: int,
    batch_size: int,
    is_compiled: bool,
    device: DeviceName,
) -> None:
    """Train the network that completes roofs of few points, on towns that it draws."""
    set_num_threads(threads)
    from p2wss.config.training import Optimiser
    from p2wss.training import completion
    from p2wss.training.lock import training_lock

    code = fingerprint("training.completion")
    ramp_steps = min(num_steps // 2, 5000)
    optimiser = Optimiser(
        num_steps=num_steps,
        batch_size=batch_size,
        learning_rate=1e-3,
        ramp_steps=ramp_steps,
        weight_decay=0.02,
    )
    with training_lock(checkpoints):
        module = completion.train(
            optimiser, device, checkpoints, code, num_processes=threads, is_compiled=is_compiled
        )
        common.write_trained(checkpoints, out_metrics, partial(completion.save_completion, module, out, code))
