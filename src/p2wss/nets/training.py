"""The one training loop of both stages: seeds, checkpoints, metrics.

Everything random in step i follows from (seed, i) alone, so a run that was stopped and resumed takes the
same steps, to the bit on a CPU, as one that was not.
"""

from __future__ import annotations

import json
import logging
import math
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from p2wss.config import Compute, Optimiser, Section
from p2wss.data import files
from p2wss.data.seeds import derive_seed
from p2wss.errors import InputError
from p2wss.nets import parallel

log = logging.getLogger("p2wss")

NUM_CHECKPOINTS_KEPT = 2
PROGRESS_EVERY_S = 10.0
METRICS_EVERY_STEPS = 20


@dataclass(frozen=True)
class Plan:
    """How to train: seed, optimiser, decay of the averaged weights (0 = none), and when to look and save."""

    seed: int
    optimiser: Optimiser
    ema_decay: float
    checkpoint_every_steps: int
    compute: Compute


class Task(Protocol):
    """What to train."""

    @property
    def module(self) -> nn.Module:
        """The weights."""
        ...

    def step(self, step: int) -> dict[str, Tensor]:
        """Losses of the batch of ``step``; the one named ``loss`` is minimised, the others are logged."""

    def validate(self, module: nn.Module) -> dict[str, float]:
        """Measures of ``module`` (the averaged weights, where there are such) on held-out data."""

    def heavy_parts(self) -> Sequence[nn.Module]:
        """The parts of ``module`` that are worth compiling."""


def train(task: Task, plan: Plan, checkpoints: Path, identity: dict[str, Any]) -> nn.Module:
    """Train ``task.module`` for ``plan.optimiser.num_steps`` steps and return the weights to keep.

    Checkpoints and ``metrics.jsonl`` are written to the folder ``checkpoints``. If it holds a checkpoint of
    the same ``identity`` (config, code, data; JSON values), training continues there; one of another
    identity is discarded. On SIGTERM a checkpoint is written and the process exits with status 0.
    Of several processes (see :mod:`parallel`) the first one writes.
    Raises :class:`InputError` when the loss is no longer finite.
    """
    state = _State.new(task.module, plan)
    if plan.compute.compile:
        for part in task.heavy_parts():
            part.compile()
    metrics = _Metrics(checkpoints / "metrics.jsonl", plan.compute.tensorboard)
    start = state.resume(checkpoints, identity)
    metrics.keep_until(start)
    num_steps = plan.optimiser.num_steps
    progress = _Progress(start, num_steps, plan.optimiser.batch_size)
    with _termination() as received:
        for step in range(start, num_steps):
            rate = learning_rate(step, plan.optimiser)
            losses = _take_step(task, state, plan, step, rate)
            done = step + 1
            due = done % plan.checkpoint_every_steps == 0 or done == num_steps
            if done % METRICS_EVERY_STEPS == 0 or due:
                values = parallel.average_values({name: float(value) for name, value in losses.items()})
                if not math.isfinite(values["loss"]):
                    raise InputError(
                        f"training: the loss is {values['loss']} at step {done}: lower the learning rate"
                    )
                metrics.add({"step": done, "learning_rate": rate, **values})
                progress.show(done, values["loss"])
            if due:
                metrics.add({"step": done, **_validate(task, state, plan, done)})
            stop = _all_stop(received(), done) and done < num_steps
            if due or stop:
                state.save(checkpoints, done, identity)
            if stop:
                log.info("stopped at step %d of %d; the next run continues there", done, num_steps)
                raise SystemExit(0)
    return state.kept


def _all_stop(received: bool, done: int) -> bool:
    """Whether any process was told to stop. They ask one another now and then only: it makes GPUs wait."""
    if parallel.num_processes() == 1:
        return received
    if done % METRICS_EVERY_STEPS:
        return False
    return parallel.average_values({"stop": float(received)})["stop"] > 0


def learning_rate(step: int, optimiser: Optimiser) -> float:
    """Cosine warm-up from 0, then cosine decay to ``learning_rate_end`` (paper, section 5.2)."""
    warmup = max(round(optimiser.warmup_share * optimiser.num_steps), 1)
    if step < warmup:
        return optimiser.learning_rate * (1 - math.cos(math.pi * (step + 1) / warmup)) / 2
    share = (step - warmup) / max(optimiser.num_steps - warmup, 1)
    low, high = optimiser.learning_rate_end, optimiser.learning_rate
    return low + (high - low) * (1 + math.cos(math.pi * share)) / 2


