"""Clouds to patches: farthest point sampling and k nearest neighbours (paper, section 4.2; Point-BERT).

Padded points never become a centre or a neighbour. This is plain torch: the usual compiled operation skips points
near the origin (Pointnet2_PyTorch #157), and with 64 centres per cloud it would hardly be faster.
"""

from __future__ import annotations

from dataclasses import dataclass

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
    # contiguous copies per axis make each step a few fused passes
    xyz = points.masked_fill(~valid[..., None], torch.inf).permute(2, 0, 1).contiguous()
    to_nearest = torch.where(valid, torch.inf, -1.0).to(points.dtype)
    steps, offset, distance = [], torch.empty_like(xyz), points.new_empty(num_centres, *valid.shape)
    for to_current in distance:
        steps.append(to_nearest.max(1, keepdim=True))
        torch.sub(xyz, xyz.gather(2, steps[-1].indices.expand(3, -1, -1)), out=offset).square_()
        torch.sum(offset, 0, out=to_current)
        torch.minimum(to_nearest, to_current, out=to_nearest)
    farthest, chosen = (torch.cat(each, 1) for each in zip(*steps, strict=True))
    return chosen, farthest > 0, distance.transpose(0, 1)


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


def make_patches(points: Tensor, valid: Tensor, num_patches: int, patch_size: int) -> Patches:
    """Cut clouds (b, p, 3) into patches, each with its centre first; ``valid`` (b, p) is false for padding."""
    _, distinct, distance = farthest_points(points, valid, num_patches)
    index = nearest_points(distance, patch_size)
    neighbours = points.gather(1, index.flatten(1)[..., None].expand(-1, -1, 3)).unflatten(1, index.shape[1:])
    centre = neighbours[:, :, 0]
    return Patches(centre, neighbours - centre[:, :, None], distinct)
