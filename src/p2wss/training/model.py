"""Stage model: train Point2WSS (paper, sections 4 and 5.2).

Heights are eave heights above the ground as estimated from the cloud (``ground_z_m`` of the crops), because inference
has no other ground; labels, which refer to the terrain of the simulation, are converted.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from p2wss.config import Augmentation
from p2wss.config import Model as ModelConfig
from p2wss.config.training import Masking
from p2wss.data.seeds import derive_seed, generator
from p2wss.nets import compute, distributed
from p2wss.nets.batch import NETWORK_SCALE, Batch, batch_patches, centre
from p2wss.nets.discrete_vae import Dgcnn, DiscreteVae, MiniPointNet
from p2wss.nets.patches import Patches, squared_distance
from p2wss.nets.point2wss import Group, Point2Wss, Sequences, inference_weights
from p2wss.nets.predictor import Point2WssPredictor
from p2wss.nets.tokenizer import (
    KIND_ANGLE,
    KIND_COORDINATE,
    KIND_FRAME,
    KIND_HEIGHT,
    KIND_PAD,
    MASK,
    Quantised,
    Tokenizer,
)
from p2wss.nets.transformer import Block
from p2wss.nets.weights import load_dvae, load_model
from p2wss.storage import files
from p2wss.storage.messages import log
from p2wss.training import augment, loop
from p2wss.training.dataset import BatchSampler, BuildingDataset, describe, load_dataset, training_limits


def train(manifest: Path, dvae: Path, config: ModelConfig, checkpoints: Path, code: str) -> Point2Wss:
    """Train on the train split of ``manifest`` with the weights of ``dvae``; see :func:`loop.train`.

    Returns the network with the weights to keep. Raises :class:`InputError` for unusable input.
    """
    vae = load_dvae(dvae)
    limits = training_limits(config, vae.config)
    device = compute.device_of(config.compute.device)
    with distributed.process_group(device):
        checkpoints.mkdir(parents=True, exist_ok=True)
        training_set = load_dataset(manifest, ["train"], limits, labelled=True, folder=checkpoints)
        validation_set = load_dataset(manifest, ["val"], limits, labelled=True, folder=checkpoints)
        log.info("model: train: %s", describe(training_set))
        log.info("model: val: %s", describe(validation_set))
        torch.manual_seed(derive_seed(config.seed, "model", "weights"))
        module = Point2Wss(config, vae.config)
        if config.dvae_start:
            module.cloud.embed.load_state_dict(vae.encoder.state_dict())
        if config.start:
            module.load_state_dict(
                inference_weights(load_model(Path(config.start)).state_dict()), strict=False
            )
        log.info("model: %d weights", sum(p.numel() for p in module.parameters()))
        task = ModelTask(module.to(device), vae.to(device), training_set, validation_set)
        plan = loop.Plan(config.seed, config.optimiser, config.checkpoint_every_steps)
        identity = {
            "stage": "model",
            "config": loop.training_config(config),
            "data": files.sha256(manifest),
            "dvae": files.sha256(dvae),
            "start": files.sha256(Path(config.start)) if config.start else "",
        }
        trained = loop.train(task, plan, checkpoints, identity, code)
    assert isinstance(trained, Point2Wss)
    return trained


class ModelTask:
    """The stage as a :class:`p2wss.training.loop.Task`, on the device of ``module``."""

    def __init__(
        self,
        module: Point2Wss,
        vae: DiscreteVae,
        training_set: BuildingDataset,
        validation_set: BuildingDataset,
    ) -> None:
        self.module = module
        self.vae = vae
        self.config = config = module.config
        self.device = next(module.parameters()).device
        if config.compute.compile:
            for network in (module, vae):
                compute.compile_parts(network, (Block, MiniPointNet, Dgcnn))
        self.training_set = training_set
        self.validation_set = validation_set
        # with all lengths 0, any buildings count as similar
        lengths = training_set.num_vertices * config.similar_lengths
        self.sampler = BatchSampler(lengths, config.optimiser.batch_size, config.seed)
        self.median_height = float(np.median(training_set.height_m))
        self.median_angle = float(np.median(training_set.angle_deg))

    def load(self, step: int) -> tuple[Batch, list[Group]]:
        config, dvae_config = self.config, self.module.dvae_config
        seed = derive_seed(config.seed, "model", "points", step)
        whole = self.sampler.batch(step)
        # drawn for the whole batch, so that the processes do not repeat the same draws
        drawn = generator(seed).random(len(whole)) < config.augmentation.on_building_share
        index, on_building = distributed.shard(whole), distributed.shard(drawn)
        on_building &= self.training_set.num_on_building[index] >= dvae_config.min_points
        num_vertices = self.training_set.num_vertices[index]
        groups = []
        # with other shares the auxiliary losses use only the first rows, which must not always have few vertices
        if config.auxiliary_share in (0, 1):
            order = np.argsort(num_vertices, kind="stable")
            index, on_building, num_vertices = index[order], on_building[order], num_vertices[order]
            groups = length_groups(num_vertices, self.module.tokenizer)
        batch = self.training_set.batch(index, dvae_config.num_points, seed, on_building)
        return batch.staged(self.device), groups

    def step(self, step: int, loaded: tuple[Batch, list[Group]]) -> dict[str, Tensor]:
        config, dvae_config = self.config, self.module.dvae_config
        batch, groups = loaded
        tokenizer = self.module.tokenizer
        batch = augment_batch(
            batch.to(self.device), config.augmentation, dvae_config.min_points, tokenizer.reach_m
        )
        parameters, _ = tokenizer.canonical(
            tokenizer.quantise(batch.height, batch.xy, batch.angle, batch.num_vertices)
        )
        tokens = tokenizer.encode(parameters)
        given, wanted = mask_parameters(tokenizer, parameters, tokens, config.masking)
        patches = batch_patches(batch, dvae_config)
        auxiliary = patches[: math.ceil(config.auxiliary_share * len(tokens))]
        patch_masked = mask_patches(auxiliary, config.masking.patch_ratio)
        with compute.autocast(config.compute, self.device):
            losses = self.module.losses(
                patches,
                batch.ground_z * NETWORK_SCALE,
                patch_masked,
                self.vae.tokens(auxiliary) if len(patch_masked) else patch_masked,
                Sequences(tokens, given, wanted, batch.num_vertices),
                groups,
            )
        weights = config.loss_weights.model_dump()
        total = torch.stack([weights[name] * value for name, value in losses.items()]).sum()  # equation 5
        return {"loss": total, **{f"loss_{name}": value for name, value in losses.items()}}

    def validate(self, module: nn.Module) -> dict[str, float]:
        assert isinstance(module, Point2Wss)
        index = self.validation_set.sample(self.config.num_validation)
        # one view is enough for the learning curve
        predictor = Point2WssPredictor(module, num_views=1)
        height, angle = prediction_errors(predictor, self.validation_set, index)
        label_deg = np.concatenate([self.validation_set.edge_angles_deg(i) for i in index])
        label_m = self.validation_set.height_m[index]
        return {
            "val_height_mae_m": float(np.abs(height).mean()),
            "val_height_mae_constant_m": float(np.abs(label_m - self.median_height).mean()),
            "val_angle_mae_deg": float(np.abs(angle).mean()),
            "val_angle_mae_constant_deg": float(np.abs(label_deg - self.median_angle).mean()),
        }


def prediction_errors(
    predictor: Point2WssPredictor, dataset: BuildingDataset, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Signed errors of heights (n,) in m and of angles (edges,) in degrees, for the labelled buildings ``index`` with
    known footprints."""
    ground_m = [np.array([0, 0, dataset.ground_z_m[i]]) for i in index]
    # a network trained on the points on buildings gets these points, as in a reconstruction
    num_points = dataset.num_on_building * predictor.on_building
    num_points = np.where(num_points > 0, num_points, np.diff(dataset.point_offset))[index]
    clouds = [
        0.01 * dataset.cloud_cm(i)[:num] - ground
        for i, num, ground in zip(index, num_points, ground_m, strict=True)
    ]
    prediction = predictor.predict(clouds, [[dataset.ring_m(i)] for i in index])
    angle = [
        predicted - dataset.edge_angles_deg(i)
        for i, predicted in zip(index, prediction.angle_deg, strict=True)
    ]
    return prediction.eave_height_m - dataset.height_m[index], np.concatenate(angle)


