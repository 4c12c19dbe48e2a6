"""The discrete VAE whose codes are the tokens of point patches (paper, section 4.2; Point-BERT, stage 1).

mini-PointNet -> DGCNN over patch centres -> Gumbel softmax over the codebook -> DGCNN -> folding decoder.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from p2wss.nets import distributed
from p2wss.nets.layers import BatchNorm, CoordinateLinear
from p2wss.nets.patches import Patches, squared_distance
from p2wss.nets.pointwise import norm_relu_linear

NUM_NEIGHBOURS = 4
NORM_GROUPS = 4
SEED_RADIUS = 0.05
# of the leaky ReLUs, as in DGCNN
_NEGATIVE_SLOPE = 0.2
# of a training: the part over which the temperature falls and the weight of the divergence rises, and the part before
# that weight is more than 0
_SCHEDULE_SHARE, _WITHOUT_DIVERGENCE_SHARE = 0.5, 0.05
# patches that a CPU embeds at once at inference, so that the features of their points stay in its L2 cache
INFERENCE_PATCHES = 32


class MiniPointNet(nn.Module):
    """Patch points (b, g, k, 3) to one embedding per patch (b, g, dim).

    Widths dim/2, dim, 2 dim, dim. The second block reads each point together with the maximum over its patch. Its
    weight is split, so that the half for the maximum is applied once per patch and not once per point. No
    activation stands between the half for the points and the layer before it: the two weights are multiplied first.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.first = CoordinateLinear(3, dim // 2)
        self.first_norm = BatchNorm(dim // 2)
        self.second = nn.Linear(dim // 2, dim)
        self.third_point = nn.Linear(dim, 2 * dim, bias=False)
        self.third_patch = nn.Linear(dim, 2 * dim)
        self.third_norm = BatchNorm(2 * dim)
        self.fourth = nn.Linear(2 * dim, dim)

    def forward(self, points: Tensor) -> Tensor:
        x = self.first(points.flatten(0, 1))
        second, third = self.second, self.third_point
        weight = torch.cat([second.weight, third.weight @ second.weight])
        bias = torch.cat([second.bias, third.weight @ second.bias])
        patch, x = norm_relu_linear(x, self.first_norm, weight, bias, second.out_features)
        fourth = self.fourth
        x = x.add_(self.third_patch(patch)[:, None])
        x, _ = norm_relu_linear(x, self.third_norm, fourth.weight, fourth.bias, fourth.out_features)
        return x.unflatten(0, points.shape[:2])

    def infer(self, points: Tensor) -> Tensor:
        """:meth:`forward` in evaluation mode up to rounding, in less than half of the time, without gradients.

        Norms are folded into the layers before them, ``third_point`` into ``second``, and terms that are equal for
        all points of a patch are added once per patch.
        """
        scale, shift = self.first_norm.scale_and_shift()
        first, first_bias = self.first.weight * scale[:, None], self.first.bias * scale + shift
        scale, shift = self.third_norm.scale_and_shift()
        third = self.third_point.weight @ self.second.weight * scale[:, None]
        third_patch = self.third_patch.weight * scale[:, None]
        second_bias = self.second.bias
        third_bias = (self.third_point(second_bias) + self.third_patch(second_bias)) * scale + shift
        features = []
        num_at_once = INFERENCE_PATCHES if points.device.type == "cpu" else points.shape[:2].numel()
        for part in points.flatten(0, 1).split(num_at_once):
            x = F.linear(part, first, first_bias).relu_()
            patch = F.linear(x, self.second.weight).amax(1)
            x = F.linear(x, third).add_(F.linear(patch, third_patch, third_bias)[:, None]).relu_()
            features.append(F.linear(x, self.fourth.weight).amax(1))
        return torch.cat(features).view(*points.shape[:2], -1) + self.fourth.bias


class EdgeConvolution(nn.Module):
    """One edge convolution on a given graph: max over neighbours of act(norm(W [neighbour - x; x])).

    W [nb - x; x] = W1 nb + (W2 - W1) x is applied per node before the gather: k times fewer multiplications. The
    features of edges are never built: the moments of their group norm follow from those of the nodes and from the
    graph, and because norm and activation are monotonic in each channel, only the extreme neighbour counts.
    """

    def __init__(self, dim_in: int, dim_out: int) -> None:
        super().__init__()
        self.difference = nn.Linear(dim_in, dim_out, bias=False)
        self.self = nn.Linear(dim_in, dim_out, bias=False)
        self.norm = nn.GroupNorm(NORM_GROUPS, dim_out)

    def forward(self, x: Tensor, neighbour: Tensor, adjacency: Tensor) -> Tensor:
        """``x`` (b, g, dim_in), ``neighbour`` int64 (b, g, k) and its :func:`adjacency_matrix` -> (b, g, dim_out)."""
        from_neighbour = self.difference(x).float()
        from_self = F.linear(x, self.self.weight - self.difference.weight).float()
        mean, variance = self._moments(from_neighbour, from_self, adjacency, neighbour.shape[-1])
        scale = self.norm.weight * (variance + self.norm.eps).rsqrt()
        # a negative scale makes the smallest neighbour the largest
        sign = torch.where(self.norm.weight < 0, -1.0, 1.0)
        batch, groups, dim = from_self.shape
        rows = neighbour + groups * torch.arange(batch, device=x.device)[:, None, None]
        largest = _LargestNeighbour.apply((from_neighbour * sign).view(-1, dim), rows.flatten(0, 1))
        y = (largest.view_as(from_self) * sign + from_self - mean) * scale + self.norm.bias
        return F.leaky_relu(y, _NEGATIVE_SLOPE)

    def _moments(
        self, from_neighbour: Tensor, from_self: Tensor, adjacency: Tensor, k: int
    ) -> tuple[Tensor, Tensor]:
        """Mean and variance (b, 1, dim) of neighbour + self over the edges and the channels of each group."""
        count = k * from_self.shape[1]
        degree = adjacency.sum(1)[..., None]
        neighbour_sum = (degree * from_neighbour).sum(1)
        mean = _group_mean(neighbour_sum + k * from_self.sum(1)) / count
        # squares about the mean, or they would cancel
        centred = from_self - mean[:, None]
        neighbours = torch.bmm(adjacency, from_neighbour)
        square = (degree * from_neighbour.square() + k * centred.square() + 2 * centred * neighbours).sum(1)
        return mean[:, None], _group_mean(square)[:, None] / count


def _group_mean(x: Tensor) -> Tensor:
    """Mean over the channels of each group of the norm, for every channel (b, dim)."""
    groups = x.unflatten(-1, (NORM_GROUPS, -1))
    return groups.mean(-1, keepdim=True).expand_as(groups).flatten(1)


class _LargestNeighbour(torch.autograd.Function):
    """(n, dim): per channel the largest value among the rows ``neighbour`` (n, k) of ``x`` (n, dim).

    A function of its own, because torch's maximum with its index is ten times slower than one without.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, neighbour: Tensor) -> Tensor:
        largest = x.index_select(0, neighbour[:, 0])
        for row in neighbour.T[1:]:
            largest = torch.maximum(largest, x.index_select(0, row), out=largest)
        ctx.save_for_backward(x, neighbour, largest)
        return largest

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        x, neighbour, largest = ctx.saved_tensors
        d_x, remaining = torch.zeros_like(x), gradient.clone()
        for row in neighbour.T:
            # of equal neighbours the first gets the whole gradient
            share = x.index_select(0, row).eq_(largest).mul_(remaining)
            d_x.index_add_(0, row, share)
            remaining -= share
        return d_x, None


def adjacency_matrix(neighbour: Tensor) -> Tensor:
    """float32 (b, g, g): how often node j is a neighbour of node i, from int64 (b, g, k)."""
    batch, groups, _ = neighbour.shape
    counts = torch.zeros(batch, groups, groups, device=neighbour.device)
    return counts.scatter_add_(2, neighbour, torch.ones(1, device=counts.device).expand(neighbour.shape))


class Dgcnn(nn.Module):
    """Four edge convolutions on the graph of the patch centres, with their outputs concatenated (Point-BERT's DGCNN).

    The graph is the same for all four, so it is computed once per cloud and passed in.
    """

    def __init__(self, dim_in: int, dim: int, dim_out: int) -> None:
        super().__init__()
        self.first = nn.Linear(dim_in, dim // 2)
        widths = [dim // 2, dim, 2 * dim, 2 * dim, 4 * dim]
        self.convolutions = nn.ModuleList(EdgeConvolution(a, b) for a, b in itertools.pairwise(widths))
        self.last = nn.Linear(sum(widths[1:]), dim_out, bias=False)
        self.norm = nn.GroupNorm(NORM_GROUPS, dim_out)

    def forward(self, x: Tensor, neighbour: Tensor) -> Tensor:
        x = self.first(x)
        adjacency = adjacency_matrix(neighbour)
        outputs = []
        for convolution in self.convolutions:
            x = convolution(x, neighbour, adjacency)
            outputs.append(x)
        x = self.last(torch.cat(outputs, -1))
        return F.leaky_relu(self.norm(x.transpose(1, 2)).transpose(1, 2), _NEGATIVE_SLOPE)


class FoldingDecoder(nn.Module):
    """Patch features (b, g, dim) to coarse (b, g, k/4, 3) and fine (b, g, k, 3) points (PCN / FoldingNet)."""

    def __init__(self, dim: int, patch_size: int) -> None:
        super().__init__()
        self.num_coarse = patch_size // 4
        self.coarse = nn.Sequential(
            nn.Linear(dim, 4 * dim),
            nn.ReLU(),
            nn.Linear(4 * dim, 4 * dim),
            nn.ReLU(),
            nn.Linear(4 * dim, 3 * self.num_coarse),
        )
        side = torch.tensor([-SEED_RADIUS, SEED_RADIUS])
        self.register_buffer("seeds", torch.cartesian_prod(side, side), persistent=False)
        # the fold reads [feature; seed; coarse point]: its first layer is split accordingly
        self.from_feature = nn.Linear(dim, 2 * dim)
        self.from_point = CoordinateLinear(5, 2 * dim, bias=False)
        self.norm = BatchNorm(2 * dim)
        self.middle = nn.Linear(2 * dim, 2 * dim)
        self.middle_norm = BatchNorm(2 * dim)
        self.last = nn.Linear(2 * dim, 3)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        batch, groups, _ = x.shape
        coarse = self.coarse(x).view(batch, groups, self.num_coarse, 3)
        seeds = self.get_buffer("seeds").to(coarse.dtype)
        from_seed = self.from_point(F.pad(seeds, (0, 3)))[None]
        from_coarse = self.from_point(F.pad(coarse, (2, 0))) + self.from_feature(x)[:, :, None]
        middle, last = self.middle, self.last
        offset = from_coarse.flatten(0, 2)
        _, h = norm_relu_linear(from_seed, self.norm, middle.weight, middle.bias, offset=offset)
        _, fold = norm_relu_linear(h, self.middle_norm, last.weight, last.bias)
        return coarse, (coarse[..., None, :] + fold.view(*coarse.shape[:-1], 4, 3)).flatten(2, 3)


@dataclass(frozen=True)
class DvaeSizes:
    """Sizes that determine the network's weights. ``patch_size`` is a multiple of 4."""

    num_patches: int
    patch_size: int
    patch_dim: int
    token_dim: int
    num_tokens: int


class DiscreteVae(nn.Module):
    """See the module's docstring. The second stage uses :meth:`tokens`."""

    def __init__(self, sizes: DvaeSizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.encoder = MiniPointNet(sizes.patch_dim)
        self.to_logits = Dgcnn(sizes.patch_dim, sizes.token_dim, sizes.num_tokens)
        self.codebook = nn.Parameter(torch.randn(sizes.num_tokens, sizes.token_dim))
        self.to_features = Dgcnn(sizes.token_dim, sizes.token_dim, sizes.token_dim)
        self.decoder = FoldingDecoder(sizes.token_dim, sizes.patch_size)

    def logits(self, patches: Patches) -> Tensor:
        """(b, g, num_tokens)."""
        return self.to_logits(self.encoder(patches.points), centre_graph(patches))

    @torch.no_grad()
    def tokens(self, patches: Patches) -> Tensor:
        """int64 (b, g): the most probable code of each patch, without Gumbel noise."""
        if self.training:
            return self.logits(patches).argmax(-1)
        return self.to_logits(self.encoder.infer(patches.points), centre_graph(patches)).argmax(-1)

    def forward(self, patches: Patches, temperature: float) -> dict[str, Tensor]:
        """Losses of the coarse and fine reconstructions (Chamfer-L1), divergence from uniform codes, and the codes."""
        graph = centre_graph(patches)
        logits = self.to_logits(self.encoder(patches.points), graph).float()
        soft = F.gumbel_softmax(logits, tau=temperature, hard=False, dim=-1)
        coarse, fine = self.decoder(self.to_features(soft @ self.codebook, graph))
        valid = patches.valid
        log_mean = _masked_mean(F.softmax(logits, -1), valid).clamp_min(1e-20).log()
        log_uniform = -math.log(logits.shape[-1])
        return {
            "coarse": chamfer_l1(coarse, patches.points, valid),
            "fine": chamfer_l1(fine, patches.points, valid),
            # KL(uniform || mean posterior of the cloud), as in Point-BERT; in float32
            "kl": (log_uniform - log_mean).mean(),
            "codes": logits.detach().argmax(-1),
        }


def centre_graph(patches: Patches) -> Tensor:
    """int64 (b, g, 4): the nearest valid patches of each patch by their centres, itself among them."""
    distance = squared_distance(patches.centre, patches.centre)
    distance.masked_fill_(~patches.valid[:, None], torch.inf)
    k = min(NUM_NEIGHBOURS, distance.shape[-1])
    near, index = distance.topk(k, largest=False, sorted=True)
    return torch.where(near.isinf(), index[..., :1], index)


def chamfer_l1(reconstruction: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """Half the sum of the two mean nearest distances of point sets (b, g, n, 3) and (b, g, m, 3).

    The mean is over the patches that are ``valid`` (b, g).
    """
    reconstruction = reconstruction.float()
    # the search for the nearest points needs no gradients, which for all pairs would cost more than the rest
    with torch.no_grad():
        distance = squared_distance(reconstruction, target)
        nearest_target, nearest_reconstruction = distance.min(-1)[1], distance.min(-2)[1]
    forth = _distance(reconstruction, _pick(target, nearest_target)).mean(-1)
    back = _distance(_pick(reconstruction, nearest_reconstruction), target).mean(-1)
    return ((forth + back) * valid).sum() / (2 * distributed.average_count(valid.sum()))


def _pick(points: Tensor, index: Tensor) -> Tensor:
    return points.gather(2, index[..., None].expand(-1, -1, -1, 3))


def _distance(a: Tensor, b: Tensor) -> Tensor:
    # the square root has no finite slope at 0
    return (a - b).square().sum(-1).clamp_min(1e-12).sqrt()


def _masked_mean(x: Tensor, valid: Tensor) -> Tensor:
    """Mean over patches: (b, g, c), (b, g) -> (b, c)."""
    return (x * valid[..., None]).sum(1) / valid.sum(1)[:, None]


def temperature(progress: float, end: float) -> float:
    """Gumbel temperature at ``progress`` in [0, 1]: cosine from 1 to ``end`` over the first half.

    Point-BERT uses 100,000 of 197,000 iterations; a share suits any length of training.
    """
    return end + (1 - end) * (1 + math.cos(math.pi * min(progress / _SCHEDULE_SHARE, 1.0))) / 2


def kl_weight(progress: float, end: float) -> float:
    """Weight of the divergence: 0 for the first 5 %, then cosine to ``end`` at 55 % (Point-BERT)."""
    share = min(max((progress - _WITHOUT_DIVERGENCE_SHARE) / _SCHEDULE_SHARE, 0.0), 1.0)
    return end * (1 - math.cos(math.pi * share)) / 2
