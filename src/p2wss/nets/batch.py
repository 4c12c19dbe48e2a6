"""A padded batch of buildings in metres, its patches in network units, and the points of a cloud that it holds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from p2wss.config import Dvae
from p2wss.nets import compute
from p2wss.nets.patches import Patches, make_patches
from p2wss.skeleton.compiled import both, entry

# Network units per metre: 10 m become 1. Clouds are never scaled to the unit sphere, which would erase heights.
NETWORK_SCALE = 0.1
_MASK_64 = (1 << 64) - 1
# spreads the seeds of the random numbers
SEED_STRIDE = 0xD1342543DE82EF95


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
        return Batch(**{name: value.to(device, non_blocking=True) for name, value in vars(self).items()})

    def staged(self, device: torch.device) -> Batch:
        """The batch in memory from which a copy to ``device`` does not keep the host waiting."""
        return Batch(**{name: compute.staged(value, device) for name, value in vars(self).items()})

    def __getitem__(self, rows: Tensor) -> Batch:
        return Batch(**{name: value[rows] for name, value in vars(self).items()})

    def replaced_by(self, other: Batch, is_replaced: Tensor) -> Batch:
        """The batch with the rows ``is_replaced``, bool (b,), taken from ``other``, a batch of the same sizes."""
        return Batch(
            **{
                name: torch.where(is_replaced.view(-1, *[1] * (own.ndim - 1)), getattr(other, name), own)
                for name, own in vars(self).items()
            }
        )


def batch_patches(batch: Batch, config: Dvae) -> Patches:
    """Patches in network units of a centred batch in metres."""
    return make_patches(batch.points * NETWORK_SCALE, batch.valid, config.num_patches, config.patch_size)


def centre(batch: Batch) -> Batch:
    """Move cloud, footprint and ground so that the centroid of the points is the origin (section 5.2)."""
    count = batch.valid.sum(1, keepdim=True)
    centroid = (batch.points * batch.valid[..., None]).sum(1) / count
    return replace(
        batch,
        points=(batch.points - centroid[:, None]) * batch.valid[..., None],
        xy=batch.xy - centroid[:, None, :2],
        ground_z=batch.ground_z - centroid[:, 2],
    )


def cut(
    points_cm: np.ndarray, first: np.ndarray, count: np.ndarray, num_points: int, seeds: np.ndarray
) -> np.ndarray:
    """Random points of b clouds in metres, float32 (b, p, 3), 0 for padding.

    Cloud i has the ``count[i]`` rows of ``points_cm`` from ``first[i]`` on, of which at most ``num_points`` are drawn.
    seeds: uint64 (b,), the state of the random numbers of each cloud.
    """
    num_kept = np.minimum(count, num_points)
    points = np.zeros((len(count), num_kept.max(), 3), np.float32)
    _cut(points_cm, first, count, num_kept, seeds, points)
    return points


def thin(count: int, num_points: int, state: int | None = None) -> np.ndarray:
    """Indices of at most ``num_points`` of ``count`` points, drawn from the ``state`` of the random numbers; without a
    state, the draw depends on ``count`` alone."""
    selected = np.empty(min(count, num_points), np.int64)
    state = count * SEED_STRIDE if state is None else state
    _select(count, np.uint64(state & _MASK_64), selected)
    return selected


@entry
def _cut(
    points_cm: np.ndarray,
    first: np.ndarray,
    count: np.ndarray,
    num_kept: np.ndarray,
    seeds: np.ndarray,
    points: np.ndarray,
) -> None:
    for row in range(len(first)):
        selected = np.empty(num_kept[row], np.int64)
        _select(count[row], seeds[row], selected)
        for number in range(num_kept[row]):
            for axis in range(3):
                value = points_cm[first[row] + selected[number], axis]
                points[row, number, axis] = np.float32(value) * np.float32(0.01)


@both
def _select(count: int, state: Any, selected: np.ndarray) -> None:
    """Fill ``selected`` with a random subset of ``range(count)``, each equally likely, in ascending order.

    Selection sampling (Knuth, The Art of Computer Programming, algorithm 3.4.2 S); random numbers: splitmix64.
    """
    size = len(selected)
    num_selected = 0
    for i in range(count):
        if count - i > size - num_selected:
            state += np.uint64(0x9E3779B97F4A7C15)
            z = state
            z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            z = z ^ (z >> np.uint64(31))
            if np.float64(z >> np.uint64(11)) * 2.0**-53 * (count - i) >= size - num_selected:
                continue
        selected[num_selected] = i
        num_selected += 1
        if num_selected == size:
            return
