"""The state of a training: everything that changes while a network trains, and its checkpoints."""

from __future__ import annotations

import json
import math
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from torch import nn

from p2wss.config import Optimiser
from p2wss.nets import distributed
from p2wss.storage import files, integrity
from p2wss.storage.log_lines import log

METRICS_NAME = "metrics.jsonl"
MAX_CHECKPOINTS = 2


class TrainingState:
    """A network, its optimiser, and the metrics of the steps so far."""

    def __init__(self, module: nn.Module, settings: Optimiser) -> None:
        self.module = module
        self.settings = settings
        self.optimiser = torch.optim.AdamW(
            _parameter_groups(module, settings.weight_decay),
            betas=(0.9, settings.beta2),
            **({"fused": True} if next(module.parameters()).is_cuda else {"foreach": True}),
        )
        self.metrics: list[dict[str, Any]] = []

    def step(self, rate: float) -> None:
        """Apply the gradients with this learning rate."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.step()

    def save(self, folder: Path, step: int, identity: dict[str, Any]) -> None:
        """Write the metrics and a checkpoint after ``step`` steps, and remove old checkpoints. Only the main process
        does so."""
        if distributed.rank():
            return
        files.write_text(folder / METRICS_NAME, "".join(json.dumps(line) + "\n" for line in self.metrics))
        checkpoint = {
            "module": self.module.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "step": step,
            "identity": _text(identity),
            "metrics": self.metrics,
            "length": _length(self.settings),
        }
        # through memory, because torch reports a full disk as some RuntimeError
        buffer = BytesIO()
        torch.save(checkpoint, buffer)
        files.write_bytes(folder / f"step-{step:08d}.pt", buffer.getbuffer(), seal=True)
        steps = sorted(_checkpoints(folder))
        extendable = [each for each in steps if each <= num_steady_steps(self.settings)]
        for old in set(steps[:-MAX_CHECKPOINTS]) - set(extendable[-1:]):
            _checkpoints(folder)[old].unlink()

    def resume(self, folder: Path, identity: dict[str, Any]) -> int:
        """Load the latest readable checkpoint of this ``identity`` and return its step; without one, return 0 and
        remove all checkpoints.

        A training of another length is continued from a step before the learning rate of either training begins to
        fall.
        """
        for step, path in sorted(_checkpoints(folder).items(), reverse=True):
            if not integrity.is_usable(path):
                log.warning("%s: damaged or incomplete; trying the previous one", path)
                continue
            try:
                checkpoint = torch.load(path, map_location="cpu", weights_only=True)
            except Exception as error:
                log.warning("%s: not readable (%s); trying the previous one", path, type(error).__name__)
                continue
            if checkpoint["identity"] != _text(identity):
                log.warning(
                    "%s: belongs to another configuration or data set; starting from the beginning", folder
                )
                break
            old, new = checkpoint["length"], _length(self.settings)
            if old != new and step > min(old["num_steady_steps"], new["num_steady_steps"]):
                log.warning("%s: made for %d steps; trying the previous one", path, old["num_steps"])
                continue
            self.module.load_state_dict(checkpoint["module"])
            self.optimiser.load_state_dict(checkpoint["optimiser"])
            self.metrics = checkpoint["metrics"]
            log.info("resuming at step %d", step)
            return step
        distributed.barrier()  # until every process has looked
        if distributed.rank() == 0:
            for path in _checkpoints(folder).values():
                path.unlink()
        return 0


def num_steady_steps(settings: Optimiser) -> int:
    """Number of steps before the learning rate begins to fall; 0 for a cosine decay, which depends on the whole
    length."""
    return max(settings.num_steps - settings.ramp_steps, 0) if settings.ramp_steps else 0


def learning_rate(step: int, settings: Optimiser) -> float:
    """Cosine warm-up from 0, then cosine decay to ``learning_rate_end`` (paper, section 5.2), or two linear ramps."""
    if settings.ramp_steps:
        share = min(step + 1, settings.num_steps - step) / settings.ramp_steps
        return max(settings.learning_rate * min(share, 1.0), settings.learning_rate_end)
    warmup = max(round(settings.warmup_share * settings.num_steps), 1)
    if step < warmup:
        return settings.learning_rate * (1 - math.cos(math.pi * (step + 1) / warmup)) / 2
    share = (step - warmup) / max(settings.num_steps - warmup, 1)
    low, high = settings.learning_rate_end, settings.learning_rate
    return low + (high - low) * (1 + math.cos(math.pi * share)) / 2


def remove_checkpoints(checkpoints: Path) -> None:
    """Remove what a training wrote to the folder, and the folder if nothing else is in it."""
    for path in [*_checkpoints(checkpoints).values(), checkpoints / METRICS_NAME]:
        path.unlink(missing_ok=True)
    if checkpoints.is_dir() and not any(checkpoints.iterdir()):
        checkpoints.rmdir()


def _length(settings: Optimiser) -> dict[str, int]:
    return {"num_steps": settings.num_steps, "num_steady_steps": num_steady_steps(settings)}


def _text(identity: dict[str, Any]) -> str:
    return json.dumps(identity, sort_keys=True)


def _parameter_groups(module: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Weights of linear layers decay; biases, norms, tokens, codebooks and embeddings do not."""
    decayed = [part.weight for part in module.modules() if isinstance(part, nn.Linear)]
    others = [p for p in module.parameters() if not any(p is weight for weight in decayed)]
    return [{"params": decayed, "weight_decay": weight_decay}, {"params": others, "weight_decay": 0.0}]


def _checkpoints(folder: Path) -> dict[int, Path]:
    return {int(path.stem.removeprefix("step-")): path for path in folder.glob("step-*.pt")}
