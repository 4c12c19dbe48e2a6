"""Train the network that completes roofs of few points, on drawn towns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from p2wss.config import DeviceName
from p2wss.config.training import Optimiser
from p2wss.data.seeds import derive_seed
from p2wss.nets import compute
from p2wss.nets.clues import SCALE_M, features_of
from p2wss.nets.completion import Mixture, RoofCompletion, completion_loss
from p2wss.nets.supposed import KIND
from p2wss.nets.weights import last_validation, write_weights
from p2wss.storage import files
from p2wss.training import loop
from p2wss.training.drawn_roofs import DrawnRoofs, draw_batch, draw_roofs

_CHECKPOINT_EVERY_STEPS, _NUM_VALIDATION = 500, 512
# of the buildings drawn, those kept for validation
_VALIDATION_SHARE = 0.02


def train(
    optimiser: Optimiser, device: DeviceName, checkpoints: Path, code: str, seed: int = 0
) -> RoofCompletion:
    """Train on towns drawn with ``seed``; see :func:`loop.train`."""
    torch.manual_seed(derive_seed(seed, KIND, "weights"))
    module = RoofCompletion().to(compute.device_of(device))
    task = CompletionTask(module, draw_roofs(seed), optimiser.batch_size, seed)
    plan = loop.Plan(seed, optimiser, _CHECKPOINT_EVERY_STEPS)
    identity = {
        "stage": KIND,
        "batch_size": optimiser.batch_size,
        "rate": optimiser.learning_rate,
        "seed": seed,
    }
    checkpoints.mkdir(parents=True, exist_ok=True)
    loop.train(task, plan, checkpoints, identity, code)
    return module


def save_completion(module: RoofCompletion, path: Path, code: str, metrics: str) -> None:
    """Write the weights in half precision, completely or not at all. ``metrics``: lines of ``metrics.jsonl``."""
    metadata = files.provenance(kind=KIND, code=code, measures=last_validation(metrics))
    write_weights(path, {name: value.half() for name, value in module.state_dict().items()}, metadata)


class CompletionTask:
    """The training as a :class:`p2wss.training.loop.Task`."""

    def __init__(self, module: RoofCompletion, roofs: DrawnRoofs, batch_size: int, seed: int) -> None:
        self.module, self.roofs, self.batch_size, self.seed = module, roofs, batch_size, seed
        shuffled = np.random.default_rng(seed).permutation(len(roofs.z))
        self.held_out, self.index = np.split(shuffled, [max(int(_VALIDATION_SHARE * len(shuffled)), 1)])

    def step(self, step: int) -> dict[str, Tensor]:
        rng = np.random.default_rng(derive_seed(self.seed, KIND, step))
        mixture, z, slope = self._mixture(self.module, rng.choice(self.index, self.batch_size), rng)
        return {"loss": completion_loss(mixture, z, slope)}

    def validate(self, module: nn.Module) -> dict[str, float]:
        assert isinstance(module, RoofCompletion)
        mixture, z, _ = self._mixture(module, self.held_out[:_NUM_VALIDATION], np.random.default_rng(0))
        likeliest = mixture.logit.argmax(-1, keepdim=True)
        off = (mixture.z.gather(-1, likeliest)[..., 0] - z).abs().mean()
        return {"val_height_m": SCALE_M * float(off)}

    def _mixture(
        self, module: RoofCompletion, index: np.ndarray, rng: np.random.Generator
    ) -> tuple[Mixture, Tensor, Tensor]:
        device = next(module.parameters()).device
        clues, z, slope = draw_batch(self.roofs, index, rng)
        features = [
            torch.from_numpy(each.astype(np.float32) if each.dtype == float else each.copy()).to(device)
            for each in features_of(clues)
        ]
        return module(*features), *(
            torch.from_numpy(each.astype(np.float32)).to(device) for each in (z, slope)
        )
