"""Speed of loading, of both training stages and of inference, against plain implementations in the same run.

    python benchmarks/training.py [--config config/models/cpu.yaml] [--num 4000] [--steps 3] [--batch N] [--compile]

All speeds are CPU time of one thread, on random clouds and footprints. Steps of p2wss and of the reference
alternate; the fastest step counts for the dvae, the mean for the model, whose batches differ. The reference does
what the paper and Point-BERT describe, operation by operation: point and patch features concatenated before the
layer, edge convolutions on gathered features with the graph recomputed each time, the distances of all pairs of
points in the loss, every sequence padded to the longest, all four losses on the whole batch. ``--batch`` sets the
batch size of both, in float32, for large networks on few cores, and skips inference. ``--compile`` compiles the
networks of p2wss (``compute.compile``), not those of the reference.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
import numpy as np
import torch
from figures import Figures, cpu_seconds, peak_mib
from torch import Tensor, nn
from torch.nn import functional as F

from p2wss.config import Config, load
from p2wss.config import Dvae as DvaeConfig
from p2wss.dvae import task as dvae_task
from p2wss.model import task as model_task
from p2wss.nets import dataset, discrete_vae, point2wss
from p2wss.nets.batch import batch_patches
from p2wss.nets.builders import build_dvae, build_model, build_tokenizer, training_limits
from p2wss.nets.dataset import BuildingDataset
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.patch_cache import PatchSettings, precompute_patches
from p2wss.nets.patches import Patches, squared_distance
from p2wss.nets.predictor import Predictor

# numbers of vertices of footprints and their shares, about as in the town of the miniature
NUM_VERTICES, SHARES = [4, 5, 6, 8, 10, 12, 16], [0.55, 0.06, 0.17, 0.12, 0.05, 0.03, 0.02]


def town(num: int, seed: int = 0) -> BuildingDataset:
    """Random clouds of 200 to 3,000 points, and regular polygons as footprints: of realistic size only."""
    rng = np.random.default_rng(seed)
    vertices = rng.choice(NUM_VERTICES, num, p=SHARES)
    count = np.clip(rng.lognormal(6.9, 0.5, num), 200, 3000).astype(np.int64)
    points = rng.uniform(-900, 900, (count.sum(), 3))
    points[:, 2] = np.abs(points[:, 2])
    corner = np.concatenate([np.arange(n) / n for n in vertices]) * 2 * np.pi
    return BuildingDataset(
        points_cm=points.astype(np.int16),
        point_offset=np.concatenate([[0], np.cumsum(count)]),
        ground_z_m=np.zeros(num, np.float32),
        xy_m=(9 * np.stack([np.cos(corner), np.sin(corner)], -1)).astype(np.float32),
        vertex_offset=np.concatenate([[0], np.cumsum(vertices)]),
        angle_deg=rng.choice([0, 30, 90], vertices.sum()).astype(np.float32),
        height_m=rng.uniform(3, 12, num).astype(np.float32),
        num_excluded={},
    )


# --- the reference ---


class PlainEdgeConvolution(discrete_vae.EdgeConvolution):
    """[neighbour - x; x] is built for every edge, multiplied and normalised before the maximum is taken."""

    def forward(self, x: Tensor, neighbour: Tensor, adjacency: Tensor) -> Tensor:
        rows = torch.arange(len(x))[:, None, None]
        centre = x[:, :, None].expand(-1, -1, neighbour.shape[-1], -1)
        edges = torch.cat([x[rows, neighbour] - centre, centre], -1).permute(0, 3, 1, 2)
        weight = torch.cat([self.difference.weight, self.self.weight], 1)
        y = F.conv2d(edges, weight[..., None, None])
        return F.leaky_relu(self.norm(y), 0.2).amax(-1).transpose(1, 2)


class PlainDgcnn(discrete_vae.Dgcnn):
    """The graph is recomputed before each convolution."""

    centre: Tensor

    def forward(self, x: Tensor, neighbour: Tensor) -> Tensor:
        x = self.first(x)
        outputs = []
        for convolution in self.convolutions:
            graph = torch.cdist(self.centre, self.centre).topk(neighbour.shape[-1], largest=False)[1]
            x = convolution(x, graph, graph)
            outputs.append(x)
        x = self.last(torch.cat(outputs, -1))
        return F.leaky_relu(self.norm(x.transpose(1, 2)).transpose(1, 2), 0.2)


class PlainPointNet(discrete_vae.MiniPointNet):
    """Every point is concatenated with the maximum over its patch."""

    def forward(self, points: Tensor) -> Tensor:
        batch, groups, k, _ = points.shape
        x = points.reshape(batch * groups, k, 3).transpose(1, 2)
        x = F.relu(self.first_norm(F.conv1d(x, self.first.weight[..., None], self.first.bias)))
        x = F.conv1d(x, self.second.weight[..., None], self.second.bias)
        x = torch.cat([x.amax(2, keepdim=True).expand(-1, -1, k), x], 1)
        weight = torch.cat([self.third_patch.weight, self.third_point.weight], 1)
        x = F.relu(self.third_norm(F.conv1d(x, weight[..., None], self.third_patch.bias)))
        x = F.conv1d(x, self.fourth.weight[..., None], self.fourth.bias)
        return x.amax(2).view(batch, groups, -1)

    def infer(self, points: Tensor) -> Tensor:
        return self.forward(points)


class PlainDecoder(discrete_vae.FoldingDecoder):
    """Every point of the fold is concatenated with the features of its patch."""

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        coarse = self.coarse(x).unflatten(-1, (self.num_coarse, 3))
        centre = coarse.repeat_interleave(4, 2)
        seeds = self.get_buffer("seeds").repeat(self.num_coarse, 1).expand(*x.shape[:2], -1, -1)
        joined = torch.cat([x[:, :, None].expand(-1, -1, centre.shape[2], -1), seeds, centre], -1)
        weight = torch.cat([self.from_feature.weight, self.from_point.weight], 1)
        h = F.relu(self.norm(F.linear(joined, weight, self.from_feature.bias).flatten(0, 2)))
        h = F.relu(self.middle_norm(self.middle(h)))
        return coarse, centre + self.last(h).view(centre.shape)


def plain_chamfer_l1(reconstruction: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """With gradients through the distances of all pairs."""
    distance = squared_distance(reconstruction, target)
    forth = distance.amin(-1).clamp_min(1e-12).sqrt().mean(-1)
    back = distance.amin(-2).clamp_min(1e-12).sqrt().mean(-1)
    return ((forth + back) * valid).sum() / (2 * valid.sum())


def plain(network: nn.Module) -> None:
    """Replace the classes of a network's parts by those of the reference; the weights stay."""
    for part in network.modules():
        for ours, theirs in (
            (discrete_vae.EdgeConvolution, PlainEdgeConvolution),
            (discrete_vae.Dgcnn, PlainDgcnn),
            (discrete_vae.MiniPointNet, PlainPointNet),
            (discrete_vae.FoldingDecoder, PlainDecoder),
        ):
            if type(part) is ours:
                part.__class__ = theirs