def length_groups(num_vertices: np.ndarray, tokenizer: Tokenizer) -> list[Group]:
    """Groups of rows with ascending ``num_vertices`` (b,): up to 4, 8, 16 and so on, so that little is padding."""
    bucket = np.maximum(np.ceil(np.log2(num_vertices)), 2)
    start = np.flatnonzero(np.diff(bucket, prepend=0))
    stop = [*start[1:], len(bucket)]
    return [
        Group(slice(int(a), int(b)), tokenizer.length(int(num_vertices[b - 1])))
        for a, b in zip(start, stop, strict=True)
    ]


def augment_batch(batch: Batch, settings: Augmentation, min_points: int, reach_m: float) -> Batch:
    """The random augmentations of the config, and the paper's rotation; the result is centred.

    A building is only rotated and jittered if it would have a vertex farther than ``reach_m`` from the centroid, for
    instance because the remaining points are at one of its ends.
    """
    plain = centre(batch)
    if settings.keep_points != (1, 1):
        batch = augment.drop_points_randomly(batch, settings.keep_points, min_points)
    if settings.occlusion_share > 0:
        batch = augment.occlude_randomly(batch, settings.occlusion_share, min_points)
    if settings.lift_m > 0:
        batch = augment.lift_randomly(batch, settings.lift_m)
    if settings.scale != (1, 1):
        batch = augment.scale_randomly(batch, settings.scale)
    batch = centre(batch)
    is_far = batch.xy.norm(dim=-1).amax(1) > reach_m
    batch = augment.rotate_randomly(batch.replaced_by(plain, is_far))
    return augment.jitter(batch, settings.jitter_m) if settings.jitter_m > 0 else batch


