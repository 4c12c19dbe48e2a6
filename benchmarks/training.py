"""Speed of loading, of both training stages and of inference, against plain implementations in the same run.

    python benchmarks/training.py [--config config/models/cpu.yaml] [--num 4000] [--steps 3] [--compile]

All speeds are CPU time of one thread, on clouds and outlines drawn here. The reference does what the paper
and Point-BERT describe, operation by operation: point and patch features joined before the layer, edge
convolutions on gathered features with the graph found anew each time, every sequence padded to the longest,
all four losses on the whole batch. ``--compile`` compiles our networks (``compute.compile``), not the reference's.
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
from pathlib import Path
from unittest import mock

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
import numpy as np
import torch
from figures import Figures, cpu_seconds, peak_mib
from torch import Tensor
from torch.nn import functional as F

from p2wss import dataset, dvae, model
from p2wss.config import Config, load
from p2wss.dataset import Buildings
from p2wss.nets import discrete_vae, point2wss
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.patches import Patches

# vertices of outlines and how often they occur, about as in the miniature's town
NUM_VERTICES, SHARES = [4, 5, 6, 8, 10, 12, 16], [0.55, 0.06, 0.17, 0.12, 0.05, 0.03, 0.02]


def town(num: int, seed: int = 0) -> Buildings:
    """Clouds of 200 to 3,000 points on roofs over regular outlines: as large as real ones, of no meaning."""
    rng = np.random.default_rng(seed)
    vertices = rng.choice(NUM_VERTICES, num, p=SHARES)
    count = np.clip(rng.lognormal(6.9, 0.5, num), 200, 3000).astype(np.int64)
    points = rng.uniform(-900, 900, (count.sum(), 3))
    points[:, 2] = np.abs(points[:, 2])
    corner = np.concatenate([np.arange(n) / n for n in vertices]) * 2 * np.pi
    return Buildings(
        points_cm=points.astype(np.int16),
        point_offset=np.concatenate([[0], np.cumsum(count)]),
        ground_z_m=np.zeros(num, np.float32),
        xy_m=(9 * np.stack([np.cos(corner), np.sin(corner)], -1)).astype(np.float32),
        vertex_offset=np.concatenate([[0], np.cumsum(vertices)]),
        angle_deg=rng.choice([0, 30, 90], vertices.sum()).astype(np.float32),
        height_m=rng.uniform(3, 12, num).astype(np.float32),
        num_left_out={},
    )


# --- the reference ---


class PlainEdgeConvolution(discrete_vae.EdgeConvolution):
    """[neighbour - x; x] is built for every edge, multiplied, normalised, and only then the largest taken."""

    def forward(self, x: Tensor, neighbour: Tensor, adjacency: Tensor) -> Tensor:
        rows = torch.arange(len(x))[:, None, None]
        own = x[:, :, None].expand(-1, -1, neighbour.shape[-1], -1)
        edges = torch.cat([x[rows, neighbour] - own, own], -1).permute(0, 3, 1, 2)
        weight = torch.cat([self.difference.weight, self.self.weight], 1)
        y = F.conv2d(edges, weight[..., None, None])
        return F.leaky_relu(self.norm(y), 0.2).amax(-1).transpose(1, 2)


class PlainDgcnn(discrete_vae.Dgcnn):
    """The graph is found anew before each convolution."""

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
    """Every point is joined with its patch's maximum."""

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


def plain(vae: DiscreteVae) -> DiscreteVae:
    """The same weights in the reference's classes."""
    for part in vae.modules():
        for ours, theirs in (
            (discrete_vae.EdgeConvolution, PlainEdgeConvolution),
            (discrete_vae.Dgcnn, PlainDgcnn),
            (discrete_vae.MiniPointNet, PlainPointNet),
        ):
            if type(part) is ours:
                part.__class__ = theirs
    return vae


# --- measuring ---


