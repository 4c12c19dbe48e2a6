"""The device that tensors are on, and the precision of matrix products."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager

import torch

from p2wss.config import Compute, DeviceName
from p2wss.storage.errors import InputError


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


def autocast(compute: Compute, device: torch.device) -> AbstractContextManager[object]:
    """Matrix products in bfloat16 if the config says so. Weights stay float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=compute.precision == "bfloat16")