# --- measuring ---


@contextmanager
def unsorted_batches() -> Iterator[None]:
    """Batches without regard to numbers of vertices."""
    window, dataset._WINDOW_BATCHES = dataset._WINDOW_BATCHES, 1
    try:
        yield
    finally:
        dataset._WINDOW_BATCHES = window


def optimised(
    task: dvae_task.DvaeTask | model_task.ModelTask, compiled: bool = False
) -> Callable[[int], None]:
    """A step of training without the averaging of weights."""
    if compiled:
        for part in task.compilable_parts():
            part.compile()
    optimiser = torch.optim.AdamW(task.module.parameters(), foreach=True)

    def step(number: int) -> None:
        task.module.train()
        task.step(number)["loss"].backward()
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)

    return step


def alternating(
    ours: Callable[[int], None], theirs: Callable[[int], None], steps: int, compiled: bool
) -> tuple[np.ndarray, np.ndarray]:
    """CPU seconds (steps,) of both. They alternate, because the speed of the machine drifts."""
    # compiled networks are specialised for the length of the first batch, and general from the second on
    for number in range(9 if compiled else 1):
        ours(number)
    theirs(0)
    took = np.empty((2, steps))
    for number in range(steps):
        for row, step in zip(took, (ours, theirs), strict=True):
            start = time.process_time()
            step(100 + number)
            row[number] = time.process_time() - start
    return took[0], took[1]


