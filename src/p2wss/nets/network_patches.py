"""Patches of a batch of clouds, in network units."""

from __future__ import annotations

import torch

from p2wss.nets import augment
from p2wss.nets.augment import Batch
from p2wss.nets.patches import Patches, cut_patches, make_patches, patch_index

# metres to network units: 10 m = 1 (never the unit sphere, which would erase heights)
SCALE = 0.1


def patches_of(batch: Batch, num_patches: int, patch_size: int) -> Patches:
    """Patches in network units of a centred batch in metres."""
    points = batch.points * SCALE
    if batch.patch_index is None:
        return make_patches(points, batch.valid, num_patches, patch_size)
    index = batch.patch_index.long()
    (rows,) = torch.nonzero(index[:, 0, 0] == augment.UNKNOWN, as_tuple=True)
    if len(rows):
        index[rows] = patch_index(points[rows], batch.valid[rows], num_patches, patch_size)
    return cut_patches(points, index)
