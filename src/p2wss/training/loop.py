"""The training loop of both stages: seeds, checkpoints, metrics, the state that changes while a network trains, its
lock.

Everything random in step i follows from (seed, i) alone. A run that was stopped and resumed therefore takes the
same steps as one that was not, bit for bit on a CPU.
"""

import json
import math
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Protocol

import torch
from filelock import FileLock, Timeout
from torch import Tensor, nn

from p2wss.config import Optimiser, Section
from p2wss.data.seeds import derive_seed
from p2wss.nets import distributed
from p2wss.storage import files, integrity
from p2wss.storage.messages import InputError, log
from p2wss.storage.progress import Progress
from p2wss.storage.temporary import is_running

METRICS_EVERY_STEPS = 20
# environment variable with the process of the Snakemake that started this one, see workflow/rules/common.smk
WORKFLOW_VARIABLE = "P2WSS_WORKFLOW_PROCESS"
METRICS_NAME = "metrics.jsonl"
MAX_CHECKPOINTS = 2
# a training whose Snakemake was killed stops at its next step; the following training waits for it this long
_PATIENCE_S = 60.0


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


@contextmanager
def training_lock(checkpoints: Path, patience_s: float = _PATIENCE_S) -> Iterator[None]:
    """Hold the folder of a training, by a file beside it. The lock ends with the process, however the process ends.

    If a training has several processes, the main one holds the lock. If another training holds the folder, this waits
    for ``patience_s``, as that training may be about to stop. Raises :class:`InputError` if it goes on, or if the file
    cannot be written.
    """
    if not distributed.is_main_process():
        yield
        return
    path = checkpoints.absolute().with_name(f"{checkpoints.absolute().name}.lock")
    lock = FileLock(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            log.info("%s: another training runs in this folder; waiting for it to stop", checkpoints)
            lock.acquire(timeout=patience_s, poll_interval=0.2)
    except Timeout:
        raise InputError(f"{checkpoints}: another training runs in this folder") from None
    except OSError as error:
        raise InputError(f"{path}: not written: {error.strerror or error}") from error
    try:
        yield
    finally:
        # while no other training can begin; removes the folder only if it is empty
        with suppress(OSError):
            checkpoints.rmdir()
        path.unlink(missing_ok=True)
        lock.release()
