"""``p2wss dvae``: train the discrete VAE that tokenises point patches."""

from functools import partial
from pathlib import Path

import click

from p2wss.cli import common
from p2wss.cli.parser import Command, setting
from p2wss.config import Config
from p2wss.nets.threads import set_num_threads
from p2wss.storage.provenance import fingerprint


@click.command(cls=Command)
@common.manifest_option
@common.weights_option
@common.out_metrics_option
@common.checkpoints_option
@common.threads_option
@setting("dvae.compute.device")
@common.config_option
def dvae(
    manifest: Path, out: Path, out_metrics: Path, checkpoints: Path, threads: int, config: Config
) -> None:
    """Train the discrete VAE that tokenises point patches."""
    set_num_threads(threads)
    from p2wss.nets.weights import save_dvae
    from p2wss.training import dvae
    from p2wss.training.loop import training_lock

    code = fingerprint("training.dvae")
    with training_lock(checkpoints):
        module = dvae.train(manifest, config.dvae, checkpoints, code)
        common.write_trained(checkpoints, out_metrics, partial(save_dvae, module, out, code))
