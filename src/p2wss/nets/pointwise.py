"""Batch norm, ReLU and a linear layer over all points of all patches, fused in chunks that fit a CPU's cache.

Most of a training step on a CPU is spent here, and layer by layer most of that time would go into memory traffic:
each layer writes tens of megabytes and reads them again, forwards and backwards. Fused, only the rows before the
norm are kept in memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from p2wss.nets import distributed
from p2wss.nets.layers import BatchNorm

# numbers per thread and chunk, at the widest layer
CHUNK_NUMBERS = 524288


def norm_relu_linear(
    rows: Tensor,
    norm: BatchNorm,
    weight: Tensor,
    bias: Tensor,
    num_pooled: int = 0,
    offset: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """``linear(relu(norm(rows)))``; of the first ``num_pooled`` outputs only the maximum over each group.

    ``rows`` (g, k, c), or (1, k, c) if every group adds an ``offset`` (g, c) to the same rows. ``weight`` (out, c),
    ``bias`` (out,). Returns (g, num_pooled) and (g, k, out - num_pooled).
    """
    fused = rows.device.type == "cpu" and not torch.is_autocast_enabled("cpu")
    if fused and not torch.compiler.is_compiling():
        pooled, y, mean, variance = _NormReluLinear.apply(
            rows, offset, norm.weight, norm.bias, weight, bias, num_pooled, norm
        )
        if norm.training:
            norm.track(mean, variance, len(pooled) * rows.shape[1] * distributed.num_processes())
        return pooled, y
    z = rows if offset is None else rows + offset[:, None]
    h = F.relu(norm(z.flatten(0, 1))).unflatten(0, z.shape[:2])
    pooled = F.linear(h, weight[:num_pooled], bias[:num_pooled]).amax(1)
    return pooled, F.linear(h, weight[num_pooled:], bias[num_pooled:])


class _NormReluLinear(torch.autograd.Function):
    """The fused layers and their gradients.

    With z = rows + offset, and m and q the means of z and of its square over all rows:
    y = relu(scale z + shift) W + bias, where scale and shift follow from m, q and the norm's weights.
    """

    @staticmethod
    def forward(
        ctx: Any,
        rows: Tensor,
        offset: Tensor | None,
        gamma: Tensor,
        beta: Tensor,
        weight: Tensor,
        bias: Tensor,
        num_pooled: int,
        norm: BatchNorm,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        groups = len(rows) if offset is None else len(offset)
        k, width = rows.shape[1:]
        if norm.training:
            total = torch.zeros(2, width, dtype=torch.float64)
            for _, z in _chunks(rows, offset, weight):
                total[0] += z.sum(0)
                total[1] += z.square().sum(0)
            moments = distributed.average(total / (groups * k))
        else:
            mean, variance = norm.get_buffer("running_mean").double(), norm.get_buffer("running_var").double()
            moments = torch.stack([mean, variance + mean.square()])
        scale, shift = _affine(moments, gamma, beta, norm.eps)
        pooled = rows.new_empty(groups, num_pooled)
        winner = torch.empty(groups, num_pooled, dtype=torch.int64)
        y = rows.new_empty(groups, k, len(weight) - num_pooled)
        for part, z in _chunks(rows, offset, weight):
            h = torch.addcmul(shift, z, scale).relu_()
            if num_pooled:
                outputs = torch.addmm(bias[:num_pooled], h, weight[:num_pooled].T).unflatten(0, (-1, k))
                torch.max(outputs, 1, out=(pooled[part], winner[part]))
            if num_pooled < len(weight):
                torch.addmm(bias[num_pooled:], h, weight[num_pooled:].T, out=y[part].flatten(0, 1))
        ctx.save_for_backward(rows, offset, gamma, beta, weight, winner, moments)
        ctx.eps, ctx.constant = norm.eps, not norm.training
        mean, variance = moments[0], moments[1] - moments[0].square()
        ctx.mark_non_differentiable(mean, variance)
        return pooled, y, mean, variance

    @staticmethod
    def backward(ctx: Any, d_pooled: Tensor, d_y: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        rows, offset, gamma, beta, weight, winner, moments = ctx.saved_tensors
        groups, num_pooled = d_pooled.shape
        k, width = rows.shape[1:]
        leaves = [x.detach().requires_grad_() for x in (moments, gamma, beta)]
        with torch.enable_grad():
            affine = _affine(leaves[0], leaves[1], leaves[2], ctx.eps)
        scale, shift = (x.detach() for x in affine)
        d_rows = torch.empty_like(rows) if offset is None else torch.zeros_like(rows)
        d_offset = None if offset is None else torch.empty_like(offset)
        d_weight = torch.zeros_like(weight)
        d_bias = torch.cat([d_pooled.sum(0), rows.new_zeros(len(weight) - num_pooled)])
        d_shift = rows.new_zeros(width)
        # first pass: the gradient with m and q taken as constants
        for part, z in _chunks(rows, offset, weight):
            h = torch.addcmul(shift, z, scale).relu_()
            d_z = torch.empty_like(z) if d_offset is not None else d_rows[part].flatten(0, 1)
            if num_pooled:
                d_outputs = rows.new_zeros(part.stop - part.start, k, num_pooled)
                d_outputs = d_outputs.scatter_(1, winner[part, None], d_pooled[part, None]).flatten(0, 1)
                d_weight[:num_pooled].addmm_(d_outputs.T, h)
                d_z.addmm_(d_outputs, weight[:num_pooled], beta=0)
            if num_pooled < len(weight):
                d_outputs = d_y[part].flatten(0, 1)
                d_weight[num_pooled:].addmm_(d_outputs.T, h)
                d_bias[num_pooled:] += d_outputs.sum(0)
                d_z.addmm_(d_outputs, weight[num_pooled:], beta=1 if num_pooled else 0)
            torch.ops.aten.threshold_backward.grad_input(d_z, h, 0, grad_input=d_z)
            d_shift += d_z.sum(0)
            if d_offset is not None:
                torch.sum(d_z.unflatten(0, (-1, k)), 1, out=d_offset[part])
                d_rows += d_z.unflatten(0, (-1, k)).sum(0)
        # the sum of d_z z: where d_z is not 0, z is (h - shift) / scale, and d_weight holds the sum of d_h h
        d_scale = ((weight * d_weight).sum(0) - shift * d_shift) / scale
        d_scale = torch.where(scale.abs() < 1e-6, 0.0, d_scale)
        d_moments, d_gamma, d_beta = torch.autograd.grad(affine, leaves, (d_scale, d_shift))
        # the moments are those of all processes
        d_moments = torch.zeros_like(d_moments) if ctx.constant else distributed.average(d_moments)
        # second pass, with m and q as functions of z: d_z scale + d_m / n + 2 z d_q / n
        d_mean, d_square = (d_moments * torch.tensor([[1.0], [2.0]]) / (groups * k)).to(rows.dtype)
        if offset is None or d_offset is None:
            for part, z in _chunks(rows, None, weight):
                d_z = d_rows[part].flatten(0, 1)
                torch.addcmul(torch.addcmul(d_mean, z, d_square), d_z, scale, out=d_z)
        else:
            d_rows.mul_(scale).addcmul_(groups * rows + offset.sum(0), d_square).add_(groups * d_mean)
            d_offset.mul_(scale).addcmul_(k * offset + rows.sum(1), d_square).add_(k * d_mean)
        return d_rows, d_offset, d_gamma, d_beta, d_weight, d_bias, None, None


def _chunks(rows: Tensor, offset: Tensor | None, weight: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """The groups of each chunk and their rows + offset (n, c)."""
    groups = len(rows) if offset is None else len(offset)
    size = max(CHUNK_NUMBERS * torch.get_num_threads() // (rows.shape[1] * max(weight.shape)), 1)
    for first in range(0, groups, size):
        part = slice(first, min(first + size, groups))
        yield part, (rows[part] if offset is None else rows + offset[part, None]).flatten(0, 1)


def _affine(moments: Tensor, gamma: Tensor, beta: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """Scale and shift of the norm, from the means of z and of its square, in float64."""
    mean, square = moments
    scale = gamma * torch.rsqrt((square - mean.square()).clamp_min(0) + eps)
    return scale.to(gamma.dtype), (beta - mean * scale).to(gamma.dtype)
