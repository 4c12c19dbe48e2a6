"""``p2wss model``: train Point2WSS."""

from functools import partial
from pathlib import Path

import click

from p2wss.cli import common
from p2wss.cli.parser import Command, file_option, setting
from p2wss.config import Config
from p2wss.nets.threads import set_num_threads
from p2wss.storage.provenance import fingerprint


@click.command(cls=Command)
@common.manifest_option
@file_option("--dvae", "weights written by p2wss dvae")
@common.weights_option
@common.out_metrics_option
@common.checkpoints_option
@common.threads_option
@setting("model.compute.device")
@common.config_option
def model(
    manifest: Path, dvae: Path, out: Path, out_metrics: Path, checkpoints: Path, threads: int, config: Config
) -> None:
    """Train Point2WSS."""
    set_num_threads(threads)
    from p2wss.nets.weights import save_model
    from p2wss.training import model
    from p2wss.training.loop import training_lock

    code = fingerprint("training.model")
    with training_lock(checkpoints):
        module = model.train(manifest, dvae, config.model, checkpoints, code)
        save = partial(save_model, module, out, code)
        extendable = config.model.optimiser.ramp_steps > 0
        common.write_trained(checkpoints, out_metrics, save, extendable)