def mask_patches(patches: Patches, ratio: tuple[float, float]) -> Tensor:
    """bool (b, g): a random valid patch and its nearest neighbours, a share of the patches drawn from ``ratio``
    (Point-BERT)."""
    valid = patches.valid
    batch = len(valid)
    device = valid.device
    seed = torch.rand(valid.shape, device=device).masked_fill(~valid, -1).argmax(1)
    centre = patches.centre[torch.arange(batch, device=device), seed]
    distance = squared_distance(centre[:, None], patches.centre)[:, 0].masked_fill(~valid, torch.inf)
    rank = distance.argsort(1).argsort(1)
    share = ratio[0] + (ratio[1] - ratio[0]) * torch.rand(batch, device=device)
    count = (share * valid.sum(1)).long().clamp(min=1)
    return (rank < count[:, None]) & valid


def mask_parameters(
    tokenizer: Tokenizer, parameters: Quantised, tokens: Tensor, settings: Masking
) -> tuple[Tensor, Tensor]:
    """(what the network reads in place of ``tokens``, int64 (b, l); which tokens it has to predict, bool (b, l)).

    tokens: (b, l), of canonical ``parameters``. Each sample has one of four patterns, drawn with the given shares.
    Inference pattern: all digits of height and angles are masked. Table-1 pattern: all digits. Disturbed pattern: all
    digits are to be predicted, but the coordinates are misplaced instead of masked, with their true signs. Random
    pattern, for the remaining share: each token but [start] and [end] with a probability drawn per sample from
    ``random_ratio``. The paper's masking has shares of 0 and a ratio of (0.3, 0.3).
    """
    kind = tokenizer.kinds(tokens.shape, parameters.num_vertices)
    shares = torch.tensor([settings.inference_share, settings.table1_share, settings.disturbed_share])
    shares = shares.cumsum(0).to(kind.device, non_blocking=True)
    pattern = torch.searchsorted(shares, torch.rand(len(kind), 1, device=kind.device), right=True)
    low, high = settings.random_ratio
    ratio = low + (high - low) * torch.rand(len(kind), 1, device=kind.device)
    random = torch.rand(kind.shape, device=kind.device) < ratio
    random &= (kind != KIND_PAD) & (kind != KIND_FRAME)
    is_coordinate = (kind == KIND_COORDINATE) & (pattern > 0)
    targets = (kind == KIND_HEIGHT) | (kind == KIND_ANGLE) | is_coordinate
    wanted = torch.where(pattern < len(shares), targets, random)
    given = tokens.masked_fill(wanted, MASK)
    if settings.disturbed_share:
        misplaced = tokenizer.encode(disturb(parameters, tokenizer, settings.disturbance_m))
        given = torch.where((pattern == 2) & is_coordinate, misplaced, given)
    return given, wanted


def disturb(parameters: Quantised, tokenizer: Tokenizer, largest_m: float) -> Quantised:
    """The parameters with Gaussian noise on the sizes of all coordinates, whose signs stay. The standard deviation of
    each sample is drawn from 0 to ``largest_m``."""
    xy = parameters.xy
    sigma = largest_m * 10**tokenizer.coord_decimals * torch.rand(len(xy), 1, 1, device=xy.device)
    noise = torch.round(sigma * torch.randn(xy.shape, device=xy.device)).long()
    size = (xy.abs() + noise).clamp(1, tokenizer.max_coord)
    return replace(parameters, xy=torch.where(xy < 0, -size, size))