def writes() -> bool:
    """Whether this process writes the results: of those that torchrun starts, the first one."""
    return os.environ.get("RANK", "0") == "0"


def cache_folder(checkpoints: Path) -> Path:
    """Where the shards are decoded to, see :func:`dataset.load`."""
    return checkpoints / "clouds"


def what_is_learnt(config: Section) -> dict[str, Any]:
    """The config of a training without what may change from one run of it to the next."""
    return config.model_dump(
        mode="json", exclude={"compute": {"device", "compile", "resident", "tensorboard"}}
    )


def remove_checkpoints(checkpoints: Path) -> None:
    """Remove what :func:`train` wrote to the folder, and the folder if nothing else is in it."""
    shutil.rmtree(cache_folder(checkpoints), ignore_errors=True)
    for path in [*_steps(checkpoints).values(), checkpoints / "metrics.jsonl"]:
        path.unlink(missing_ok=True)
    if checkpoints.is_dir() and not any(checkpoints.iterdir()):
        checkpoints.rmdir()


def read_metrics(checkpoints: Path) -> str:
    """The metrics of a finished training, one JSON object per line."""
    return (checkpoints / "metrics.jsonl").read_text()


def last_measures(metrics: str) -> dict[str, float]:
    """The last validation among lines of metrics."""
    records = [json.loads(line) for line in metrics.splitlines()]
    found = [record for record in records if any(name.startswith("val_") for name in record)]
    return found[-1] if found else {}


def _take_step(task: Task, state: _State, plan: Plan, step: int, rate: float) -> dict[str, Tensor]:
    # processes must not draw the same noise for different rows
    own = [parallel.rank()] if parallel.num_processes() > 1 else []
    torch.manual_seed(derive_seed(plan.seed, "step", step, *own))
    task.module.train()
    for group in state.optimiser.param_groups:
        group["lr"] = rate
    losses = task.step(step)
    state.optimiser.zero_grad(set_to_none=True)
    losses["loss"].backward()
    parallel.average_gradients(task.module)
    nn.utils.clip_grad_norm_(task.module.parameters(), plan.optimiser.gradient_clip)
    state.optimiser.step()
    state.average(step)
    return {name: value.detach() for name, value in losses.items() if value.ndim == 0}


def _validate(task: Task, state: _State, plan: Plan, step: int) -> dict[str, float]:
    torch.manual_seed(derive_seed(plan.seed, "validate", step))
    module = state.kept
    module.eval()
    with torch.no_grad():
        measures = task.validate(module)
    log.info("step %d: %s", step, ", ".join(f"{name} {value:.4g}" for name, value in measures.items()))
    return measures


