"""The first ten losses of both stages, seeded, on one CPU thread: what ``golden.json`` holds.

The learning rate is small: training is chaotic, and at the usual rate the rounding of another kind of CPU leads to
other losses within ten steps. For the same reason the stage model reads the tokens of an untrained dvae.

python tests/unit/golden.py   writes it anew, after a change that is meant to change the training
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import torch
import toy_crops
from small_networks import SMALL_DVAE, SMALL_MODEL

from p2wss.config import load
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.weights import save_dvae
from p2wss.training import dvae, loop, model
from p2wss.training.loop import METRICS_NAME

PATH = Path(__file__).with_name("golden.json")
NUM_STEPS = 10


def losses(folder: Path) -> dict[str, list[dict[str, float]]]:
    """Per stage the logged losses of each of ten steps, on simple crops in ``folder``."""
    steps = {"optimiser": {"num_steps": NUM_STEPS, "batch_size": 8, "learning_rate": 3e-4}}
    config = load({"dvae": SMALL_DVAE | steps, "model": SMALL_MODEL | steps})
    manifest = toy_crops.make(folder, {"train": 24, "val": 8})
    losses_of_stage = {}
    every, loop.METRICS_EVERY_STEPS = loop.METRICS_EVERY_STEPS, 1
    num_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        dvae.train(manifest, config.dvae, folder / "dvae", "x")
        torch.manual_seed(0)
        untrained = DiscreteVae(config.dvae)
        save_dvae(untrained, folder / "d.safetensors", "x", "")
        model.train(manifest, folder / "d.safetensors", config.model, folder / "model", "x")
    finally:
        loop.METRICS_EVERY_STEPS = every
        torch.set_num_threads(num_threads)
    for stage in ("dvae", "model"):
        records = map(json.loads, (folder / stage / METRICS_NAME).read_text().splitlines())
        losses_of_stage[stage] = [
            {name: round(value, 6) for name, value in record.items() if name != "learning_rate"}
            for record in records
            if "loss" in record
        ]
    return losses_of_stage


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        PATH.write_text(json.dumps(losses(Path(folder)), indent=1) + "\n")