@contextmanager
def no_buckets() -> Iterator[None]:
    """Batches of any lengths, padded to the longest building of all."""
    window, dataset._BUCKET_WINDOW = dataset._BUCKET_WINDOW, 1
    try:
        yield
    finally:
        dataset._BUCKET_WINDOW = window


def optimised(task: dvae._Task | model._Task, compiled: bool = False) -> Callable[[int], None]:
    """A step of training without the averaging of weights."""
    if compiled:
        for part in task.heavy_parts():
            part.compile()
    optimiser = torch.optim.AdamW(task.module.parameters(), foreach=True)

    def step(number: int) -> None:
        task.module.train()
        task.step(number)["loss"].backward()
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)

    return step


def mean_step(task: dvae._Task | model._Task, steps: int, compiled: bool = False) -> float:
    """CPU seconds per step, over different batches."""
    step = optimised(task, compiled)
    # lengths differ: the second batch compiles for any
    for number in (0, *(range(1, 9) if compiled else ())):
        step(number)
    start = time.process_time()
    for number in range(100, 100 + steps):
        step(number)
    return (time.process_time() - start) / steps


def loading(buildings: Buildings, config: Config, folder: Path) -> tuple[float, float]:
    """Clouds per second from a mapped file, and CPU seconds per batch of the model's stage."""
    path = folder / "points.i16"
    buildings.points_cm.tofile(path)
    mapped = np.memmap(path, np.int16, "r", shape=buildings.points_cm.shape).view(np.ndarray)
    source = Buildings(**(vars(buildings) | {"points_cm": mapped}))
    size, order = 64, np.random.default_rng(0).permutation(len(buildings))
    batches = [order[first : first + size] for first in range(0, len(order) - size, size)]

    def epoch() -> None:
        for number, index in enumerate(batches):
            source.batch(index, config.dvae.num_points, number)

    took = cpu_seconds(epoch, 3)
    rate = size * len(batches) / took
    return rate, took / len(batches) * config.model.optimiser.batch_size / size


def inference(config: Config, num: int) -> dict[str, float]:
    """Buildings per CPU second, one view, and the most memory that this process ever held."""
    buildings = town(num)
    module = model.make_module(config.model, config.dvae, model.make_tokenizer(config.model))
    decode = config.model.decoding.model_copy(update={"num_rotations": 1})
    limits = model.limits_of(config.model, config.dvae, module.tokenizer)
    predictor = model.Predictor(module, decode, config.dvae, config.model.max_vertices, limits)
    offset, ring = buildings.point_offset, buildings.vertex_offset
    clouds = [buildings.points_cm[offset[i] : offset[i + 1]] * np.float32(0.01) for i in range(num)]
    rings = [[buildings.xy_m[ring[i] : ring[i + 1]]] for i in range(num)]
    predictor.predict(clouds[:32], rings[:32])
    start = time.process_time()
    predictor.predict(clouds, rings)
    took = time.process_time() - start
    ours = {"per_s": num / took, "peak_mib": peak_mib()}
    # side by side on a few: the speed of a shared machine drifts
    few = slice(0, 128)
    both = []
    for _ in range(3):
        start = time.process_time()
        predictor.predict(clouds[few], rings[few])
        middle = time.process_time()
        with plain_inference():
            predictor.predict(clouds[few], rings[few])
        both.append((time.process_time() - middle) / (middle - start))
    return {**ours, "over_reference": sorted(both)[1]}


