"""Stage dvae: train the discrete VAE that turns patches of points into tokens (paper, section 4.2)."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from p2wss.config import Dvae as DvaeConfig
from p2wss.data.seeds import derive_seed
from p2wss.nets import compute, distributed
from p2wss.nets.batch import NETWORK_SCALE, Batch, batch_patches, centre
from p2wss.nets.discrete_vae import DiscreteVae, kl_weight, temperature
from p2wss.storage import files
from p2wss.storage.messages import InputError, log
from p2wss.training import augment, loop
from p2wss.training.dataset import BatchSampler, BuildingDataset, TrainingLimits, describe, load_dataset

# with a smaller share of its codes in use a tokenizer carries no information
MIN_CODE_USAGE = 0.05
# share of the training after which temperature and KL weight have their final values
WARM_UP_SHARE = 0.55


def train(manifest: Path, config: DvaeConfig, checkpoints: Path, code: str) -> DiscreteVae:
    """Train on the train split of ``manifest``, and on real LiDAR if the config says so; see :func:`loop.train`.

    ``code`` is the fingerprint of this stage. Raises :class:`InputError` if no building can be trained on or the
    codebook collapses.
    """
    device = compute.device_of(config.compute.device)
    limits = TrainingLimits(config.min_points, max_vertices=0, max_length_m=0)
    with distributed.process_group(device):
        checkpoints.mkdir(parents=True, exist_ok=True)
        training_set = load_dataset(manifest, ["train"], limits, False, config.use_lidar, checkpoints)
        log.info("dvae: train: %s", describe(training_set))
        validation_set = load_dataset(manifest, ["val"], limits, labelled=False, folder=checkpoints)
        torch.manual_seed(derive_seed(config.seed, "dvae", "weights"))
        task = DvaeTask(DiscreteVae(config).to(device), training_set, validation_set)
        plan = loop.Plan(config.seed, config.optimiser, config.checkpoint_every_steps)
        identity = {
            "stage": "dvae",
            "config": loop.training_config(config),
            "num_steps": config.optimiser.num_steps,  # temperature and KL weight follow the elapsed share
            "data": files.sha256(manifest),
        }
        loop.train(task, plan, checkpoints, identity, code)
        task.check_usage()
    return task.module


class DvaeTask:
    """The stage as a :class:`p2wss.training.loop.Task`, on the device of ``module``."""

    def __init__(
        self, module: DiscreteVae, training_set: BuildingDataset, validation_set: BuildingDataset
    ) -> None:
        self.module = module
        self.config = config = module.config
        self.training_set = training_set
        self.validation_set = validation_set
        self.device = next(module.parameters()).device
        if config.compute.compile:
            compute.compile_parts(module, (DiscreteVae,))
        self.num_dead_codes = 0
        self.progress = 0.0
        self.sampler = BatchSampler(np.zeros(len(training_set)), config.optimiser.batch_size, config.seed)

    def load(self, step: int) -> Batch:
        seed = derive_seed(self.config.seed, "dvae", "points", step)
        index = distributed.shard(self.sampler.batch(step))
        return self.training_set.batch(index, self.config.num_points, seed).staged(self.device)

    def step(self, step: int, loaded: Batch) -> dict[str, Tensor]:
        config = self.config
        batch = augment.rotate_randomly(centre(loaded.to(self.device)))
        progress = self.progress = step / config.optimiser.num_steps
        tau = temperature(progress, config.temperature_end)
        patches = batch_patches(batch, config)
        with compute.autocast(config.compute, self.device):
            losses = self.module(patches, torch.full((), tau, device=self.device))
        weight = kl_weight(progress, config.kl_weight)
        # on a GPU, bincount would wait for the codes
        codes, is_valid = losses.pop("codes").flatten(), patches.valid.flatten().long()
        code_count = is_valid.new_zeros(config.num_tokens).index_add_(0, codes, is_valid)
        return {
            "loss": losses["coarse"] + losses["fine"] + weight * losses["kl"],
            **losses,
            "temperature": torch.tensor(tau),
            "kl_weight": torch.tensor(weight),
            "perplexity": _perplexity(code_count),
        }

    def validate(self, module: nn.Module) -> dict[str, float]:
        assert isinstance(module, DiscreteVae)
        config = self.config
        chamfer = 0.0
        code_count = torch.zeros(config.num_tokens, dtype=torch.int64, device=self.device)
        size = config.optimiser.batch_size
        chosen = self.validation_set.sample(config.num_validation)
        for first in range(0, len(chosen), size):
            index = chosen[first : first + size]
            batch = centre(self.validation_set.batch(index, config.num_points, None).to(self.device))
            patches = batch_patches(batch, config)
            losses = module(patches, torch.full((), config.temperature_end, device=self.device))
            chamfer += float(losses["fine"]) * len(index)
            codes = losses["codes"][patches.valid]
            code_count += torch.bincount(codes, minlength=config.num_tokens)
        self.num_dead_codes = int((code_count == 0).sum())
        if self.progress > WARM_UP_SHARE:
            self.check_usage()
        return {
            # Chamfer-L1 of the reconstructed patches
            "val_chamfer_m": chamfer / len(chosen) / NETWORK_SCALE,
            "val_code_usage": 1 - self.num_dead_codes / config.num_tokens,
            "val_perplexity": float(_perplexity(code_count)),
            "val_dead_codes": float(self.num_dead_codes),
        }

    def check_usage(self) -> None:
        """Raise :class:`InputError` if hardly any codes were in use at the last validation."""
        num_tokens = self.config.num_tokens
        num_used = num_tokens - self.num_dead_codes
        if num_used < max(MIN_CODE_USAGE * num_tokens, 2):
            raise InputError(
                f"dvae: the codebook collapsed: {num_used} of {num_tokens} codes in use; "
                "raise dvae.kl_weight or lower dvae.optimiser.learning_rate"
            )


def _perplexity(count: Tensor) -> Tensor:
    """exp(entropy) of the codes: the number of equally frequent codes with the same entropy."""
    share = count / count.sum()
    return (-(share * share.clamp_min(1e-12).log()).sum()).exp()
