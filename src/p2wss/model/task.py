"""Stage model: train Point2WSS (paper, sections 4 and 5.2).

Heights are those of the eave above the ground as estimated from the cloud (``ground_z_m`` of the crops), because
inference has no other ground; labels, which refer to the terrain of the simulation, are converted.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from p2wss.config import Augmentation
from p2wss.config import Dvae as DvaeConfig
from p2wss.config import Model as ModelConfig
from p2wss.data.seeds import derive_seed
from p2wss.nets import augment, compute, distributed, training
from p2wss.nets.batch import NETWORK_SCALE, Batch, batch_patches
from p2wss.nets.builders import build_model, build_tokenizer, training_limits
from p2wss.nets.dataset import BatchSampler, BatchSource, BuildingDataset, ResidentDataset
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.masking import mask_parameters, mask_patches
from p2wss.nets.patch_cache import PatchSettings, precompute_patches
from p2wss.nets.point2wss import Point2Wss
from p2wss.nets.predictor import Predictor
from p2wss.nets.shards import describe, load_dataset
from p2wss.nets.training_state import cloud_cache_folder
from p2wss.nets.transformer import Encoder
from p2wss.nets.weights import load_dvae
from p2wss.storage import files

log = logging.getLogger("p2wss")


def train(
    manifest: Path, dvae: Path, config: ModelConfig, checkpoints: Path, code: str
) -> tuple[Point2Wss, DvaeConfig]:
    """Train on the train split of ``manifest`` with the weights of ``dvae``; see :mod:`training`.

    Returns the network with the weights to keep, and the config of the dvae. Raises :class:`InputError` for
    unusable input.
    """
    vae, dvae_config = load_dvae(dvae)
    tokenizer = build_tokenizer(config)
    limits = training_limits(config, dvae_config, tokenizer)
    device = compute.device_of(config.compute.device)
    with distributed.process_group(device):
        cache = cloud_cache_folder(checkpoints)
        training_set = load_dataset(manifest, ["train"], limits, True, False, cache)
        validation_set = load_dataset(manifest, ["val"], limits, True, False, cache)
        if preserves_patches(config.augmentation):
            settings = PatchSettings(dvae_config.num_points, dvae_config.num_patches, dvae_config.patch_size)
            training_set = precompute_patches(training_set, settings, device)
        log.info("model: train: %s", describe(training_set))
        log.info("model: val: %s", describe(validation_set))
        torch.manual_seed(derive_seed(config.seed, "model", "weights"))
        module = build_model(config, dvae_config, tokenizer)
        module.cloud.embed.load_state_dict(vae.encoder.state_dict())  # as in Point-BERT
        log.info("model: %d weights", sum(p.numel() for p in module.parameters()))
        module, vae = module.to(device), vae.to(device)
        task = ModelTask(module, vae, training_set, validation_set, config, dvae_config, device)
        plan = training.Plan(
            config.seed, config.optimiser, config.ema_decay, config.checkpoint_every_steps, config.compute
        )
        identity = {
            "stage": "model",
            "config": training.training_config(config),
            "code": code,
            "data": files.sha256(manifest),
            "dvae": files.sha256(dvae),
        }
        trained = training.train(task, plan, checkpoints, identity)
    assert isinstance(trained, Point2Wss)
    return trained, dvae_config


class ModelTask:
    """The stage as a :class:`p2wss.nets.training.Task`."""

    def __init__(
        self,
        module: Point2Wss,
        vae: DiscreteVae,
        training_set: BuildingDataset,
        validation_set: BuildingDataset,
        config: ModelConfig,
        dvae_config: DvaeConfig,
        device: torch.device,
    ) -> None:
        self.module = module
        self.vae = vae
        self.device = device
        self.training_set: BatchSource = training_set
        if config.compute.resident:
            self.training_set = ResidentDataset(training_set, device)
        self.validation_set = validation_set
        self.config = config
        self.dvae_config = dvae_config
        self.sampler = BatchSampler(training_set.num_vertices, config.optimiser.batch_size, config.seed)
        self.median_height = float(np.median(training_set.height_m))
        self.median_angle = float(np.median(training_set.angle_deg))

    def compilable_parts(self) -> Sequence[nn.Module]:
        return [*(part for part in self.module.modules() if isinstance(part, Encoder)), self.vae.to_logits]

    def step(self, step: int) -> dict[str, Tensor]:
        config = self.config
        seed = derive_seed(config.seed, "model", "points", step)
        index = distributed.shard(self.sampler.batch(step))
        batch = self.training_set.batch(index, self.dvae_config.num_points, seed).to(self.device)
        batch = augment_batch(batch, config.augmentation, self.dvae_config.min_points)
        tokenizer = self.module.tokenizer
        parameters, _ = tokenizer.canonical(
            tokenizer.quantise(batch.height, batch.xy, batch.angle, batch.num_vertices)
        )
        tokens = tokenizer.encode(parameters)
        masking = config.masking
        token_masked = mask_parameters(
            tokenizer.kinds(tokens.shape, batch.num_vertices),
            masking.inference_share,
            masking.table1_share,
            masking.random_ratio,
        )
        patches = batch_patches(batch, self.dvae_config.num_patches, self.dvae_config.patch_size)
        auxiliary = patches[: max(round(config.auxiliary_share * len(index)), 1)]
        patch_masked = mask_patches(auxiliary, masking.patch_ratio)
        with compute.autocast(config.compute, self.device):
            losses = self.module.losses(
                patches,
                batch.ground_z * NETWORK_SCALE,
                patch_masked,
                self.vae.tokens(auxiliary),
                tokens,
                token_masked,
                batch.num_vertices,
                config.match_balanced,
            )
        weights = config.loss_weights.model_dump()
        total = torch.stack([weights[name] * value for name, value in losses.items()]).sum()  # equation 5
        return {"loss": total, **{f"loss_{name}": value for name, value in losses.items()}}

    def validate(self, module: nn.Module) -> dict[str, float]:
        assert isinstance(module, Point2Wss)
        # one view is enough for the learning curve
        settings = self.config.decoding.model_copy(update={"num_rotations": 1})
        limits = training_limits(self.config, self.dvae_config, module.tokenizer)
        predictor = Predictor(module, settings, self.dvae_config, self.config.max_vertices, limits)
        index = np.arange(min(len(self.validation_set), self.config.num_validation))
        height, angle = predictor.errors(self.validation_set, index)
        label = self.validation_set.batch(index, 1, None)
        inside = torch.arange(label.angle.shape[1]) < label.num_vertices[:, None]
        constant_angle = (label.angle[inside] - self.median_angle).abs()
        return {
            "val_height_mae_m": float(np.abs(height).mean()),
            "val_height_mae_constant_m": float((label.height - self.median_height).abs().mean()),
            "val_angle_mae_deg": float(np.abs(angle).mean()),
            "val_angle_mae_constant_deg": float(constant_angle.mean()),
        }


def preserves_patches(settings: Augmentation) -> bool:
    """Whether the augmentation only rotates, mirrors and scales buildings: then patches keep their points."""
    changes_points = settings.occlusion_share or settings.lift_m or settings.jitter_m
    return settings.keep_points == (1, 1) and not changes_points


def augment_batch(batch: Batch, settings: Augmentation, min_points: int) -> Batch:
    """The random augmentations of the config, and the paper's rotation; the result is centred."""
    if settings.keep_points != (1, 1):
        batch = augment.drop_points_randomly(batch, settings.keep_points, min_points)
    if settings.occlusion_share > 0:
        batch = augment.occlude_randomly(batch, settings.occlusion_share, min_points)
    if settings.lift_m > 0:
        batch = augment.lift_randomly(batch, settings.lift_m)
    if settings.scale != (1, 1):
        batch = augment.scale_randomly(batch, settings.scale)
    if settings.mirror:
        batch = augment.mirror_randomly(batch)
    batch = augment.rotate_randomly(augment.centre(batch))
    return augment.jitter(batch, settings.jitter_m) if settings.jitter_m > 0 else batch
