"""Train the network that completes roofs of few points, which comes with p2wss, on drawn towns.

    python benchmarks/completion.py --out completion.safetensors --out-metrics completion.jsonl \\
        --checkpoints completion-checkpoints --threads 16 --compile

Needs torch, and a GPU for a training to its end; no data: it draws its towns itself. It is no claim, and stands here
since no run needs it. A training that is interrupted resumes from its checkpoints; one that is finished deletes them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from completion_forks import Forks
from completion_network import RoofCompletion, completion_loss
from completion_roofs import DrawnRoofs, draw_batch, draw_roofs
from torch import Tensor, nn

from p2wss.cli.common import write_trained
from p2wss.config import DeviceName
from p2wss.config.training import Optimiser
from p2wss.data.seeds import derive_seed
from p2wss.nets import compute
from p2wss.nets.clues import SCALE_M, Clues, features_of
from p2wss.nets.supposed import KIND
from p2wss.nets.threads import set_num_threads
from p2wss.nets.weights import last_validation, write_weights
from p2wss.storage import files
from p2wss.storage.messages import start
from p2wss.storage.provenance import fingerprint
from p2wss.training import loop
from p2wss.training.loop import training_lock

_CHECKPOINT_EVERY_STEPS, _NUM_VALIDATION = 500, 512
# share of the drawn buildings that is kept for validation
_VALIDATION_SHARE = 0.02


def train(
    optimiser: Optimiser,
    device: DeviceName,
    checkpoints: Path,
    code: str,
    seed: int = 0,
    num_processes: int = 1,
    is_compiled: bool = False,
) -> RoofCompletion:
    """Train on towns drawn with ``seed``; see :func:`loop.train`. Of several processes this one trains, while the
    others draw."""
    torch.manual_seed(derive_seed(seed, KIND, "weights"))
    module = RoofCompletion()
    roofs = draw_roofs(seed, num_processes=num_processes)
    task = CompletionTask(module, roofs, optimiser.batch_size, seed, num_processes - 1, is_compiled)
    # after the forks, which have no GPU
    module.to(compute.device_of(device))
    plan = loop.Plan(seed, optimiser, _CHECKPOINT_EVERY_STEPS)
    identity = {
        "stage": KIND,
        "batch_size": optimiser.batch_size,
        "rate": optimiser.learning_rate,
        "seed": seed,
    }
    checkpoints.mkdir(parents=True, exist_ok=True)
    with closing(task.batches):
        loop.train(task, plan, checkpoints, identity, code)
    return module


def save_completion(module: RoofCompletion, path: Path, code: str, metrics: str) -> None:
    """Write the weights in half precision, completely or not at all. ``metrics``: lines of ``metrics.jsonl``."""
    metadata = files.provenance(kind=KIND, code=code, measures=last_validation(metrics))
    write_weights(path, {name: value.half() for name, value in module.state_dict().items()}, metadata)


class Sample(NamedTuple):
    """A batch: clues, z (b, q) and slope (b, q, 2) at their places; arrays, or tensors."""

    clues: Clues
    z: Any
    slope: Any

    def each(self, function: Callable[[Any], Any]) -> Sample:
        """The sample with ``function`` applied to each array."""
        return Sample(Clues(*map(function, self.clues)), function(self.z), function(self.slope))


class CompletionTask:
    """The training as a :class:`p2wss.training.loop.Task`. ``num_forks`` processes draw the batches."""

    def __init__(
        self,
        module: RoofCompletion,
        roofs: DrawnRoofs,
        batch_size: int,
        seed: int,
        num_forks: int = 0,
        is_compiled: bool = False,
    ) -> None:
        self.module, self.roofs, self.batch_size, self.seed = module, roofs, batch_size, seed
        shuffled = np.random.default_rng(seed).permutation(len(roofs.z))
        self.held_out, self.index = np.split(shuffled, [max(int(_VALIDATION_SHARE * len(shuffled)), 1)])
        self.batches = Forks(self._draw, num_forks)
        self._loss_of = compute.compiled(loss_of) if is_compiled else loss_of

    @property
    def device(self) -> torch.device:
        return next(self.module.parameters()).device

    def load(self, step: int) -> Sample:
        return self.batches[step].each(lambda each: compute.staged(torch.from_numpy(each), self.device))

    def step(self, step: int, loaded: Sample) -> dict[str, Tensor]:
        return {"loss": self._loss_of(self.module, loaded.each(self._on_device))}

    def validate(self, module: nn.Module) -> dict[str, float]:
        assert isinstance(module, RoofCompletion)
        sample = _drawn(self.roofs, self.held_out[:_NUM_VALIDATION], np.random.default_rng(0))
        clues, z, _ = sample.each(lambda each: self._on_device(torch.from_numpy(each)))
        mixture = module(*features_of(clues, torch))
        likeliest = mixture.logit.argmax(-1, keepdim=True)
        off = (mixture.z.gather(-1, likeliest)[..., 0] - z).abs().mean()
        return {"val_height_m": SCALE_M * float(off)}

    def _draw(self, step: int) -> Sample:
        rng = np.random.default_rng(derive_seed(self.seed, KIND, step))
        return _drawn(self.roofs, rng.choice(self.index, self.batch_size), rng)

    def _on_device(self, each: Tensor) -> Tensor:
        return each.to(self.device, non_blocking=True)


def loss_of(module: RoofCompletion, sample: Sample) -> Tensor:
    """The loss of a batch of tensors. The features are computed on the device of the network: they are a hundred times
    as many numbers as the clues."""
    return completion_loss(module(*features_of(sample.clues, torch)), sample.z, sample.slope)


def _drawn(roofs: DrawnRoofs, index: np.ndarray, rng: np.random.Generator) -> Sample:
    """A random batch of the buildings ``index`` (b,), in single precision."""
    return Sample(*draw_batch(roofs, index, rng)).each(
        lambda each: each if each.dtype == bool else each.astype(np.float32)
    )


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="safetensors file to write: the weights")
    parser.add_argument(
        "--out-metrics", type=Path, required=True, help="JSON lines to write: losses during training"
    )
    parser.add_argument("--checkpoints", type=Path, required=True, help="folder for checkpoints")
    parser.add_argument("--threads", type=int, default=1, help="one trains, the others draw")
    parser.add_argument("--num-steps", type=int, default=13_000, help="batches to train on")
    parser.add_argument("--batch-size", type=int, default=1024, help="buildings of a batch")
    parser.add_argument("--compile", action="store_true", help="faster steps on a GPU")
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
    options = parser.parse_args(words)
    start()
    set_num_threads(options.threads)
    code = fingerprint("training.loop", "nets", "towns")
    optimiser = Optimiser(
        num_steps=options.num_steps,
        batch_size=options.batch_size,
        learning_rate=1e-3,
        ramp_steps=min(options.num_steps // 2, 5000),
        weight_decay=0.02,
    )
    checkpoints = options.checkpoints
    with training_lock(checkpoints):
        module = train(
            optimiser,
            options.device,
            checkpoints,
            code,
            num_processes=options.threads,
            is_compiled=options.compile,
        )
        write_trained(checkpoints, options.out_metrics, partial(save_completion, module, options.out, code))
    return 0


if __name__ == "__main__":
    sys.exit(main())
