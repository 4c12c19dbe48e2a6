"""Random augmentations of whole batches that keep clouds and their parameters consistent."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from p2wss.nets.batch import Batch

_HALF_WEDGE_DEG = (5, 30)  # half the width of a wedge without points


def rotate(batch: Batch, theta: Tensor) -> Batch:
    """Rotate clouds and footprints by ``theta`` (b,) radians about the vertical through the origin."""
    cos, sin = torch.cos(theta), torch.sin(theta)
    matrix = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -2)
    xy = batch.points[..., :2] @ matrix
    return replace(
        batch,
        points=torch.cat([xy, batch.points[..., 2:]], -1),
        xy=batch.xy @ matrix,
    )


def rotate_randomly(batch: Batch) -> Batch:
    """Rotate each building by a random angle about the vertical through the origin."""
    return rotate(batch, 2 * math.pi * torch.rand(len(batch.points), device=batch.points.device))


def scale_randomly(batch: Batch, ratio: tuple[float, float]) -> Batch:
    """Scale each building as a whole by a factor drawn from ``ratio``: angles stay, heights follow."""
    low, high = ratio
    factor = low + (high - low) * torch.rand(len(batch.points), device=batch.points.device)
    return replace(
        batch,
        points=batch.points * factor[:, None, None],
        xy=batch.xy * factor[:, None, None],
        ground_z=batch.ground_z * factor,
        height=batch.height * factor,
    )


def jitter(batch: Batch, sigma_m: float) -> Batch:
    """Gaussian noise on the valid points."""
    noise = torch.randn_like(batch.points) * sigma_m
    return replace(batch, points=batch.points + noise * batch.valid[..., None])


def lift_randomly(batch: Batch, lift_m: float) -> Batch:
    """Raise or lower the upper part of each building by up to ``lift_m``, and its eave with it.

    Points above half the eave height move, downwards by at most a third of that height: walls are stretched or
    compressed, the roof keeps its shape.
    """
    lift = lift_m * (2 * torch.rand(len(batch.points), device=batch.points.device) - 1)
    lift = torch.maximum(lift, -batch.height / 3)
    above = batch.points[..., 2] - batch.ground_z[:, None] > batch.height[:, None] / 2
    z = batch.points[..., 2] + lift[:, None] * (above & batch.valid)
    points = torch.cat([batch.points[..., :2], z[..., None]], -1)
    return replace(batch, points=points, height=batch.height + lift)


def occlude_randomly(batch: Batch, share: float, min_points: int) -> Batch:
    """Remove the points within a wedge, 10 to 60 degrees wide, from a ``share`` of the clouds.

    The apex is one of the cloud's points, as if an obstacle stood there. A cloud is not changed if fewer than
    ``min_points`` points would remain.
    """
    num, device = len(batch.points), batch.points.device
    chosen = torch.rand(num, device=device) < share
    apex = torch.rand(batch.valid.shape, device=device).masked_fill(~batch.valid, -1).argmax(1)
    from_apex = batch.points[..., :2] - batch.points[torch.arange(num, device=device), apex, None, :2]
    heading = 2 * math.pi * torch.rand(num, device=device)
    low_deg, high_deg = _HALF_WEDGE_DEG
    half_width = torch.deg2rad(low_deg + (high_deg - low_deg) * torch.rand(num, device=device))
    along = from_apex[..., 0] * torch.cos(heading)[:, None] + from_apex[..., 1] * torch.sin(heading)[:, None]
    occluded = along > from_apex.norm(dim=-1) * torch.cos(half_width)[:, None]
    remaining = batch.valid & ~occluded
    chosen &= remaining.sum(1) >= min_points
    return replace(batch, valid=torch.where(chosen[:, None], remaining, batch.valid))


def drop_points_randomly(batch: Batch, ratio: tuple[float, float], min_points: int) -> Batch:
    """Keep a share of each cloud drawn from ``ratio``, but at least ``min_points`` points (or all of them)."""
    low, high = ratio
    device = batch.points.device
    share = low + (high - low) * torch.rand(len(batch.points), 1, device=device)
    count = (share * batch.valid.sum(1, keepdim=True)).clamp(min=min_points)
    rank = torch.rand(batch.valid.shape, device=device).masked_fill(~batch.valid, 2).argsort(1).argsort(1)
    return replace(batch, valid=batch.valid & (rank < count))
