"""Training on several processes (torchrun).

Each process takes some rows of a batch. Losses are defined so that the mean of the losses and the mean of the gradients
over the processes are the same as in a single process with the whole batch. Sums are divided by counts averaged over
the processes, batch norms use the moments over all processes, and losses over pairs see the features of all processes.
"""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn

from p2wss.storage.messages import log


def num_processes() -> int:
    """The number of processes that train together, 1 outside of :func:`process_group`."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """The number of this process in its group, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


@contextmanager
def process_group(device: torch.device) -> Iterator[None]:
    """Join the processes that torchrun started, if any: NCCL between GPUs, gloo between CPUs."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or dist.is_initialized():
        yield
        return
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    if rank():
        log.setLevel(logging.WARNING)  # the main process reports the progress
    try:
        yield
    finally:
        dist.destroy_process_group()


def is_main_process() -> bool:
    """Whether this process writes the results. Also valid outside of :func:`process_group`."""
    return os.environ.get("RANK", "0") == "0"


def barrier() -> None:
    """Wait until all processes are here."""
    if num_processes() > 1:
        dist.barrier()


def shard(index: np.ndarray) -> np.ndarray:
    """The rows of a batch (n,) that this process takes: the same number each, without the remainder."""
    count = num_processes()
    return index[: len(index) // count * count][rank() :: count]


def average_count(count: Tensor) -> Tensor:
    """A count averaged over the processes, at least 1 in total: the divisor of the sum of each process."""
    if num_processes() == 1:
        return count.clamp(min=1)
    total = count.clone()
    dist.all_reduce(total)
    return total.clamp(min=1) / num_processes()


def average_values(values: dict[str, float]) -> dict[str, float]:
    """Values averaged over the processes."""
    if num_processes() == 1:
        return values
    device = torch.device("cuda") if dist.get_backend() == "nccl" else torch.device("cpu")
    total = torch.tensor(list(values.values()), dtype=torch.float64, device=device)
    dist.all_reduce(total)
    return dict(zip(values, (total / num_processes()).tolist(), strict=True))


def average_gradients(module: nn.Module) -> None:
    """Replace every gradient by its mean over the processes, in a single reduction."""
    if num_processes() == 1:
        return
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    dist.all_reduce(flat)
    flat /= num_processes()
    for gradient, mean in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
        gradient.copy_(mean.view_as(gradient))


def average(x: Tensor) -> Tensor:
    """The differentiable mean over the processes."""
    return x if num_processes() == 1 else _Sum.apply(x) / num_processes()


def gather(x: Tensor) -> Tensor:
    """The rows (b, ...) of all processes; each gradient goes back to the process of its row."""
    if num_processes() == 1:
        return x
    parts = [x if number == rank() else torch.zeros_like(x) for number in range(num_processes())]
    return _Sum.apply(torch.cat(parts))


class _Sum(torch.autograd.Function):
    """The sum over the processes. Torch's own is deprecated or private."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        total = x.clone(memory_format=torch.contiguous_format)
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return _Sum.forward(ctx, gradient)
