"""The file of a trained discrete VAE."""

from __future__ import annotations

from pathlib import Path

from p2wss.config import Dvae as DvaeConfig
from p2wss.data import files
from p2wss.nets import training
from p2wss.nets.discrete_vae import DiscreteVae, DvaeSizes
from p2wss.nets.weights import of_this_version, read_weights, write_weights


def dvae_sizes(config: DvaeConfig) -> DvaeSizes:
    return DvaeSizes(
        num_patches=config.num_patches,
        patch_size=config.patch_size,
        patch_dim=config.patch_dim,
        token_dim=config.token_dim,
        num_tokens=config.num_tokens,
    )


def save_dvae(module: DiscreteVae, path: Path, config: DvaeConfig, code: str, metrics: str) -> None:
    """Write weights with metadata (config, code, last measures) as safetensors, whole or not at all."""
    facts = files.provenance(
        kind="dvae",
        config=config.model_dump(mode="json"),
        code=code,
        measures=training.last_measures(metrics),
    )
    write_weights(path, module.state_dict(), facts)


def load_dvae(path: Path) -> tuple[DiscreteVae, DvaeConfig]:
    """The trained tokenizer, frozen, and its config. Raises :class:`InputError` for any other file."""
    state, facts = read_weights(path, "dvae")
    with of_this_version(path, facts):
        config = DvaeConfig.model_validate(facts["config"])
        module = DiscreteVae(dvae_sizes(config))
        module.load_state_dict(state)
    return module.eval().requires_grad_(False), config