@contextmanager
def plain_patches(vae: DiscreteVae) -> Iterator[None]:
    """The reference's loss, and the patch centres for the graphs of the reference."""

    def with_centres(*arguments: Any) -> Patches:
        patches = batch_patches(*arguments)
        for part in vae.modules():
            if isinstance(part, PlainDgcnn):
                part.centre = patches.centre
        return patches

    chamfer = discrete_vae.chamfer_l1
    dvae_task.batch_patches = model_task.batch_patches = with_centres
    discrete_vae.chamfer_l1 = plain_chamfer_l1
    try:
        yield
    finally:
        dvae_task.batch_patches = model_task.batch_patches = batch_patches
        discrete_vae.chamfer_l1 = chamfer


def with_patches(buildings: BuildingDataset, config: DvaeConfig) -> tuple[BuildingDataset, float, float]:
    """The buildings with precomputed patches, and CPU seconds per batch to compute patches and to fetch them."""
    settings = PatchSettings(config.num_points, config.num_patches, config.patch_size)
    precomputed = precompute_patches(buildings, settings, torch.device("cpu"))
    whole = np.flatnonzero(np.diff(buildings.point_offset) <= config.num_points)
    index = np.random.default_rng(0).choice(whole, config.optimiser.batch_size)
    batch = precomputed.batch(index, config.num_points, None)
    computed = cpu_seconds(
        lambda: batch_patches(replace(batch, patch_index=None), config.num_patches, config.patch_size)
    )
    fetched = cpu_seconds(lambda: batch_patches(batch, config.num_patches, config.patch_size))
    return precomputed, computed, fetched


def loading(buildings: BuildingDataset, config: Config, folder: Path) -> tuple[float, float]:
    """Clouds per second from a mapped file, and CPU seconds per batch of the model's stage."""
    path = folder / "points.i16"
    buildings.points_cm.tofile(path)
    mapped = np.memmap(path, np.int16, "r", shape=buildings.points_cm.shape).view(np.ndarray)
    source = BuildingDataset(**(vars(buildings) | {"points_cm": mapped}))
    size, order = 64, np.random.default_rng(0).permutation(len(buildings))
    batches = [order[first : first + size] for first in range(0, len(order) - size, size)]

    def epoch() -> None:
        for number, index in enumerate(batches):
            source.batch(index, config.dvae.num_points, number)

    took = cpu_seconds(epoch, 3)
    rate = size * len(batches) / took
    return rate, took / len(batches) * config.model.optimiser.batch_size / size


def inference(config: Config, num: int) -> dict[str, float]:
    """BuildingDataset per CPU second, one view, and the most memory that this process ever held."""
    buildings = town(num)
    module = build_model(config.model, config.dvae, build_tokenizer(config.model))
    decode = config.model.decoding.model_copy(update={"num_rotations": 1})
    limits = training_limits(config.model, config.dvae, module.tokenizer)
    predictor = Predictor(module, decode, config.dvae, config.model.max_vertices, limits)
    offset, ring = buildings.point_offset, buildings.vertex_offset
    clouds = [buildings.points_cm[offset[i] : offset[i + 1]] * np.float32(0.01) for i in range(num)]
    rings = [[buildings.xy_m[ring[i] : ring[i + 1]]] for i in range(num)]
    predictor.predict(clouds[:32], rings[:32])
    start = time.process_time()
    predictor.predict(clouds, rings)
    took = time.process_time() - start
    return {"per_s": num / took, "peak_mib": peak_mib()}


