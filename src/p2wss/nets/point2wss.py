"""Point2WSS: two masked transformer branches with cross-attention to each other (paper, sections 4.1 to 4.5)."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from p2wss.config import Dvae, Model
from p2wss.nets import distributed
from p2wss.nets.batch import NETWORK_SCALE
from p2wss.nets.discrete_vae import MiniPointNet
from p2wss.nets.layers import CoordinateLinear
from p2wss.nets.patches import Patches
from p2wss.nets.tokenizer import FIRST_DIGIT, MASK, MINUS, PAD, Tokenizer
from p2wss.nets.transformer import Encoder

POSITION_WIDTH = 128
INITIAL_LOGIT_SCALE = math.log(1 / 0.07)
MAX_LOGIT_SCALE = math.log(100)
# weights of pairs that do not match and of pairs that do (section 4.5)
_MATCHING_WEIGHTS = (0.1, 0.9)
# the weights that inference needs; the others serve training only
INFERENCE_PARTS = ("cloud.", "sequence.", "sequence_cross.", "sequence_head.", "look.", "number_head.")
# least deviation of a value, in radians of a digit's period
LEAST_SPREAD = 0.15


class Group(NamedTuple):
    """Rows of a batch, a slice from start to stop, and the length of the longest of their sequences."""

    rows: slice
    length: int


class Sequences(NamedTuple):
    """Token sequences of a batch, int64 (b, l). tokens: the true sequences. given: what the network reads, with masks.
    wanted: bool (b, l), the tokens to predict. num_vertices: int64 (b,)."""

    tokens: Tensor
    given: Tensor
    wanted: Tensor
    num_vertices: Tensor


class CloudEncoder(nn.Module):
    """Patches to features: mini-PointNet, [cls] token, positions of the patch centres added before every block."""

    def __init__(self, config: Model, patch_dim: int) -> None:
        super().__init__()
        dim = config.dim
        self.ground_relative = config.ground_relative
        self.embed = MiniPointNet(patch_dim)
        self.reduce = nn.Linear(patch_dim, dim)
        self.position = nn.Sequential(
            CoordinateLinear(4 if config.ground_relative else 3, POSITION_WIDTH),
            nn.GELU(),
            nn.Linear(POSITION_WIDTH, dim),
        )
        self.cls_token = nn.Parameter(torch.zeros(dim))
        self.cls_position = nn.Parameter(torch.zeros(dim))
        self.mask_token = nn.Parameter(torch.zeros(dim))
        self.encoder = Encoder(config, config.cloud_depth)

    def embed_patches(self, patches: Patches, ground_z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Embeddings and positional embeddings (b, 1 + g, dim) and validity (b, 1 + g), [cls] first."""
        batch = len(patches.centre)
        coordinates = patches.centre
        if self.ground_relative:
            above_ground = coordinates[..., 2:] - ground_z[:, None, None]
            coordinates = torch.cat([coordinates, above_ground], -1)
        cls = self.cls_token.expand(batch, 1, -1)
        x = torch.cat([cls, self.reduce(self.embed(patches.points))], 1)
        position = torch.cat([self.cls_position.expand(batch, 1, -1), self.position(coordinates)], 1)
        return x, position, F.pad(patches.valid, (1, 0), value=True)

    def hide(self, x: Tensor, masked: Tensor) -> Tensor:
        """Replace the embeddings of ``masked`` (b, g) patches by the mask token."""
        return torch.where(F.pad(masked, (1, 0), value=False)[..., None], self.mask_token, x)


