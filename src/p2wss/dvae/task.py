"""Stage dvae: train the discrete VAE that turns patches of points into tokens (paper, section 4.2)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from p2wss.config import Dvae as DvaeConfig
from p2wss.data import files
from p2wss.data.seeds import derive_seed
from p2wss.errors import InputError
from p2wss.nets import augment, compute, distributed, training
from p2wss.nets.batch import NETWORK_SCALE, batch_patches
from p2wss.nets.builders import build_dvae
from p2wss.nets.dataset import BatchSampler, BatchSource, ResidentDataset, TrainingLimits
from p2wss.nets.discrete_vae import DiscreteVae, kl_weight, temperature
from p2wss.nets.patch_cache import PatchSettings, precompute_patches
from p2wss.nets.shards import describe, load_dataset
from p2wss.nets.training_state import cloud_cache_folder

log = logging.getLogger("p2wss")
# with a smaller share of its codes in use a tokenizer says nothing
MIN_CODE_USAGE = 0.05
# temperature and weight of the divergence have reached their last values
WARM_SHARE = 0.55


def train(manifest: Path, config: DvaeConfig, checkpoints: Path, code: str) -> DiscreteVae:
    """Train on the train split of ``manifest`` (and real LiDAR, if so configured); see :mod:`training`.

    ``code`` is the fingerprint of this stage. Raises :class:`InputError` if nothing can be trained on or the
    codebook collapses.
    """
    device = compute.device_of(config.compute.device)
    limits = TrainingLimits(config.min_points, max_vertices=0, max_length_m=0)
    with distributed.process_group(device):
        cache = cloud_cache_folder(checkpoints)
        buildings = load_dataset(manifest, ["train"], limits, False, config.use_lidar, cache)
        cut = PatchSettings(config.num_points, config.num_patches, config.patch_size)
        buildings = precompute_patches(buildings, cut, device)
        log.info("dvae: train: %s", describe(buildings))
        held_out = load_dataset(manifest, ["val"], limits, False, False, cache)
        torch.manual_seed(derive_seed(config.seed, "dvae", "weights"))
        module = build_dvae(config).to(device)
        source = ResidentDataset(buildings, device) if config.compute.resident else buildings
        task = DvaeTask(module, source, held_out, config, device)
        plan = training.Plan(
            config.seed, config.optimiser, 0.0, config.checkpoint_every_steps, config.compute
        )
        identity = {
            "stage": "dvae",
            "config": training.training_config(config),
            "code": code,
            "data": files.sha256(manifest),
        }
        training.train(task, plan, checkpoints, identity)
        task.check_usage()
    return task.module


class DvaeTask:
    def __init__(
        self,
        module: DiscreteVae,
        buildings: BatchSource,
        held_out: BatchSource,
        config: DvaeConfig,
        device: torch.device,
    ) -> None:
        self.module = module
        self.config = config
        self.buildings = buildings
        self.held_out = held_out
        self.device = device
        self.num_dead_codes = 0
        self.progress = 0.0
        self.order = BatchSampler(np.zeros(len(buildings)), config.optimiser.batch_size, config.seed)

    def compilable_parts(self) -> Sequence[nn.Module]:
        return [self.module]

    def step(self, step: int) -> dict[str, Tensor]:
        config = self.config
        seed = derive_seed(config.seed, "dvae", "points", step)
        batch = self.buildings.batch(distributed.shard(self.order.batch(step)), config.num_points, seed)
        batch = augment.rotate_randomly(augment.centre(batch.to(self.device)))
        progress = self.progress = step / config.optimiser.num_steps
        tau = temperature(progress, config.temperature_end)
        patches = batch_patches(batch, config.num_patches, config.patch_size)
        with compute.autocast(config.compute, self.device):
            losses = self.module(patches, tau)
        weight = kl_weight(progress, config.kl_weight)
        used = torch.bincount(losses.pop("codes").flatten(), minlength=config.num_tokens)
        return {
            "loss": losses["coarse"] + losses["fine"] + weight * losses["kl"],
            **losses,
            "temperature": torch.tensor(tau),
            "kl_weight": torch.tensor(weight),
            "perplexity": _perplexity(used),
        }

    def validate(self, module: nn.Module) -> dict[str, float]:
        assert isinstance(module, DiscreteVae)
        config = self.config
        chamfer, count = 0.0, 0
        used = torch.zeros(config.num_tokens, dtype=torch.int64, device=self.device)
        size = config.optimiser.batch_size
        total = min(len(self.held_out), config.num_validation)
        for first in range(0, total, size):
            index = np.arange(first, min(first + size, total))
            batch = augment.centre(self.held_out.batch(index, config.num_points, None).to(self.device))
            patches = batch_patches(batch, config.num_patches, config.patch_size)
            losses = module(patches, config.temperature_end)
            chamfer += float(losses["fine"]) * len(index)
            codes = losses["codes"][patches.valid]
            used += torch.bincount(codes, minlength=config.num_tokens)
            count += len(index)
        self.num_dead_codes = int((used == 0).sum())
        if self.progress > WARM_SHARE:
            self.check_usage()
        return {
            # Chamfer-L1 of restored patches in metres
            "val_chamfer_m": chamfer / count / NETWORK_SCALE,
            "val_code_usage": 1 - self.num_dead_codes / config.num_tokens,
            "val_perplexity": float(_perplexity(used)),
            "val_dead_codes": float(self.num_dead_codes),
        }

    def check_usage(self) -> None:
        num_tokens = self.config.num_tokens
        used = num_tokens - self.num_dead_codes
        if used < max(MIN_CODE_USAGE * num_tokens, 2):
            raise InputError(
                f"dvae: the codebook collapsed: {used} of {num_tokens} codes in use; "
                "raise dvae.kl_weight or lower dvae.optimiser.learning_rate"
            )


def _perplexity(count: Tensor) -> Tensor:
    """exp(entropy) of the codes: how many are in use, evenly weighted."""
    share = count / count.sum()
    return (-(share * share.clamp_min(1e-12).log()).sum()).exp()
