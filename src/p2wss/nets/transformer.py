"""Pre-norm transformer blocks, with and without cross-attention."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class Attention(nn.Module):
    """Multi-head attention of ``x`` over ``source``; no bias in the projections (Point-BERT)."""

    def __init__(self, dim: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.query = nn.Linear(dim, dim, bias=False)
        self.key_value = nn.Linear(dim, 2 * dim, bias=False)
        self.out = nn.Linear(dim, dim)

    def forward(self, x: Tensor, source: Tensor, allowed: Tensor) -> Tensor:
        """``x`` (b, l, dim), ``source`` (b, s, dim), ``allowed`` bool to (b, heads, l, s) -> (b, l, dim)."""
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
        self.rate = rate

    def forward(self, x: Tensor) -> Tensor:
        if self.rate == 0 or not self.training:
            return x
        keep = torch.rand(len(x), *[1] * (x.ndim - 1), device=x.device, dtype=torch.float32) >= self.rate
        return x * keep / (1 - self.rate)


class Mlp(nn.Sequential):
    def __init__(self, dim: int, ratio: float) -> None:
        super().__init__(nn.Linear(dim, int(ratio * dim)), nn.GELU(), nn.Linear(int(ratio * dim), dim))


class Block(nn.Module):
    """Self-attention and MLP, or self-attention, cross-attention and MLP (paper, figure 4; MaskVLM)."""

    def __init__(self, dim: int, num_heads: int, mlp_ratio: float, drop_path: float, cross: bool) -> None:
        super().__init__()
        self.self_norm = nn.LayerNorm(dim)
        self.self_attention = Attention(dim, num_heads)
        if cross:
            self.cross_norm = nn.LayerNorm(dim)
            self.cross_attention = Attention(dim, num_heads)
        self.mlp_norm = nn.LayerNorm(dim)
        self.mlp = Mlp(dim, mlp_ratio)
        self.drop_path = DropPath(drop_path)

    def forward(
        self,
        x: Tensor,
        allowed: Tensor,
        source: Tensor | None = None,
        source_allowed: Tensor | None = None,
        rows: Tensor | None = None,
    ) -> Tensor:
        """(b, l, dim), or (b, r, dim) if only ``rows``, int64 (r,), are asked for."""
        h = query = self.self_norm(x)
        if rows is not None:
            x, query = x[:, rows], h[:, rows]
        x = x + self.drop_path(self.self_attention(query, h, allowed))
        if source is not None and source_allowed is not None:
            x = x + self.drop_path(self.cross_attention(self.cross_norm(x), source, source_allowed))
        return x + self.drop_path(self.mlp(self.mlp_norm(x)))


class Encoder(nn.Module):
    """``depth`` blocks and a final norm; drop path grows linearly to ``drop_path``."""

    def __init__(
        self,
        dim: int,
        depth: int,
        num_heads: int,
        mlp_ratio: float,
        drop_path: float,
        cross: bool = False,
    ) -> None:
        super().__init__()
        rates = torch.linspace(0, drop_path, depth).tolist()
        self.blocks = nn.ModuleList(Block(dim, num_heads, mlp_ratio, rate, cross) for rate in rates)
        self.norm = nn.LayerNorm(dim)

    def forward(
        self,
        x: Tensor,
        valid: Tensor,
        position: Tensor | None = None,
        source: Tensor | None = None,
        source_valid: Tensor | None = None,
        rows: Tensor | None = None,
    ) -> Tensor:
        """(b, l, dim). ``valid`` bool (b, l); ``source`` (b, s, dim) with ``source_valid`` bool (b, s).

        ``position`` (b, l, dim) is added before every block (Point-BERT's habit for clouds). Whoever reads only
        some ``rows``, int64 (r,), gets those, (b, r, dim): the last block computes no others.
        """
        allowed = valid[:, None, None]
        source_allowed = None if source_valid is None else source_valid[:, None, None]
        for block in self.blocks:
            asked = rows if block is self.blocks[-1] else None
            x = block(x if position is None else x + position, allowed, source, source_allowed, asked)
        return self.norm(x)
