"""On which device tensors live and how precisely they are multiplied."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from typing import Literal

import torch

from p2wss.config import Compute
from p2wss.errors import InputError

DeviceName = Literal["auto", "cpu", "cuda"]


def device_of(name: DeviceName) -> torch.device:
    """The device of that name; "auto" is CUDA where there is some. Each process of torchrun gets its own GPU.

    Raises :class:`InputError` for "cuda" where there is none.
    """
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise InputError("device cuda: torch finds no GPU; install torch with CUDA, or take --device cpu")
    if name == "cpu" or not available:
        return torch.device("cpu")
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
    torch.cuda.set_device(device)
    return device


def autocast(compute: Compute, device: torch.device) -> AbstractContextManager[object]:
    """Matrix products in bfloat16, where the config asks for it. Weights stay float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=compute.precision == "bfloat16")
