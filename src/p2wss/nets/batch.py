"""A padded batch of buildings in metres, and its patches in network units."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from p2wss.nets.patches import Patches, cut_patches, make_patches, patch_index

# Network units per metre: 10 m become 1. Clouds are never scaled to the unit sphere, which would erase heights.
NETWORK_SCALE = 0.1
# Fills the rows of a patch_index that are not computed yet. No index, nor ~index, of 32,767 points has this value.
UNKNOWN_PATCHES = -(2**15)


@dataclass(frozen=True)
class Batch:
    """Buildings in metres, in any local frame, padded to the largest.

    points: float32 (b, p, 3). valid: bool (b, p), false for padding. ground_z: float32 (b,), the ground as
    estimated from the cloud. height: float32 (b,), eave above ground_z. xy: float32 (b, n, 2), exterior ring,
    counter-clockwise. angle: float32 (b, n), degrees, of the edge that leaves each vertex.
    num_vertices: int64 (b,). patch_index: int16 (b, g, k), the :func:`~p2wss.nets.patches.patch_index` of each
    cloud where it was precomputed, and ``UNKNOWN_PATCHES`` in the other rows. A change of a cloud's shape or of
    its set of points drops it.
    """

    points: Tensor
    valid: Tensor
    ground_z: Tensor
    height: Tensor
    xy: Tensor
    angle: Tensor
    num_vertices: Tensor
    patch_index: Tensor | None = None

    def to(self, device: torch.device) -> Batch:
        """The batch on another device."""
        return Batch(**{name: value.to(device) for name, value in vars(self).items() if value is not None})

    def __getitem__(self, rows: Tensor) -> Batch:
        return Batch(**{name: value[rows] for name, value in vars(self).items() if value is not None})


def batch_patches(batch: Batch, num_patches: int, patch_size: int) -> Patches:
    """Patches in network units of a centred batch in metres."""
    points = batch.points * NETWORK_SCALE
    if batch.patch_index is None:
        return make_patches(points, batch.valid, num_patches, patch_size)
    index = batch.patch_index.long()
    (rows,) = torch.nonzero(index[:, 0, 0] == UNKNOWN_PATCHES, as_tuple=True)
    if len(rows):
        index[rows] = patch_index(points[rows], batch.valid[rows], num_patches, patch_size)
    return cut_patches(points, index)