class SequenceEncoder(nn.Module):
    """Sequences of parameter tokens to features."""

    def __init__(self, config: Model, tokenizer: Tokenizer) -> None:
        super().__init__()
        dim = config.dim
        self.tokenizer = tokenizer
        self.max_vertices = config.max_vertices
        self.word = nn.Embedding(tokenizer.vocabulary_size, dim)
        # a position is the slot within the header or a vertex block, and the vertex; the last rows mean "none"
        self.slot = nn.Embedding(tokenizer.header_length + tokenizer.block_length + 1, dim)
        self.vertex = nn.Embedding(config.max_vertices + 1, dim)
        self.encoder = Encoder(config, config.sequence_depth)
        self.register_buffer("token_value", tokenizer.token_value, persistent=False)
        self.edge: nn.Module | None = None
        if config.edge_embedding:
            self.edge = nn.Sequential(
                CoordinateLinear(9, POSITION_WIDTH), nn.GELU(), nn.Linear(POSITION_WIDTH, dim)
            )

    def embed(self, tokens: Tensor, num_vertices: Tensor, edges: Tensor) -> Tensor:
        """(b, l, dim). ``edges`` (b, n, 9) are the :func:`edge_features` of ``tokens``."""
        tok = self.tokenizer
        position = torch.arange(tokens.shape[1], device=tokens.device) - tok.header_length
        slot = torch.where(position < 0, position, position % tok.block_length) + tok.header_length
        vertex = torch.where(position < 0, self.max_vertices, position // tok.block_length)
        end = (position == (tok.block_length * num_vertices)[:, None]) | (tokens == PAD)
        slot = torch.where(end, self.slot.num_embeddings - 1, slot)
        vertex = torch.where(end, self.max_vertices, vertex)
        x = self.word(tokens) + self.slot(slot) + self.vertex(vertex)
        if self.edge is not None:
            # tokens of vertices only: the end token must not depend on the length of the batch
            inside = torch.arange(edges.shape[1], device=tokens.device) < num_vertices[:, None]
            edge = (self.edge(edges) * inside[..., None]).repeat_interleave(tok.block_length, 1)
            x = x + F.pad(edge, (0, 0, tok.header_length, 1))
        return x


def edge_features(tokenizer: Tokenizer, tokens: Tensor, num_vertices: Tensor, token_value: Tensor) -> Tensor:
    """The geometry of each edge, read from the tokens; zeros where a coordinate of its ends is masked.

    Returns (b, n, 9): visible, start, end (scaled), length (scaled), outward normal, signed distance of the
    origin from the edge's line. It follows from the visible coordinate tokens alone: no masked digit can leak.
    """
    block = tokenizer.blocks(tokens)
    count = len(tokenizer.coord_places)
    axes = []
    visible = torch.ones(block.shape[:2], dtype=torch.bool, device=tokens.device)
    for slot in (tokenizer.x_slot, tokenizer.y_slot):
        number = block[..., slot : slot + 1 + count]
        visible &= (number != MASK).all(-1)
        axes.append(token_value[number[..., 1:]].sum(-1) * torch.where(number[..., 0] == MINUS, -1, 1))
    start = torch.stack(axes, -1) * NETWORK_SCALE
    position = torch.arange(block.shape[1], device=tokens.device)
    following = (position + 1) % num_vertices[:, None].clamp(min=1)
    end = start.gather(1, following[..., None].expand(-1, -1, 2))
    visible &= visible.gather(1, following) & (position < num_vertices[:, None])
    along = end - start
    length = along.norm(dim=-1, keepdim=True)
    # counter-clockwise: the outside is to the right
    normal = torch.stack([along[..., 1], -along[..., 0]], -1) / length.clamp_min(1e-6)
    offset = (normal * start).sum(-1, keepdim=True)
    features = torch.cat([torch.ones_like(length), start, end, length, normal, offset], -1)
    return features * visible[..., None]


class EdgeAttention(nn.Module):
    """Attention of each visible edge to the patches, in the frame of the edge.

    A pair of edge and patch is described by the features of the patch and its position relative to the edge:
    distance inwards from the edge's line, distance beyond its ends, position along it, height above the ground.
    Without this layer the network would have to learn these relations from far more buildings.
    """

    def __init__(self, dim: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.from_patch = nn.Linear(dim, dim)
        self.from_pair = CoordinateLinear(7, dim, bias=False)
        self.logits = nn.Linear(dim, num_heads)
        # the range of each head around the edge, at first, is 10 m / decay
        self.decay = nn.Parameter(torch.logspace(0.5, 1.5, num_heads))
        self.value = nn.Linear(dim, dim)
        self.out = nn.Linear(dim, dim)

    def forward(self, edges: Tensor, cloud: Tensor, patches: Patches, ground_z: Tensor) -> Tensor:
        """``edges`` (b, n, 9) of :func:`edge_features`, ``cloud`` (b, g, dim) -> (b, n, dim), 0 for masked edges."""
        visible, start, end, length, normal, _ = edges.split([1, 2, 2, 1, 2, 1], -1)
        along = (end - start) / length.clamp_min(1e-6)
        offset = patches.centre[:, None, :, :2] - start[:, :, None]
        inwards = -(offset * normal[:, :, None]).sum(-1)
        position = (offset * along[:, :, None]).sum(-1)
        beyond = torch.relu(-position) + torch.relu(position - length)
        height = (patches.centre[..., 2] - ground_z[:, None])[:, None].expand_as(inwards)
        direction = normal[:, :, None].expand(*offset.shape)
        pair = torch.stack([inwards, inwards.abs(), beyond, position - length / 2, height], -1)
        h = F.gelu(self.from_pair(torch.cat([pair, direction], -1)) + self.from_patch(cloud)[:, None])
        distance = inwards.abs() + beyond
        logits = self.logits(h) - distance[..., None] * self.decay
        logits = logits.masked_fill(~patches.valid[:, None, :, None], -torch.inf)
        attention = logits.softmax(2)
        # the attention of a head sums to 1: averaging before the value layer is the same, and once per edge only
        mixed = attention.transpose(2, 3) @ h
        weight = self.value.weight.unflatten(0, (self.num_heads, -1))
        value = torch.einsum("bnhd,hod->bnho", mixed, weight).flatten(2) + self.value.bias
        return self.out(value) * visible


class NumberHead(nn.Module):
    """Logits of digits from a value that the digits of a number share.

    Of each number, a value v and the logarithm of its deviation s are linear in the features of the first digit. Digit
    d at place p has the logit of a von Mises distribution, cos(2 pi (v - c) / 10^(p + 1)) / t^2, where c is the middle
    of the numbers with this digit. t^2 is the sum of s^2, in radians of the period, and of the square of
    ``LEAST_SPREAD``: a deviation of decimetres says nothing of centimetres. From classes alone a network hardly learns
    that a digit repeats ten times along a length: it learns metres, and all decimetres stay equally probable.
    """

    def __init__(self, dim: int, tokenizer: Tokenizer) -> None:
        super().__init__()
        self.tokenizer = tokenizer
        self.linear = nn.Linear(dim, 2)

    def forward(self, x: Tensor, length: int, positions: Tensor | None = None) -> Tensor:
        """Logits (b, r, vocabulary) of features ``x`` (b, r, dim), zeros where there is no digit.

        positions: (r,), in sequences of ``length``, with all digits of each number; None for all positions.
        """
        place, first = self._digits(x, length, positions)
        value, log_deviation = self._values(x[:, first])
        period = 10.0 ** (torch.tensor(self.tokenizer.places) + 1) * NETWORK_SCALE
        period = period.to(x.device, non_blocking=True)
        middle = (torch.arange(10, device=x.device) + 0.5) / 10
        phase = (value[..., None] / period)[..., None] - middle
        spread = 2 * math.pi * log_deviation.exp()[..., None] / period
        is_place = place[:, None] == torch.arange(len(period), device=x.device)
        weight = is_place / (spread.square() + LEAST_SPREAD**2)
        return F.pad((weight[..., None] * (2 * math.pi * phase).cos()).flatten(-2), (FIRST_DIGIT, 0))

    def likelihood(
        self, x: Tensor, tokens: Tensor, wanted: Tensor, token_value: Tensor
    ) -> tuple[Tensor, Tensor]:
        """(negative log-likelihoods of numbers at their first digits, 0 elsewhere; mask of these digits), both (b, l).

        The distributions are Laplace, as digits alone say little about a value that is still far off. The numbers are
        the ones in ``tokens`` (b, l) whose first digit is ``wanted``, bool (b, l).
        """
        place, first = self._digits(x, tokens.shape[1], None)
        digit = token_value[tokens] * (place >= 0)
        number = torch.zeros_like(digit).index_add_(1, first, digit) * NETWORK_SCALE
        chosen = wanted & (place >= 0) & (first == torch.arange(len(first), device=x.device))
        value, log_deviation = self._values(x)
        off, log_deviation = (each.masked_fill(~chosen, 0) for each in (value - number, log_deviation))
        return off.abs() * (-log_deviation).exp() + log_deviation, chosen

    def _digits(self, x: Tensor, length: int, positions: Tensor | None) -> tuple[Tensor, Tensor]:
        """The index in ``places`` of the place of the digit at each of the ``positions`` (r,), -1 without a digit, and
        the index of the first digit of its number among them."""
        place, rank = (row.to(x.device, non_blocking=True) for row in self.tokenizer.digits(length))
        if positions is not None:
            place, rank = place[positions], rank[positions]
        return place, torch.arange(len(rank), device=x.device) - rank

    def _values(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Values (...) in network units, and logarithms of their deviations, of features (..., dim)."""
        # no matrix product, which bfloat16 would round to decimetres
        numbers = (x.float()[..., None, :] * self.linear.weight).sum(-1) + self.linear.bias
        return numbers[..., 0], numbers[..., 1]


class Point2Wss(nn.Module):
    """Both branches, their token classifiers and alignment heads. ``sequence`` is the parameter branch."""

    def __init__(self, config: Model, dvae_config: Dvae) -> None:
        super().__init__()
        self.config = config
        self.dvae_config = dvae_config
        self.tokenizer = tokenizer = Tokenizer(config.coord_decimals, config.hundreds)
        dim = config.dim
        self.cloud = CloudEncoder(config, dvae_config.patch_dim)
        self.sequence = SequenceEncoder(config, tokenizer)
        self.cloud_cross = Encoder(config, config.cross_depth, cross=True)
        self.sequence_cross = Encoder(config, config.cross_depth, cross=True)
        self.look: EdgeAttention | None = None
        if config.edge_attention:
            self.look = EdgeAttention(dim, config.num_heads)
        self.cloud_head = nn.Linear(dim, dvae_config.num_tokens)
        self.sequence_head = nn.Linear(dim, tokenizer.vocabulary_size)
        self.number_head = NumberHead(dim, tokenizer) if config.numerical_decoding else None
        self.align_cloud = nn.Linear(dim, config.align_dim)
        self.align_sequence = nn.Linear(dim, config.align_dim)
        self.logit_scale = nn.Parameter(torch.tensor(INITIAL_LOGIT_SCALE))
        self.match = nn.Linear(dim, 2)
        self.apply(_initialise)
        for token in (self.cloud.cls_token, self.cloud.cls_position, self.cloud.mask_token):
            nn.init.trunc_normal_(token, std=0.02)

    def losses(
        self,
        patches: Patches,
        ground_z: Tensor,
        patch_masked: Tensor,
        patch_labels: Tensor,
        sequences: Sequences,
        groups: Sequence[Group] = (),
    ) -> dict[str, Tensor]:
        """The four losses of section 4 on one batch of matching pairs.

        patches, ground_z (b,): scaled and centred. patch_masked bool (a, g), patch_labels int64 (a, g): masks and codes
        of the discrete VAE for the first a <= b pairs, on which the losses (1), (3) and (4) are computed. In the paper
        a = b; for a = 0 there is only the loss (2). groups: all rows, in order; the sequences of a group are padded to
        its longest one. Without groups, all are padded to the longest of all.
        """
        tokens, given, wanted, num_vertices = sequences
        num_first = len(patch_masked)
        # each branch runs once, on a batch of its masked and its unmasked inputs
        x, position, valid = self.cloud.embed_patches(patches, ground_z)
        both = self.cloud.encoder(
            torch.cat([self.cloud.hide(x[:num_first], patch_masked), x]),
            torch.cat([valid[:num_first], valid]),
            embedding=torch.cat([position[:num_first], position]),
        )
        cloud_masked, cloud = both.tensor_split([num_first])
        parts = []
        for rows, length in groups or [Group(slice(0, len(tokens)), tokens.shape[1])]:
            first, columns = slice(rows.start, min(rows.stop, num_first)), slice(length)
            row_tokens, row_given, row_wanted = (each[rows, columns] for each in (tokens, given, wanted))
            present, edges = row_tokens != PAD, self._edges(row_given, num_vertices[rows])
            unmasked, num_unmasked = tokens[first, columns], num_vertices[first]
            num_of_first = len(unmasked)
            both = self.sequence.encoder(
                torch.cat(
                    [
                        self.sequence.embed(unmasked, num_unmasked, self._edges(unmasked, num_unmasked)),
                        self.sequence.embed(row_given, num_vertices[rows], edges),
                    ]
                ),
                torch.cat([present[:num_of_first], present]),
            )
            sequence, masked = both.tensor_split([num_of_first])
            masked = self._add_edge_attention(masked, edges, cloud[rows], patches[rows], ground_z[rows])
            fused = self.sequence_cross(masked, present, source=(cloud[rows], valid[rows]))
            # of all tokens: to select the wanted ones, the host would have to wait for their number from the GPU
            words = self._words(fused, length).flatten(0, 1).float()
            part = {
                "words": F.cross_entropy(words, row_tokens.flatten(), reduction="none"),
                "wanted": row_wanted.flatten(),
            }
            if self.number_head is not None:
                value = self.sequence.get_buffer("token_value")
                number = self.number_head.likelihood(fused, row_tokens, row_wanted, value)
                part["number"], part["chosen"] = (each.flatten() for each in number)
            if num_of_first:
                part["cloud_fused"] = self.cloud_cross(
                    cloud_masked[first],
                    valid[first],
                    embedding=position[first],
                    source=(sequence, present[:num_of_first]),
                )
                part["sequence"], part["fused"] = sequence[:, 0], fused[:num_of_first, 0]
            parts.append(part)
        whole = {name: torch.cat([part[name] for part in parts if name in part]) for name in parts[0]}
        losses = {"sequence": _mean(whole["words"], whole["wanted"])}  # (2)
        if self.number_head is not None:
            losses["number"] = _mean(whole["number"], whole["chosen"])
        if not num_first:
            return losses
        masked_patches = patch_masked.nonzero(as_tuple=True)
        cloud_logits = self.cloud_head(whole["cloud_fused"][:, 1:][masked_patches]).float()
        codes = F.cross_entropy(cloud_logits, patch_labels[masked_patches], reduction="none")
        return (
            losses
            | {
                "cloud": _mean(codes, torch.ones_like(codes)),  # (1)
                "modal": self._modal_loss(cloud[:num_first, 0], whole["sequence"]),  # (3)
                "match": self._match_loss(whole["cloud_fused"][:, 0], whole["fused"]),  # (4)
            }
        )

    def _modal_loss(self, cloud: Tensor, sequence: Tensor) -> Tensor:
        """Equation 3 over all pairs of (b, dim) features, of all processes."""
        z_p = distributed.gather(F.normalize(self.align_cloud(cloud).float(), dim=-1))
        z_s = distributed.gather(F.normalize(self.align_sequence(sequence).float(), dim=-1))
        logits = self.logit_scale.clamp(max=MAX_LOGIT_SCALE).exp() * z_p @ z_s.T
        target = torch.arange(len(logits), device=logits.device)
        return (F.cross_entropy(logits, target) + F.cross_entropy(logits.T, target)) / 2

    def _match_loss(self, g_p: Tensor, g_s: Tensor) -> Tensor:
        """Equation 4 over all B^2 pairs of (b, dim) features, of all processes.

        FC(g_p[i] * g_s[j]) = sum_d W[c, d] g_p[i, d] g_s[j, d] + b[c], so two matrix products replace the
        B^2 fused features exactly.
        """
        weight, bias = self.match.weight.float(), self.match.bias.float()
        g_p, g_s = distributed.gather(g_p.float()), distributed.gather(g_s.float())
        logits = torch.stack([(g_p * row) @ g_s.T for row in weight], -1) + bias
        target = torch.eye(len(g_p), dtype=torch.int64, device=g_p.device)
        if self.config.match_balanced:
            loss = F.cross_entropy(logits.flatten(0, 1), target.flatten(), reduction="none").view_as(target)
            matching = loss.diagonal().mean()
            others = (loss.sum() - loss.diagonal().sum()) / max(loss.numel() - len(loss), 1)
            return (matching + others) / 2
        return F.cross_entropy(
            logits.flatten(0, 1),
            target.flatten(),
            weight=torch.tensor(_MATCHING_WEIGHTS).to(logits.device, non_blocking=True),
        )

    def restore(
        self,
        tokens: Tensor,
        num_vertices: Tensor,
        patches: Patches,
        ground_z: Tensor,
        positions: Tensor | None = None,
    ) -> Tensor:
        """Logits (b, l, vocabulary) of partly masked sequences, given the patches of their unmasked clouds.

        With ``positions``, int64 (r,), only the logits there are computed, (b, r, vocabulary), which is faster.
        """
        cloud, position, valid = self.cloud.embed_patches(patches, ground_z)
        cloud = self.cloud.encoder(cloud, valid, embedding=position)
        present = tokens != PAD
        edges = self._edges(tokens, num_vertices)
        x = self.sequence.encoder(self.sequence.embed(tokens, num_vertices, edges), present)
        x = self._add_edge_attention(x, edges, cloud, patches, ground_z)
        x = self.sequence_cross(x, present, source=(cloud, valid), positions=positions)
        return self._words(x, tokens.shape[1], positions)

    def _words(self, x: Tensor, length: int, positions: Tensor | None = None) -> Tensor:
        """Logits (b, r, vocabulary) of features (b, r, dim) at the ``positions`` (r,), by default at all."""
        logits = self.sequence_head(x)
        if self.number_head is None:
            return logits
        return logits + self.number_head(x, length, positions)

    def _edges(self, tokens: Tensor, num_vertices: Tensor) -> Tensor:
        value = self.sequence.get_buffer("token_value")
        return edge_features(self.tokenizer, tokens, num_vertices, value)

    def _add_edge_attention(
        self, x: Tensor, edges: Tensor, cloud: Tensor, patches: Patches, ground_z: Tensor
    ) -> Tensor:
        """Add the features of each edge, from its attention to the patches, to the tokens of its vertex."""
        if self.look is None:
            return x
        tok = self.tokenizer
        features = self.look(edges, cloud[:, 1:], patches, ground_z).repeat_interleave(tok.block_length, 1)
        return x + F.pad(features, (0, 0, tok.header_length, 1))


def _mean(loss: Tensor, is_term: Tensor) -> Tensor:
    """Mean of ``loss`` over the terms with ``is_term``, both (k,), of all processes; 0 where there is none."""
    return (loss * is_term).sum() / distributed.average_count(is_term.sum())


def inference_weights(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The part of a state dict that :meth:`Point2Wss.restore` uses."""
    return {name: value for name, value in state.items() if name.startswith(INFERENCE_PARTS)}


def _initialise(module: nn.Module) -> None:
    """Embeddings with a standard deviation of 1 / sqrt(width).

    Linear layers keep torch's default, which follows their width: Point-BERT's 0.02 suits a width of 384, and in a
    narrow network it would make the positions of patches too small beside other terms.
    """
    if isinstance(module, nn.Embedding):
        nn.init.trunc_normal_(module.weight, std=module.embedding_dim**-0.5)
