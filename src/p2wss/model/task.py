"""Stage model: train Point2WSS (paper, sections 4 and 5.2), and use it.

A height is the gutter above the ground that the cloud itself shows (``ground_z_m`` of the crops), because
that is all an inference knows; the label is moved there from the terrain it was made on.
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
from p2wss.data import files
from p2wss.data.seeds import derive_seed
from p2wss.nets import augment, compute, parallel, training
from p2wss.nets.augment import Batch
from p2wss.nets.dataset import Buildings, Order, ResidentBuildings, Source
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.dvae_file import load_dvae
from p2wss.nets.masking import mask_parameters, mask_patches
from p2wss.nets.modules import limits_of, make_module, make_tokenizer
from p2wss.nets.network_patches import SCALE, patches_of
from p2wss.nets.point2wss import Point2Wss, inference_weights
from p2wss.nets.predictor import Predictor
from p2wss.nets.shards import Cut, describe, load_buildings, with_patches
from p2wss.nets.transformer import Encoder
from p2wss.nets.weights import write_weights

log = logging.getLogger("p2wss")


def train(
    manifest: Path, tokens: Path, config: ModelConfig, checkpoints: Path, code: str
) -> tuple[Point2Wss, DvaeConfig]:
    """Train on the train split of ``manifest`` with the trained dvae ``tokens``; see :mod:`training`.

    Returns the weights to keep and the dvae's config. Raises :class:`InputError` for unusable input.
    """
    vae, dvae_config = load_dvae(tokens)
    tokenizer = make_tokenizer(config)
    limits = limits_of(config, dvae_config, tokenizer)
    device = compute.device_of(config.compute.device)
    with parallel.processes(device):
        cache = training.cache_folder(checkpoints)
        buildings = load_buildings(manifest, ["train"], limits, True, False, cache)
        held_out = load_buildings(manifest, ["val"], limits, True, False, cache)
        if keeps_patches(config.augmentation):
            cut = Cut(dvae_config.num_points, dvae_config.num_patches, dvae_config.patch_size)
            buildings = with_patches(buildings, cut, device)
        log.info("model: train: %s", describe(buildings))
        log.info("model: val: %s", describe(held_out))
        torch.manual_seed(derive_seed(config.seed, "model", "weights"))
        module = make_module(config, dvae_config, tokenizer)
        module.cloud.embed.load_state_dict(vae.encoder.state_dict())  # as in Point-BERT
        log.info("model: %d weights", sum(p.numel() for p in module.parameters()))
        task = _Task(module.to(device), vae.to(device), buildings, held_out, config, dvae_config, device)
        plan = training.Plan(
            config.seed, config.optimiser, config.ema_decay, config.checkpoint_every_steps, config.compute
        )
        identity = {
            "stage": "model",
            "config": training.what_is_learnt(config),
            "code": code,
            "data": files.sha256(manifest),
            "dvae": files.sha256(tokens),
        }
        kept = training.train(task, plan, checkpoints, identity)
    assert isinstance(kept, Point2Wss)
    return kept, dvae_config


def save(
    module: Point2Wss, path: Path, config: ModelConfig, dvae_config: DvaeConfig, code: str, metrics: str
) -> None:
    """Write what inference needs, with the configs of both stages, as safetensors, whole or not at all."""
    tokenizer = module.tokenizer
    facts = files.provenance(
        kind="model",
        config=config.model_dump(mode="json"),
        dvae_config=dvae_config.model_dump(mode="json"),
        words=tokenizer.words,
        code=code,
        measures=training.last_measures(metrics),
    )
    write_weights(path, inference_weights(module.state_dict()), facts)


class _Task:
    """The second stage as :func:`training.train` sees it."""

    def __init__(
        self,
        module: Point2Wss,
        vae: DiscreteVae,
        buildings: Buildings,
        held_out: Buildings,
        config: ModelConfig,
        dvae_config: DvaeConfig,
        device: torch.device,
    ) -> None:
        self.module = module
        self.vae = vae
        self.device = device
        self.buildings: Source = buildings
        if config.compute.resident:
            self.buildings = ResidentBuildings(buildings, device)
        self.held_out = held_out
        self.config = config
        self.dvae_config = dvae_config
        self.order = Order(buildings.num_vertices, config.optimiser.batch_size, config.seed)
        self.constant_height = float(np.median(buildings.height_m))
        self.constant_angle = float(np.median(buildings.angle_deg))

    def heavy_parts(self) -> Sequence[nn.Module]:
        return [*(part for part in self.module.modules() if isinstance(part, Encoder)), self.vae.to_logits]

    def step(self, step: int) -> dict[str, Tensor]:
        config = self.config
        seed = derive_seed(config.seed, "model", "points", step)
        own = parallel.own(self.order.batch(step))
        batch = self.buildings.batch(own, self.dvae_config.num_points, seed).to(self.device)
        batch = augmented(batch, config, self.dvae_config.min_points)
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
        patches = patches_of(batch, self.dvae_config.num_patches, self.dvae_config.patch_size)
        auxiliary = patches[: max(round(config.auxiliary_share * len(own)), 1)]
        patch_masked = mask_patches(auxiliary, masking.patch_ratio)
        with compute.autocast(config.compute, self.device):
            losses = self.module.losses(
                patches,
                batch.ground_z * SCALE,
                patch_masked,
                self.vae.tokens(auxiliary),
                tokens,
                token_masked,
                batch.num_vertices,
                config.match_balanced,
            )
        weights = config.loss_weights.model_dump()
        total = torch.stack([weights[name] * value for name, value in losses.items()]).sum()  # (5)
        return {"loss": total, **{f"loss_{name}": value for name, value in losses.items()}}

    def validate(self, module: nn.Module) -> dict[str, float]:
        assert isinstance(module, Point2Wss)
        # one view: the learning curve needs no more
        decode = self.config.decoding.model_copy(update={"num_rotations": 1})
        limits = limits_of(self.config, self.dvae_config, module.tokenizer)
        predictor = Predictor(module, decode, self.dvae_config, self.config.max_vertices, limits)
        index = np.arange(min(len(self.held_out), self.config.num_validation))
        height, angle = predictor.errors(self.held_out, index)
        label = self.held_out.batch(index, 1, None)
        inside = torch.arange(label.angle.shape[1]) < label.num_vertices[:, None]
        constant_angle = (label.angle[inside] - self.constant_angle).abs()
        return {
            "val_height_mae_m": float(np.abs(height).mean()),
            "val_height_mae_constant_m": float((label.height - self.constant_height).abs().mean()),
            "val_angle_mae_deg": float(np.abs(angle).mean()),
            "val_angle_mae_constant_deg": float(constant_angle.mean()),
        }


def keeps_patches(change: Augmentation) -> bool:
    """Whether the same points make a patch however a building is changed: it is turned and scaled only."""
    return change.keep_points == (1, 1) and not (change.occlusion_share or change.lift_m or change.jitter_m)


def augmented(batch: Batch, config: ModelConfig, min_points: int) -> Batch:
    """The random changes of the config, the paper's rotation among them; the result is centred."""
    change = config.augmentation
    if change.keep_points != (1, 1):
        batch = augment.drop_points_randomly(batch, change.keep_points, min_points)
    if change.occlusion_share > 0:
        batch = augment.occlude_randomly(batch, change.occlusion_share, min_points)
    if change.lift_m > 0:
        batch = augment.lift_randomly(batch, change.lift_m)
    if change.scale != (1, 1):
        batch = augment.scale_randomly(batch, change.scale)
    if change.mirror:
        batch = augment.mirror_randomly(batch)
    batch = augment.rotate_randomly(augment.centre(batch))
    return augment.jitter(batch, change.jitter_m) if change.jitter_m > 0 else batch
