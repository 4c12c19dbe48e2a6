"""Clouds to patches: farthest point sampling and k nearest neighbours (paper, section 4.2; Point-BERT).

Padded points never become a centre or a neighbour. This is plain torch: the usual compiled operation skips points
near the origin (Pointnet2_PyTorch #157), and with 64 centres per cloud it would hardly be faster.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Patches:
    """Patches of a batch of clouds.

    centre: float32 (b, g, 3). points: float32 (b, g, k, 3), relative to the centre. valid: bool (b, g), false
    for the surplus patches of a cloud with fewer than g distinct points: they repeat others and are masked everywhere.
    """

    centre: Tensor
    points: Tensor
    valid: Tensor

    def __getitem__(self, rows: slice) -> Patches:
        return Patches(self.centre[rows], self.points[rows], self.valid[rows])


def farthest_points(points: Tensor, valid: Tensor, num_centres: int) -> tuple[Tensor, Tensor, Tensor]:
    """Farthest point sampling that starts at the first valid point.

    ``points`` (b, p, 3), ``valid`` (b, p) with at least one true per row. Returns int64 (b, num_centres)
    indices, bool (b, num_centres), false once every valid point coincides with a chosen one, and the squared
    distances (b, num_centres, p) of all points from each chosen one, infinite for padding.
    """
    if len(points) == 1 and points.device.type == "cpu" and valid.all():
        return _farthest_points_of_cloud(points, num_centres)
    # contiguous copies per axis make each step a few fused passes
    x, y, z = points.masked_fill(~valid[..., None], torch.inf).permute(2, 0, 1).contiguous()
    to_nearest = torch.where(valid, torch.inf, -1.0).to(points.dtype)
    chosen, distinct, distance = [], [], points.new_empty(num_centres, *valid.shape)
    for to_current in distance:
        farthest, current = to_nearest.max(1, keepdim=True)
        chosen.append(current)
        distinct.append(farthest > 0)
        torch.sub(x, x.gather(1, current), out=to_current).square_()
        to_current += (y - y.gather(1, current)).square_()
        to_current += (z - z.gather(1, current)).square_()
        torch.minimum(to_nearest, to_current, out=to_nearest)
    return torch.cat(chosen, 1), torch.cat(distinct, 1), distance.transpose(0, 1)


def _farthest_points_of_cloud(points: Tensor, num_centres: int) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`farthest_points` of one cloud (1, p, 3) without padding, to the bit; five times as fast, because numpy
    takes less time to start an operation."""
    xyz = np.ascontiguousarray(points[0].numpy().T)
    to_nearest, difference = np.full(xyz.shape[1], np.inf, xyz.dtype), np.empty_like(xyz)
    chosen, distinct = np.empty(num_centres, np.int64), np.empty(num_centres, bool)
    distance = np.empty((num_centres, xyz.shape[1]), xyz.dtype)
    for centre, to_current in enumerate(distance):
        current = to_nearest.argmax()
        chosen[centre], distinct[centre] = current, to_nearest[current] > 0
        np.subtract(xyz, xyz[:, current, None], out=difference)
        x, y, z = np.square(difference, out=difference)
        np.add(np.add(x, y, out=to_current), z, out=to_current)
        np.minimum(to_nearest, to_current, out=to_nearest)
    return torch.from_numpy(chosen)[None], torch.from_numpy(distinct)[None], torch.from_numpy(distance)[None]


def nearest_points(distance: Tensor, k: int) -> Tensor:
    """int64 (b, g, k): the k points nearest to each of g centres; the nearest is repeated if there are fewer than k.

    ``distance`` (b, g, p) as :func:`farthest_points` returns it: infinite for padding.
    """
    if distance.shape[-1] < k:
        pad = distance.new_full((*distance.shape[:2], k - distance.shape[-1]), torch.inf)
        distance = torch.cat([distance, pad], 2)
    near, index = distance.topk(k, largest=False, sorted=True)
    return torch.where(near.isinf(), index[..., :1], index)


def squared_distance(a: Tensor, b: Tensor) -> Tensor:
    """(.., n, m) squared distances of points (.., n, 3) and (.., m, 3), without cancellation."""
    total = (a[..., :, None, 0] - b[..., None, :, 0]).square_()
    for axis in (1, 2):
        total += (a[..., :, None, axis] - b[..., None, :, axis]).square_()
    return total


def patch_index(points: Tensor, valid: Tensor, num_patches: int, patch_size: int) -> Tensor:
    """int64 (b, g, k): the points of each patch, its centre first; ``~index`` for a patch that repeats another.

    ``points`` (b, p, 3), ``valid`` (b, p). Rotating, mirroring, scaling or moving a cloud does not change it.
    """
    _, distinct, distance = farthest_points(points, valid, num_patches)
    index = nearest_points(distance, patch_size)
    return torch.where(distinct[..., None], index, ~index)


def cut_patches(points: Tensor, index: Tensor) -> Patches:
    """The patches of clouds (b, p, 3) from their :func:`patch_index` (b, g, k)."""
    distinct = index[..., 0] >= 0
    index = torch.where(distinct[..., None], index, ~index)
    neighbours = points.gather(1, index.flatten(1)[..., None].expand(-1, -1, 3)).unflatten(1, index.shape[1:])
    centre = neighbours[:, :, 0]
    return Patches(centre, neighbours - centre[:, :, None], distinct)


def make_patches(points: Tensor, valid: Tensor, num_patches: int, patch_size: int) -> Patches:
    """Cut clouds (b, p, 3) into patches; ``valid`` (b, p) is false for padding."""
    return cut_patches(points, patch_index(points, valid, num_patches, patch_size))