@dataclass
class _State:
    """All that changes while training."""

    module: nn.Module
    average_module: nn.Module | None
    optimiser: torch.optim.Optimizer
    ema_decay: float

    @classmethod
    def new(cls, module: nn.Module, plan: Plan) -> _State:
        decayed: list[nn.Parameter] = []
        plain: list[nn.Parameter] = []
        for name, parameter in module.named_parameters():
            if parameter.requires_grad:
                (decayed if _is_decayed(module, name, parameter) else plain).append(parameter)
        optimiser = torch.optim.AdamW(
            [
                {"params": decayed, "weight_decay": plan.optimiser.weight_decay},
                {"params": plain, "weight_decay": 0.0},
            ],
            lr=plan.optimiser.learning_rate,
            betas=(0.9, plan.optimiser.beta2),
            foreach=True,
        )
        average = None
        if plan.ema_decay > 0:
            average = deepcopy(module).requires_grad_(False)
        return cls(module, average, optimiser, plan.ema_decay)

    @property
    def kept(self) -> nn.Module:
        return self.module if self.average_module is None else self.average_module

    @torch.no_grad()
    def average(self, step: int) -> None:
        if self.average_module is None:
            return
        # short memory at first: the initial weights must not linger
        decay = min(self.ema_decay, (1 + step) / (10 + step))
        for mean, weight in zip(self.average_module.parameters(), self.module.parameters(), strict=True):
            mean.lerp_(weight, 1 - decay)
        for ours, new in zip(self.average_module.buffers(), self.module.buffers(), strict=True):
            ours.copy_(new)

    def save(self, folder: Path, step: int, identity: dict[str, Any]) -> None:
        if parallel.rank():
            return
        state = {
            "step": step,
            "identity": json.dumps(identity, sort_keys=True),
            "module": self.module.state_dict(),
            "average": None if self.average_module is None else self.average_module.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        # through memory: torch reports a full disk as some RuntimeError
        buffer = BytesIO()
        torch.save(state, buffer)
        with files.atomic(folder / f"step-{step:08d}.pt") as temporary:
            temporary.write_bytes(buffer.getbuffer())
        for old in sorted(_steps(folder))[:-NUM_CHECKPOINTS_KEPT]:
            _steps(folder)[old].unlink()

    def resume(self, folder: Path, identity: dict[str, Any]) -> int:
        """Load the latest checkpoint; returns its step, or 0."""
        wanted = json.dumps(identity, sort_keys=True)
        for step, path in sorted(_steps(folder).items(), reverse=True):
            try:
                state = torch.load(path, map_location="cpu", weights_only=True)
            except Exception as error:
                log.warning("%s: not readable (%s): trying the one before", path, type(error).__name__)
                continue
            if state["identity"] != wanted:
                log.warning("%s: of another configuration, code or data: starting afresh", folder)
                break
            self.module.load_state_dict(state["module"])
            if self.average_module is not None:
                self.average_module.load_state_dict(state["average"])
            self.optimiser.load_state_dict(state["optimiser"])
            log.info("continuing at step %d", step)
            return step
        parallel.barrier()  # every process has looked
        if parallel.rank() == 0:
            for path in _steps(folder).values():
                path.unlink()
        return 0


def _is_decayed(module: nn.Module, name: str, parameter: Tensor) -> bool:
    """Weights of linear layers only: no biases, norms, tokens, codebooks, embeddings."""
    owner = module.get_submodule(name.rpartition(".")[0])
    return parameter.ndim > 1 and isinstance(owner, nn.Linear)


def _steps(folder: Path) -> dict[int, Path]:
    return {int(path.stem.removeprefix("step-")): path for path in folder.glob("step-*.pt")}


class _Metrics:
    """Lines of JSON in a file that survives an interruption; of several processes the first one writes."""

    def __init__(self, path: Path, tensorboard: bool) -> None:
        self.path = path
        self.writer: Any = _tensorboard(path.parent) if tensorboard and parallel.rank() == 0 else None

    def keep_until(self, step: int) -> None:
        """Forget what was written after ``step``: it will be written again."""
        if parallel.rank():
            return
        lines = self.path.read_text().splitlines() if step and self.path.exists() else []
        kept = [line for line in lines if json.loads(line)["step"] <= step]
        with files.atomic(self.path) as temporary:
            temporary.write_text("".join(line + "\n" for line in kept))

    def add(self, values: dict[str, Any]) -> None:
        if parallel.rank():
            return
        if self.writer is not None:
            for name in values.keys() - {"step"}:
                self.writer.add_scalar(name, values[name], values["step"])
            self.writer.flush()
        try:
            with open(self.path, "a") as file:
                file.write(json.dumps(values) + "\n")
        except OSError as error:
            raise InputError(f"{self.path}: not written: {error.strerror or error}") from error


def _tensorboard(folder: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise InputError(
            "compute.tensorboard: TensorBoard is not installed: pip install tensorboard"
        ) from error
    return SummaryWriter(str(folder / "tensorboard"))


class _Progress:
    """A line every few seconds: step, loss, samples per second, time left."""

    def __init__(self, start: int, num_steps: int, batch_size: int) -> None:
        self.start, self.num_steps, self.batch_size = start, num_steps, batch_size
        self.began = self.shown = time.monotonic()

    def show(self, step: int, loss: float) -> None:
        now = time.monotonic()
        if now - self.shown < PROGRESS_EVERY_S and step < self.num_steps:
            return
        self.shown = now
        per_step = (now - self.began) / max(step - self.start, 1)
        log.info(
            "step %d/%d  loss %.4f  %.0f samples/s  %.0f s left",
            step,
            self.num_steps,
            loss,
            self.batch_size / max(per_step, 1e-9),
            per_step * (self.num_steps - step),
        )


@contextmanager
def _termination() -> Iterator[Callable[[], bool]]:
    """Yields a function that tells whether SIGTERM has come; the old handler is restored."""
    received: list[int] = []
    try:
        old = signal.signal(signal.SIGTERM, lambda number, _frame: received.append(number))
    except ValueError:  # not in the main thread: the host handles signals
        yield lambda: False
        return
    try:
        yield lambda: bool(received)
    finally:
        signal.signal(signal.SIGTERM, old)