@contextmanager
def plain_inference() -> Iterator[None]:
    """Every position's answer, norms as layers of their own, batches in the order given."""

    def in_order(predictor: model.Predictor, _: object, num_vertices: np.ndarray) -> Iterator[np.ndarray]:
        for first in range(0, len(num_vertices), predictor._batch_size):
            yield np.arange(len(num_vertices))[first : first + predictor._batch_size]

    def all_positions(network: point2wss.Point2Wss, *arguments: Tensor) -> Tensor:
        return restore(network, *arguments[:-1])[:, arguments[-1]]

    restore = point2wss.Point2Wss.restore
    with (
        mock.patch.object(model.Predictor, "_alike", in_order),
        mock.patch.object(point2wss.Point2Wss, "restore", all_positions),
        mock.patch.object(discrete_vae.MiniPointNet, "infer", PlainPointNet.forward),
    ):
        yield


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
    parser.add_argument("--compile", action="store_true", help="compile our networks first")
    parser.add_argument("--inference", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    config = load(options.config)
    if options.inference:
        print(json.dumps(inference(config, options.inference)))
        return 0
    buildings = town(options.num)
    device = torch.device("cpu")
    figures = Figures()
    with tempfile.TemporaryDirectory() as folder:
        rate, batch_s = loading(buildings, config, Path(folder))
    figures.at_least("clouds per s and core from the cache", rate, 50_000)

    torch.manual_seed(0)
    vae = DiscreteVae(dvae.sizes(config.dvae))
    ours = mean_step(
        dvae._Task(vae, buildings, buildings, config.dvae, device), options.steps, options.compile
    )
    reference = plain(DiscreteVae(dvae.sizes(config.dvae)))
    task = dvae._Task(reference, buildings, buildings, config.dvae, device)
    real = dvae.patches_of

    def patches_of(*arguments: object) -> Patches:
        found = real(*arguments)
        for part in (*reference.modules(), *other.modules()):
            if isinstance(part, PlainDgcnn):
                part.centre = found.centre
        return found

    other = reference
    dvae.patches_of = patches_of
    theirs = mean_step(task, options.steps)
    dvae.patches_of = real
    size = config.dvae.optimiser.batch_size
    print(f"dvae   {1 / ours:.3f} steps/s of {size} clouds, reference {1 / theirs:.3f}")
    figures.at_least("dvae steps/s over the reference", theirs / ours, 3)

    tokenizer = model.make_tokenizer(config.model)

    def network() -> point2wss.Point2Wss:
        torch.manual_seed(0)
        return model.make_module(config.model, config.dvae, tokenizer)

    frozen = vae.eval().requires_grad_(False)
    ours = mean_step(
        model._Task(network(), frozen, buildings, buildings, config.model, config.dvae, device),
        options.steps,
        options.compile,
    )
    other = plain(network())
    padded = Buildings(**vars(buildings))
    whole = config.model.model_copy(update={"auxiliary_share": 1.0})
    with no_buckets():
        task = model._Task(
            other, reference.eval().requires_grad_(False), padded, padded, whole, config.dvae, device
        )
        task.order.batch(0)
        longest = int(np.argmax(buildings.num_vertices))
        first = task.order.batch
        # the longest building in every batch
        task.order.batch = lambda step: np.append(first(step)[1:], longest)
        dvae.patches_of = patches_of
        theirs = mean_step(task, options.steps)
        dvae.patches_of = real
    size = config.model.optimiser.batch_size
    print(f"model  {1 / ours:.3f} steps/s of {size} buildings, reference {1 / theirs:.3f}")
    figures.at_least("model steps/s over the reference", theirs / ours, 3)
    figures.at_most("loader's share of a training step", batch_s / ours, 0.05)

    # each in a fresh process, or the peak would be that of training
    few, many = (in_fresh_process(options.config, num) for num in (options.num // 16, options.num // 4))
    print(
        f"inference, one view: {many['per_s']:.0f} buildings per CPU second; peak memory "
        f"{few['peak_mib']:.0f} MiB for {options.num // 16}, {many['peak_mib']:.0f} for four times as many"
    )
    print(f"inference over the reference: {many['over_reference']:.2f}")
    figures.at_least("buildings/s of inference, two cores", 2 * many["per_s"], 200)
    figures.at_most("MiB more for four times the buildings", many["peak_mib"] - few["peak_mib"], 200)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
