"""Speed of drawing, of both training stages and of inference.

    python benchmarks/training.py [--config config/models/cpu.yaml ..] [--num 4000] [--steps 3] [--batch N]
    python benchmarks/training.py --config config/models/gpu.yaml --device cuda --steps 20
    python benchmarks/training.py --completion

Needs torch, no data. ``--completion``: only how fast houses are drawn and described for the completion, in seconds.

``--config`` can switch ``compute.compile`` on; the completion is always compiled on a GPU.

All speeds are CPU time of one thread, or wall time on a GPU. Clouds and footprints are random. The loader's share of a
step is the time for which the step waits for its batch. The fastest step counts for the dvae, the mean for the
model, whose batches differ. ``--batch`` sets the batch size of both, in float32, for large networks on few cores.
Inference is not measured with ``--batch`` or on a GPU.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
import numpy as np
import torch
from completion import CompletionTask
from completion_network import RoofCompletion
from completion_roofs import draw_roofs
from figures import Figures, cpu_seconds, peak_mib

from p2wss.config import Config, Optimiser, load
from p2wss.nets import compute
from p2wss.nets.clues import features_of
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.point2wss import Point2Wss
from p2wss.nets.predictor import Point2WssPredictor
from p2wss.training.dataset import BuildingDataset
from p2wss.training.dvae import DvaeTask
from p2wss.training.loop import Task, TrainingState, learning_rate
from p2wss.training.model import ModelTask

# numbers of vertices of footprints and their shares, about as in the town of the miniature
NUM_VERTICES, SHARES = [4, 5, 6, 8, 10, 12, 16], [0.55, 0.06, 0.17, 0.12, 0.05, 0.03, 0.02]
# steps on a GPU before the measured ones: code is compiled in them
_NUM_COMPILING = 8
# processes that draw for the completion on a GPU
_NUM_FORKS = 7


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
        num_on_building=count // 2,
        num_excluded={},
    )


def clock_s(device: torch.device) -> float:
    """CPU seconds of this process, or on a GPU the seconds on the clock when its work is done."""
    if device.type == "cpu":
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()


def seconds_of_steps(task: Task, optimiser: Optimiser, steps: int) -> tuple[np.ndarray, float]:
    """Seconds (steps,) of the steps of a training by :func:`clock_s`, and the share of them that was spent on batches.
    On a GPU, where batches are prepared one step ahead, this is the time of waiting for them."""
    device = next(task.module.parameters()).device
    num_first = 1 if device.type == "cpu" else _NUM_COMPILING
    state = TrainingState(task.module, optimiser)
    took, waited = np.empty((2, num_first + steps))
    with ThreadPoolExecutor(1) as loader:
        loading = loader.submit(task.load, 0)
        loading.result()
        for number in range(num_first + steps):
            start = clock_s(device)
            if device.type == "cpu":
                loading = loader.submit(task.load, number)
            loaded = loading.result()
            waited[number] = clock_s(device) - start
            if device.type == "cuda":
                loading = loader.submit(task.load, number + 1)
            task.module.train()
            losses = task.step(number, loaded)
            state.optimiser.zero_grad(set_to_none=True)
            losses["loss"].backward()
            torch.nn.utils.clip_grad_norm_(task.module.parameters(), 1.0)
            state.step(learning_rate(number, optimiser))
            took[number] = clock_s(device) - start
    return took[num_first:], waited[num_first:].sum() / took[num_first:].sum()


def houses_per_second() -> dict[str, float]:
    """Houses per CPU second for the completion, of one process and in batches of 1,024: drawn, described (the features
    of the network), and both."""
    task = CompletionTask(RoofCompletion(), draw_roofs(0, share=0.02), 1024, 0)
    clues = task.load(0).clues
    parts: dict[str, Callable[[], object]] = {
        "drawn": lambda: task.load(0),
        "described": lambda: features_of(clues, torch),
        "drawn and described": lambda: features_of(task.load(0).clues, torch),
    }
    return {name: 1024 / cpu_seconds(call) for name, call in parts.items()}


def completion_steps(device: torch.device, steps: int) -> float:
    """Seconds of a step of the completion with 1,024 houses, as ``completion.py --compile`` takes it."""
    roofs = draw_roofs(0, share=0.02)
    task = CompletionTask(RoofCompletion(), roofs, 1024, 0, _NUM_FORKS, is_compiled=True)
    task.module.to(device)
    with closing(task.batches):
        took, _ = seconds_of_steps(task, Optimiser(), steps)
    return float(np.median(took))


def inference(config: Config, num: int) -> dict[str, float]:
    """Buildings per CPU second with one view, and the peak memory of this process."""
    buildings = town(num)
    predictor = Point2WssPredictor(Point2Wss(config.model, config.dvae), num_views=1)
    clouds = [buildings.cloud_cm(i) * np.float32(0.01) for i in np.arange(num)]
    rings = [[buildings.ring_m(i)] for i in np.arange(num)]
    predictor.predict(clouds[:32], rings[:32])
    start = time.process_time()
    predictor.predict(clouds, rings)
    took = time.process_time() - start
    return {"per_s": num / took, "peak_mib": peak_mib()}


def in_fresh_process(configs: list[str], num: int) -> dict[str, float]:
    command = [sys.executable, __file__, "--config", *configs, "--inference", str(num)]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    measured: dict[str, float] = json.loads(output.splitlines()[-1])
    return measured


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", nargs="+", default=["config/models/cpu.yaml"])
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--num", type=int, default=4000, help="buildings")
    parser.add_argument("--steps", type=int, default=3, help="measured steps of each kind")
    parser.add_argument("--batch", type=int, help="size of the batches of both stages; no inference")
    parser.add_argument("--completion", action="store_true", help="only drawing and describing of houses")
    parser.add_argument("--inference", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    device = compute.device_of(options.device)
    config = load(*options.config)
    if options.batch:
        change = {"optimiser": {"batch_size": options.batch}, "compute": {"precision": "float32"}}
        config = load(*options.config, {"dvae": change, "model": change})
    if options.inference:
        print(json.dumps(inference(config, options.inference)))
        return 0
    figures = Figures()
    houses = houses_per_second()
    figures.row("completion", {f"houses/s {name}": value for name, value in houses.items()})
    print("completion: houses/s " + ", ".join(f"{value:,.0f} {name}" for name, value in houses.items()))
    figures.at_least(
        "completion: houses/s drawn and described by one core", houses["drawn and described"], 5000
    )
    if options.completion:
        return figures.end()
    if device.type == "cuda":
        step_s = completion_steps(device, options.steps)
        figures.at_least("completion: steps/s", 1 / step_s, 13000 / 1200)
    buildings = town(options.num)
    torch.manual_seed(0)
    vae = DiscreteVae(config.dvae).to(device)
    took, share = seconds_of_steps(DvaeTask(vae, buildings, buildings), config.dvae.optimiser, options.steps)
    figures.at_most("dvae: loader's share of a step", share, 0.05)
    figures.row("dvae", {"steps per second": 1 / took.min()})
    print(f"dvae   {1 / took.min():.3f} steps/s of {config.dvae.optimiser.batch_size} clouds")
    vae.eval().requires_grad_(False)
    network = Point2Wss(config.model, config.dvae).to(device)
    took, share = seconds_of_steps(
        ModelTask(network, vae, buildings, buildings), config.model.optimiser, options.steps
    )
    figures.at_most("model: loader's share of a step", share, 0.05)
    figures.row("model", {"steps per second": 1 / took.mean()})
    print(f"model  {1 / took.mean():.3f} steps/s of {config.model.optimiser.batch_size} buildings")
    if device.type == "cuda":
        memory_gib = torch.cuda.max_memory_allocated() / 2**30
        figures.row("GPU", {"most memory, GiB": memory_gib})
        print(f"{torch.cuda.get_device_name()}: at most {memory_gib:.1f} GiB")
    if options.batch or device.type == "cuda":
        return figures.end()

    # each in a fresh process, or the peak would be that of training
    few, many = (in_fresh_process(options.config, num) for num in (options.num // 16, options.num // 4))
    print(
        f"inference, one view: {many['per_s']:.0f} buildings per CPU second; peak memory "
        f"{few['peak_mib']:.0f} MiB for {options.num // 16}, {many['peak_mib']:.0f} for four times as many"
    )
    figures.at_least("buildings/s of inference, two cores", 2 * many["per_s"], 100)
    figures.at_most("MiB more for four times the buildings", many["peak_mib"] - few["peak_mib"], 200)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())
