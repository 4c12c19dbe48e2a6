"""The device that tensors are on, and the precision of matrix products."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor, nn

from p2wss.config import Compute, DeviceName
from p2wss.nets import distributed
from p2wss.storage.errors import InputError

P, T = ParamSpec("P"), TypeVar("T")


def device_of(name: DeviceName) -> torch.device:
    """The device of that name; "auto" is CUDA where available. Each process of torchrun gets a GPU of its own.

    Raises :class:`InputError` for "cuda" without a GPU.
    """
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise InputError("device cuda: torch finds no GPU; install torch with CUDA, or use --device cpu")
    if name == "cpu" or not available:
        return torch.device("cpu")
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
    torch.cuda.set_device(device)
    return device


def staged(tensor: Tensor, device: torch.device) -> Tensor:
    """The tensor in memory from which a copy to ``device`` does not keep the host waiting."""
    return tensor.pin_memory() if device.type == "cuda" else tensor


def compiled(function: Callable[P, T], device: torch.device) -> Callable[P, T]:
    """The function, compiled on a GPU, for one size of batches."""
    return _compiled(function) if device.type == "cuda" else function


@cache
def _compiled(function: Any) -> Any:
    return torch.compile(function)


def compile_parts(module: nn.Module, kinds: tuple[type[nn.Module], ...]) -> None:
    """Compile the parts of these kinds, on a GPU: their many small operations become few.

    Not of several processes, which exchange the moments of batch norms within a part.
    """
    if next(module.parameters()).device.type == "cuda" and distributed.num_processes() == 1:
        for part in module.modules():
            if isinstance(part, kinds):
                part.compile(dynamic=True)


def autocast(compute: Compute, device: torch.device) -> AbstractContextManager[object]:
    """Matrix products in bfloat16 if the config says so. Weights stay float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=compute.precision == "bfloat16")