def in_fresh_process(config: str, num: int) -> dict[str, float]:
    command = [sys.executable, __file__, "--config", config, "--inference", str(num)]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    measured: dict[str, float] = json.loads(output.splitlines()[-1])
    return measured


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", default="config/models/cpu.yaml")
    parser.add_argument("--num", type=int, default=4000, help="buildings")
    parser.add_argument("--steps", type=int, default=3, help="measured steps of each kind")
    parser.add_argument("--batch", type=int, help="size of the batches of both stages; no inference")
    parser.add_argument("--compile", action="store_true", help="compile our networks first")
    parser.add_argument("--inference", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    config = load(options.config)
    if options.batch:
        change = {"optimiser": {"batch_size": options.batch}, "compute": {"precision": "float32"}}
        small = {"dvae": change, "model": change}
        config = load(options.config, small)
    if options.inference:
        print(json.dumps(inference(config, options.inference)))
        return 0
    buildings = town(options.num)
    device = torch.device("cpu")
    figures = Figures()
    with tempfile.TemporaryDirectory() as folder:
        rate, batch_s = loading(buildings, config, Path(folder))
    figures.at_least("clouds per s and core from the cache", rate, 50_000)

    precomputed, computed_s, fetched_s = with_patches(buildings, config.dvae)
    torch.manual_seed(0)
    vae, plain_vae = (build_dvae(config.dvae) for _ in range(2))
    plain(plain_vae)
    step = optimised(dvae_task.DvaeTask(vae, precomputed, buildings, config.dvae, device), options.compile)
    plain_step = optimised(dvae_task.DvaeTask(plain_vae, buildings, buildings, config.dvae, device))

    def plainly(number: int) -> None:
        with plain_patches(plain_vae):
            plain_step(number)

    took, theirs = alternating(step, plainly, options.steps, options.compile)
    size = config.dvae.optimiser.batch_size
    print(f"dvae   {1 / took.min():.3f} steps/s of {size} clouds, reference {1 / theirs.min():.3f}")
    saved = (computed_s - fetched_s) / (took.min() + computed_s - fetched_s)
    print(
        f"patches of {size} whole clouds: {1e3 * computed_s:.0f} ms computed, {1e3 * fetched_s:.1f} ms fetched; "
        f"{saved:.1%} of a step saved"
    )
    figures.row("patches", {"share of a dvae step saved": saved})
    figures.at_least("dvae steps/s over the reference", theirs.min() / took.min(), 3)

    tokenizer = build_tokenizer(config.model)

    def network() -> point2wss.Point2Wss:
        torch.manual_seed(0)
        return build_model(config.model, config.dvae, tokenizer)

    for part in (vae, plain_vae):
        part.eval().requires_grad_(False)
    training_set = precomputed if model_task.preserves_patches(config.model.augmentation) else buildings
    task = model_task.ModelTask(network(), vae, training_set, buildings, config.model, config.dvae, device)
    step = optimised(task, options.compile)
    whole = config.model.model_copy(update={"auxiliary_share": 1.0})
    other = network()
    plain(other)
    task = model_task.ModelTask(other, plain_vae, buildings, buildings, whole, config.dvae, device)
    with unsorted_batches():
        task.sampler.batch(0)
    longest = int(np.argmax(buildings.num_vertices))
    first = task.sampler.batch
    # the longest building in every batch
    task.sampler.batch = lambda step: np.append(first(step)[1:], longest)
    plain_step = optimised(task)
    took, theirs = alternating(step, plainly, options.steps, options.compile)
    size = config.model.optimiser.batch_size
    print(f"model  {1 / took.mean():.3f} steps/s of {size} buildings, reference {1 / theirs.mean():.3f}")
    figures.at_least("model steps/s over the reference", theirs.mean() / took.mean(), 3)
    figures.at_most("loader's share of a training step", batch_s / took.mean(), 0.05)
    if options.batch:
        return figures.end()

    # each in a fresh process, or the peak would be that of training
    few, many = (in_fresh_process(options.config, num) for num in (options.num // 16, options.num // 4))
    print(
        f"inference, one view: {many['per_s']:.0f} buildings per CPU second; peak memory "
        f"{few['peak_mib']:.0f} MiB for {options.num // 16}, {many['peak_mib']:.0f} for four times as many"
    )
    figures.at_least("buildings/s of inference, two cores", 2 * many["per_s"], 200)
    figures.at_most("MiB more for four times the buildings", many["peak_mib"] - few["peak_mib"], 200)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
