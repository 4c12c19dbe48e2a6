"""A padded batch of buildings in metres, and its patches in network units."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from p2wss.config import Dvae
from p2wss.nets.patches import Patches, make_patches

# Network units per metre: 10 m become 1. Clouds are never scaled to the unit sphere, which would erase heights.
NETWORK_SCALE = 0.1


@dataclass(frozen=True)
class Batch:
    """Buildings in metres, in any local frame, padded to the largest.

    points: float32 (b, p, 3). valid: bool (b, p), false for padding. ground_z: float32 (b,), the ground as
    estimated from the cloud. height: float32 (b,), eave above ground_z. xy: float32 (b, n, 2), exterior ring,
    counter-clockwise. angle: float32 (b, n), degrees, of the edge that leaves each vertex.
    num_vertices: int64 (b,).
    """

    points: Tensor
    valid: Tensor
    ground_z: Tensor
    height: Tensor
    xy: Tensor
    angle: Tensor
    num_vertices: Tensor

    def to(self, device: torch.device) -> Batch:
        """The batch on another device."""
        return Batch(**{name: value.to(device) for name, value in vars(self).items()})

    def __getitem__(self, rows: Tensor) -> Batch:
        return Batch(**{name: value[rows] for name, value in vars(self).items()})


def batch_patches(batch: Batch, config: Dvae) -> Patches:
    """Patches in network units of a centred batch in metres."""
    return make_patches(batch.points * NETWORK_SCALE, batch.valid, config.num_patches, config.patch_size)
