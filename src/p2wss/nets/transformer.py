"""Pre-norm transformer blocks, with or without cross-attention."""

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from p2wss.config import Model


class Attention(nn.Module):
    """Multi-head attention from ``x`` to ``source``, without biases in the projections (Point-BERT)."""

    def __init__(self, dim: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.query = nn.Linear(dim, dim, bias=False)
        self.key_value = nn.Linear(dim, 2 * dim, bias=False)
        self.out = nn.Linear(dim, dim)

    def forward(self, x: Tensor, source: Tensor, allowed: Tensor) -> Tensor:
        """``x`` (b, l, dim), ``source`` (b, s, dim), ``allowed`` bool, broadcast to (b, heads, l, s) -> (b, l, dim)."""
        query = self.query(x).unflatten(-1, (self.num_heads, -1)).transpose(1, 2)
        key, value = self.key_value(source).unflatten(-1, (2, self.num_heads, -1)).unbind(2)
        mixed = F.scaled_dot_product_attention(
            query, key.transpose(1, 2), value.transpose(1, 2), attn_mask=allowed
        )
        return self.out(mixed.transpose(1, 2).flatten(2))


class DropPath(nn.Module):
    """Drop a residual branch for whole samples with probability ``rate`` (stochastic depth)."""

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.is_used = rate > 0
        # a tensor, as code would be compiled anew for each number
        self.register_buffer("rate", torch.tensor(rate, dtype=torch.float32), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        if not self.is_used or not self.training:
            return x
        rate = self.get_buffer("rate")
        keep = torch.rand(len(x), *[1] * (x.ndim - 1), device=x.device, dtype=torch.float32) >= rate
        return x * keep / (1 - rate)


class Mlp(nn.Sequential):
    """Two linear layers, the hidden width being ``ratio`` times ``dim``."""

    def __init__(self, dim: int, ratio: float) -> None:
        super().__init__(nn.Linear(dim, int(ratio * dim)), nn.GELU(), nn.Linear(int(ratio * dim), dim))


# features (b, s, dim), and where attention to them is allowed: bool, broadcast to (b, heads, l, s)
Source = tuple[Tensor, Tensor]


class Block(nn.Module):
    """Self-attention and MLP, or self-attention, cross-attention and MLP (paper, figure 4; MaskVLM)."""

    def __init__(self, config: Model, drop_path: float, cross: bool) -> None:
        super().__init__()
        dim, num_heads = config.dim, config.num_heads
        self.self_norm = nn.LayerNorm(dim)
        self.self_attention = Attention(dim, num_heads)
        self.cross_norm = nn.LayerNorm(dim) if cross else None
        self.cross_attention = Attention(dim, num_heads) if cross else None
        self.mlp_norm = nn.LayerNorm(dim)
        self.mlp = Mlp(dim, config.mlp_ratio)
        self.drop_path = DropPath(drop_path)

    def forward(
        self, x: Tensor, allowed: Tensor, source: Source | None, positions: Tensor | None = None
    ) -> Tensor:
        """``x`` (b, l, dim), ``allowed`` bool, broadcast to (b, heads, l, l) -> (b, l, dim). With ``positions``, int64
        (r,), only these rows are computed: (b, r, dim). ``source``: what a block with cross-attention reads."""
        h = query = self.self_norm(x)
        if positions is not None:
            x, query = x[:, positions], h[:, positions]
        x = x + self.drop_path(self.self_attention(query, h, allowed))
        if self.cross_attention is not None and self.cross_norm is not None:
            assert source is not None
            features, source_allowed = source
            x = x + self.drop_path(self.cross_attention(self.cross_norm(x), features, source_allowed))
        return x + self.drop_path(self.mlp(self.mlp_norm(x)))


class Encoder(nn.Module):
    """``depth`` blocks and a final norm; the rate of stochastic depth grows linearly to ``drop_path``."""

    def __init__(self, config: Model, depth: int, cross: bool = False) -> None:
        super().__init__()
        rates = np.linspace(0, config.drop_path, depth).tolist()
        self.blocks = nn.ModuleList(Block(config, rate, cross) for rate in rates)
        self.norm = nn.LayerNorm(config.dim)

    def forward(
        self,
        x: Tensor,
        valid: Tensor,
        *,
        embedding: Tensor | None = None,
        source: Source | None = None,
        positions: Tensor | None = None,
    ) -> Tensor:
        """``x`` (b, l, dim), ``valid`` bool (b, l), false for padding -> (b, l, dim).

        embedding: (b, l, dim), of positions, added before every block (as Point-BERT does for clouds). source: for
        cross-attention, features (b, s, dim) and their validity, bool (b, s). positions: int64 (r,), the positions
        whose output is needed; the result is (b, r, dim), and the last block computes no others.
        """
        allowed = valid[:, None, None]
        if source is not None:
            features, source_valid = source
            source = features, source_valid[:, None, None]
        last = len(self.blocks) - 1
        for index, block in enumerate(self.blocks):
            x = x if embedding is None else x + embedding
            x = block(x, allowed, source, positions if index == last else None)
        return self.norm(x)
