"""The training loop of both stages: seeds, checkpoints, metrics.

Everything random in step i follows from (seed, i) alone. A run that was stopped and resumed therefore takes the
same steps as one that was not, bit for bit on a CPU.
"""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from p2wss.config import Optimiser, Section
from p2wss.data.seeds import derive_seed
from p2wss.nets import distributed
from p2wss.storage.errors import InputError
from p2wss.storage.log_lines import log
from p2wss.storage.progress import Progress
from p2wss.storage.temporary import is_running
from p2wss.training.state import TrainingState, learning_rate, num_steady_steps

METRICS_EVERY_STEPS = 20
# environment variable with the process of the Snakemake that started this one, see workflow/rules/common.smk
WORKFLOW_VARIABLE = "P2WSS_WORKFLOW_PROCESS"


@dataclass(frozen=True)
class Plan:
    """How to train: seed, optimiser, when to validate and save."""

    seed: int
    optimiser: Optimiser
    checkpoint_every_steps: int


class Task(Protocol):
    """What to train."""

    @property
    def module(self) -> nn.Module:
        """The network."""

    def load(self, step: int) -> Any:
        """What the host prepares for ``step``, in another thread during the step before."""

    def step(self, step: int, loaded: Any) -> dict[str, Tensor]:
        """Losses of the batch of ``step``; the one named ``loss`` is minimised, the others are logged."""

    def validate(self, module: nn.Module) -> dict[str, float]:
        """Measures of ``module`` on held-out data."""


def train(task: Task, plan: Plan, checkpoints: Path, identity: dict[str, Any], code: str) -> nn.Module:
    """Train ``task.module`` for ``plan.optimiser.num_steps`` steps and return it.

    Checkpoints and ``metrics.jsonl`` are written to the folder ``checkpoints``. If it holds a checkpoint of the same
    ``identity`` (config, data; JSON values), training resumes there; checkpoints of another identity are discarded. The
    fingerprint ``code`` is only recorded in the metrics, where it changes: an edit of the code that changes no result
    costs no training. On SIGTERM, or when the Snakemake that started it was killed, a checkpoint is written and the
    process exits with status 0. Of several processes (see :mod:`distributed`) the main one writes. Raises
    :class:`InputError` when the loss is no longer finite.
    """
    num_steps = plan.optimiser.num_steps
    state = TrainingState(task.module, plan.optimiser)
    start = state.resume(checkpoints, identity)
    if [line["code"] for line in state.metrics if "code" in line][-1:] != [code]:
        state.metrics.append({"step": start, "code": code})
    with (
        _stop_request() as is_stop_requested,
        ThreadPoolExecutor(1) as loader,
        Progress("training", num_steps, "steps", start) as progress,
    ):
        loading = loader.submit(task.load, start)
        for step in range(start, num_steps):
            rate, loaded = learning_rate(step, plan.optimiser), loading.result()
            if step + 1 < num_steps:
                loading = loader.submit(task.load, step + 1)
            losses = _gradients(task, plan, step, loaded)
            state.step(rate)
            done = step + 1
            ends = num_steps, num_steady_steps(plan.optimiser)
            checkpoint_due = done % plan.checkpoint_every_steps == 0 or done in ends
            if checkpoint_due or done % METRICS_EVERY_STEPS == 0:
                averages = distributed.average_values({name: float(loss) for name, loss in losses.items()})
                if not math.isfinite(averages["loss"]):
                    raise InputError(
                        f"training: the loss is {averages['loss']} at step {done}: lower the learning rate"
                    )
                state.metrics.append({"step": done, "learning_rate": rate, **averages})
                progress.update(done, f"loss {averages['loss']:.4f}")
            if checkpoint_due:
                state.metrics.append({"step": done, **_validate(task, plan, done)})
            stopping = done < num_steps and _any_process_stops(is_stop_requested(), done)
            if checkpoint_due or stopping:
                state.save(checkpoints, done, identity)
            if stopping:
                log.info("stopped at step %d of %d; the next run resumes there", done, num_steps)
                raise SystemExit(0)
    return task.module


def training_config(config: Section) -> dict[str, Any]:
    """The config without the settings that may differ between a run and the one that resumes it.

    :meth:`TrainingState.resume` compares the number of steps.
    """
    exclude: Any = {
        "compute": {"device", "num_gpus", "compile"},
        "optimiser": {"num_steps", "ramp_steps"},
        **dict.fromkeys(("checkpoint_every_steps", "decoding", "num_validation", "start"), True),
    }
    return config.model_dump(mode="json", exclude=exclude)


def _gradients(task: Task, plan: Plan, step: int, loaded: Any) -> dict[str, Tensor]:
    """Compute the gradients of a step. Returns its scalar losses, detached."""
    # processes must not draw the same noise for different rows
    names = [distributed.rank()] if distributed.num_processes() > 1 else []
    torch.manual_seed(derive_seed(plan.seed, "step", step, *names))
    task.module.train()
    losses = task.step(step, loaded)
    task.module.zero_grad()
    losses["loss"].backward()
    distributed.average_gradients(task.module)
    nn.utils.clip_grad_norm_(task.module.parameters(), plan.optimiser.gradient_clip)
    return {name: value.detach() for name, value in losses.items() if value.ndim == 0}


def _validate(task: Task, plan: Plan, step: int) -> dict[str, float]:
    torch.manual_seed(derive_seed(plan.seed, "validate", step))
    module = task.module
    module.eval()
    # batches have other sizes here, for which compiled parts would be compiled again
    with torch.no_grad(), torch.compiler.set_stance("force_eager"):
        measures = task.validate(module)
    log.info("step %d: %s", step, ", ".join(f"{name} {value:.4g}" for name, value in measures.items()))
    return measures


def _any_process_stops(stops: bool, step: int) -> bool:
    """Whether any process is to stop. The processes exchange this only when metrics are due, because GPUs have to wait
    for it."""
    if distributed.num_processes() == 1:
        return stops
    if step % METRICS_EVERY_STEPS:
        return False
    return distributed.average_values({"stop": float(stops)})["stop"] > 0


@contextmanager
def _stop_request() -> Iterator[Callable[[], bool]]:
    """Yields a function that says whether SIGTERM was received or Snakemake has ended; the old handler is restored."""
    received: list[int] = []
    try:
        old = signal.signal(signal.SIGTERM, lambda number, _frame: received.append(number))
    except ValueError:  # not in the main thread: the host handles signals
        yield _workflow_ended
        return
    try:
        yield lambda: bool(received) or _workflow_ended()
    finally:
        signal.signal(signal.SIGTERM, old)


def _workflow_ended() -> bool:
    """Whether the Snakemake that started this process was killed: the next one would train in the same folder."""
    process = os.environ.get(WORKFLOW_VARIABLE, "")
    return process.isdigit() and not is_running(int(process))
