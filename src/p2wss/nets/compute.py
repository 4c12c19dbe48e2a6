"""The device that tensors are on, and the precision of matrix products."""

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache
from types import MethodType
from typing import Any

import torch
from torch import Tensor, nn

from p2wss.config import Compute, DeviceName
from p2wss.nets import distributed
from p2wss.storage.messages import InputError

# backend of torch.compile
COMPILER = "inductor"


def device_of(name: DeviceName) -> torch.device:
    """The device named ``name``; "auto" is CUDA where available. Each process of torchrun gets a GPU of its own.

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


@cache
def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, compiled when it is called: many small operations become few. It is traced as a whole."""
    return torch.compile(function, dynamic=True, fullgraph=True, backend=COMPILER)


def compile_parts(module: nn.Module, kinds: tuple[type[nn.Module], ...]) -> None:
    """Compile the parts of ``module`` that have one of these classes; parts of one class share their code.

    With several processes nothing is compiled, as they exchange the moments of batch norms within a part.
    """
    if distributed.num_processes() > 1:
        return
    for part in module.modules():
        if isinstance(part, kinds):
            part.forward = MethodType(compiled(type(part).forward), part)


def autocast(compute: Compute, device: torch.device) -> AbstractContextManager[object]:
    """Matrix products in bfloat16 if the config says so. Weights stay float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=compute.precision == "bfloat16")
