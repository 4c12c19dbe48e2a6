"""The network that completes a roof with few points. Each point and each edge of the footprint states two planes, and
each place of the roof chooses one of all planes. :mod:`p2wss.nets.supposed` evaluates it without torch.

Used by completion.py, for training."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from p2wss.nets.transformer import Attention, Mlp

DIM, NUM_HEADS, DEPTH, PLACE_DEPTH, PAIR_DIM = 128, 8, 5, 2, 64
# logarithms of deviations, in units of 10 m; weight and scale of differences of slope
LEAST_LOG, MOST_LOG = -6.0, 1.0
_SLOPE_WEIGHT = 3.0
_HIDDEN = -1e4


class Mixture(NamedTuple):
    """The planes between which places choose. z: (b, q, k), height of each plane at each place, units of 10 m. slope:
    (b, k, 2), of the planes. log_deviation: (b, k), of their heights. logit: (b, q, k), of the choice."""

    z: Tensor
    slope: Tensor
    log_deviation: Tensor
    logit: Tensor


class _Block(nn.Module):
    """Attention that falls with the distance, and an MLP."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(DIM)
        self.attention = Attention(DIM, NUM_HEADS)
        self.attention.query = nn.Linear(DIM, DIM)
        self.decay = nn.Parameter(torch.linspace(0, 6, NUM_HEADS))
        self.mlp_norm = nn.LayerNorm(DIM)
        self.mlp = Mlp(DIM, 4)

    def forward(self, x: Tensor, source: Tensor | None, distance: Tensor, is_token: Tensor) -> Tensor:
        normed = self.norm(x)
        bias = -distance[:, None] * self.decay[:, None, None]
        bias = bias.masked_fill(~is_token[:, None, None], _HIDDEN).to(normed.dtype)
        x = x + self.attention(normed, normed if source is None else source, bias)
        return x + self.mlp(self.mlp_norm(x))


class RoofCompletion(nn.Module):
    """Features, as tensors, to planes."""

    def __init__(self) -> None:
        super().__init__()
        self.point, self.edge, self.place = nn.Linear(41, DIM), nn.Linear(56, DIM), nn.Linear(26, DIM)
        self.kind = nn.Parameter(torch.randn(3, DIM) * 0.02)
        self.blocks = nn.ModuleList(_Block() for _ in range(DEPTH))
        self.norm = nn.LayerNorm(DIM)
        self.place_blocks = nn.ModuleList(_Block() for _ in range(PLACE_DEPTH))
        self.place_norm = nn.LayerNorm(DIM)
        self.plane = nn.Sequential(nn.Linear(DIM, 2 * DIM), nn.GELU(), nn.Linear(2 * DIM, 8))
        self.of_plane, self.of_place = nn.Linear(DIM, 2 * PAIR_DIM), nn.Linear(DIM, PAIR_DIM)
        self.of_pair = nn.Linear(6, PAIR_DIM, bias=False)
        self.choice = nn.Linear(PAIR_DIM, 1)
        self.decay = nn.Parameter(torch.tensor(6.0))

    def forward(
        self,
        point: Tensor,
        is_own: Tensor,
        edge: Tensor,
        place: Tensor,
        is_token: Tensor,
        distance: Tensor,
        offset: Tensor,
        place_distance: Tensor,
        axis: Tensor,
        z: Tensor,
    ) -> Mixture:
        """The arguments are the :class:`p2wss.nets.clues.Features`."""
        x = torch.cat([self.point(point) + self.kind[1 - is_own], self.edge(edge) + self.kind[2]], 1)
        for block in self.blocks:
            x = block(x, None, distance, is_token)
        x, y = self.norm(x), self.place(place)
        for block in self.place_blocks:
            y = block(y, x, place_distance, is_token)
        rise, along, across, log_deviation = self.plane(x).float().unflatten(-1, (2, 4)).unbind(-1)
        beside = torch.stack([-axis[..., 1], axis[..., 0]], -1)
        slope = along[..., None] * axis[:, :, None] + across[..., None] * beside[:, :, None]
        at_place = (z[..., None] + rise)[:, None] + (offset[:, :, :, None] * slope[:, None]).sum(-1)
        away = place_distance[..., None]
        pair = self.of_pair(torch.cat([offset.abs(), away, (away + 0.02).log(), at_place], -1))
        of_plane = self.of_plane(x).unflatten(-1, (2, -1))
        both = of_plane[:, None] + self.of_place(self.place_norm(y))[:, :, None, None] + pair[:, :, :, None]
        logit = self.choice(F.gelu(both))[..., 0].float() - away * self.decay
        logit = logit.masked_fill(~is_token[:, None, :, None], _HIDDEN)
        return Mixture(
            at_place.flatten(2),
            slope.flatten(1, 2),
            log_deviation.clamp(LEAST_LOG, MOST_LOG).flatten(1),
            logit.flatten(2),
        )


def completion_loss(mixture: Mixture, z: Tensor, slope: Tensor) -> Tensor:
    """Mean negative log-likelihood of the roof at places: z (b, q), slope (b, q, 2), with Laplace distributions."""
    log_deviation = mixture.log_deviation[:, None]
    off = (mixture.z - z[..., None]).abs() * (-log_deviation).exp() + log_deviation
    off = off + _SLOPE_WEIGHT * (mixture.slope[:, None] - slope[:, :, None]).abs().sum(-1)
    return -(mixture.logit.log_softmax(-1) - off).logsumexp(-1).mean()
