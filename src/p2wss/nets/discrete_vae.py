"""The discrete VAE whose codes are the tokens of point patches (paper, section 4.2; Point-BERT, stage 1).

mini-PointNet -> DGCNN over patch centres -> Gumbel softmax over the codebook -> DGCNN -> folding decoder.
"""

import itertools
import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from p2wss.config import Dvae
from p2wss.nets import distributed
from p2wss.nets.layers import BatchNorm, CoordinateLinear
from p2wss.nets.patches import Patches, nearest_points, squared_distance

NUM_NEIGHBOURS = 4
NORM_GROUPS = 4
SEED_RADIUS = 0.05
# slope of the leaky ReLUs, as in DGCNN
_NEGATIVE_SLOPE = 0.2
# shares of a training: in which the temperature falls and the weight of the divergence rises; in which that weight is
# still 0
_SCHEDULE_SHARE, _WITHOUT_DIVERGENCE_SHARE = 0.5, 0.05


class MiniPointNet(nn.Module):
    """Patch points (b, g, k, 3) to one embedding per patch (b, g, dim).

    Widths dim/2, dim, 2 dim, dim. The second block reads each point together with the maximum over its patch. Its
    weight is split, so that the half for the maximum is applied once per patch and not once per point.
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
        of_patch = (-1, points.shape[2])
        x = F.relu(self.first_norm(self.first(points.flatten(0, 2))), inplace=True)
        x = self.second(x).unflatten(0, of_patch)
        x = self.third_point(x) + self.third_patch(_largest(x))[:, None]
        x = F.relu(self.third_norm(x.flatten(0, 1)), inplace=True)
        return _largest(self.fourth(x).unflatten(0, of_patch)).unflatten(0, points.shape[:2])


def _largest(x: Tensor) -> Tensor:
    """Maximum over the points of each patch: (n, k, c) -> (n, c)."""
    # amax is faster than the maximum with its index, but has the slower gradient
    return x.max(1)[0] if torch.is_grad_enabled() else x.amax(1)


class EdgeConvolution(nn.Module):
    """One edge convolution on a given graph: max over neighbours of act(norm(W [neighbour - x; x])).

    W [nb - x; x] = W1 nb + (W2 - W1) x is applied per node before the gather: k times fewer multiplications.
    """

    def __init__(self, dim_in: int, dim_out: int) -> None:
        super().__init__()
        self.difference = nn.Linear(dim_in, dim_out, bias=False)
        self.self = nn.Linear(dim_in, dim_out, bias=False)
        self.norm = nn.GroupNorm(NORM_GROUPS, dim_out)

    def forward(self, x: Tensor, neighbour: Tensor) -> Tensor:
        """``x`` (b, g, dim_in), ``neighbour`` int64 (b, g, k) -> (b, g, dim_out)."""
        from_neighbour = self.difference(x).float()
        from_self = F.linear(x, self.self.weight - self.difference.weight).float()
        first = len(x[0]) * torch.arange(len(x), device=x.device)[:, None, None]
        edges = from_neighbour.flatten(0, 1)[neighbour + first] + from_self[:, :, None]
        # the activation is monotonic: it may follow the maximum
        return F.leaky_relu(self.norm(edges.permute(0, 3, 1, 2)).amax(-1), _NEGATIVE_SLOPE).transpose(1, 2)


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
        outputs = []
        for convolution in self.convolutions:
            x = convolution(x, neighbour)
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
        from_seed = self.from_point(F.pad(seeds, (0, 3)))
        from_coarse = self.from_point(F.pad(coarse, (2, 0))) + self.from_feature(x)[:, :, None]
        h = F.relu(self.norm((from_coarse[..., None, :] + from_seed).flatten(0, 3)), inplace=True)
        fold = self.last(F.relu(self.middle_norm(self.middle(h)), inplace=True))
        return coarse, (coarse[..., None, :] + fold.view(*coarse.shape[:-1], 4, 3)).flatten(2, 3)


class DiscreteVae(nn.Module):
    """See the module's docstring. The second stage uses :meth:`tokens`."""

    def __init__(self, config: Dvae) -> None:
        super().__init__()
        self.config = config
        dim = config.token_dim
        self.encoder = MiniPointNet(config.patch_dim)
        self.to_logits = Dgcnn(config.patch_dim, dim, config.num_tokens)
        self.codebook = nn.Parameter(torch.randn(config.num_tokens, dim))
        self.to_features = Dgcnn(dim, dim, dim)
        self.decoder = FoldingDecoder(dim, config.patch_size)

    def logits(self, patches: Patches, graph: Tensor) -> Tensor:
        """(b, g, num_tokens), given the :func:`centre_graph` of the patches."""
        return self.to_logits(self.encoder(patches.points), graph)

    @torch.no_grad()
    def tokens(self, patches: Patches) -> Tensor:
        """int64 (b, g): the most probable code of each patch, without Gumbel noise."""
        return self.logits(patches, centre_graph(patches)).argmax(-1)

    def forward(self, patches: Patches, temperature: Tensor | float) -> dict[str, Tensor]:
        """Losses of the coarse and fine reconstructions (Chamfer-L1), divergence from uniform codes, and the codes.

        temperature: of the Gumbel softmax; a tensor, as code would be compiled anew for each number.
        """
        graph = centre_graph(patches)
        logits = self.logits(patches, graph).float()
        soft = F.gumbel_softmax(logits, temperature)  # type: ignore[arg-type]
        coarse, fine = self.decoder(self.to_features(soft @ self.codebook, graph))
        valid = patches.valid
        mean = (F.softmax(logits, -1) * valid[..., None]).sum(1) / valid.sum(1)[:, None]
        log_uniform = -math.log(logits.shape[-1])
        return {
            "coarse": chamfer_l1(coarse, patches.points, valid),
            "fine": chamfer_l1(fine, patches.points, valid),
            # KL(uniform || mean posterior of the cloud), as in Point-BERT; in float32
            "kl": (log_uniform - mean.clamp_min(1e-20).log()).mean(),
            "codes": logits.detach().argmax(-1),
        }


def centre_graph(patches: Patches) -> Tensor:
    """int64 (b, g, 4): the nearest valid patches of each patch by their centres, itself among them."""
    distance = squared_distance(patches.centre, patches.centre)
    distance.masked_fill_(~patches.valid[:, None], torch.inf)
    return nearest_points(distance, NUM_NEIGHBOURS)


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


def temperature(progress: float, end: float) -> float:
    """Gumbel temperature at ``progress`` in [0, 1]: cosine from 1 to ``end`` over the first half.

    Point-BERT uses 100,000 of 197,000 iterations; a share suits any length of training.
    """
    return end + (1 - end) * (1 + math.cos(math.pi * min(progress / _SCHEDULE_SHARE, 1.0))) / 2


def kl_weight(progress: float, end: float) -> float:
    """Weight of the divergence: 0 for the first 5 %, then cosine to ``end`` at 55 % (Point-BERT)."""
    share = min(max((progress - _WITHOUT_DIVERGENCE_SHARE) / _SCHEDULE_SHARE, 0.0), 1.0)
    return end * (1 - math.cos(math.pi * share)) / 2
