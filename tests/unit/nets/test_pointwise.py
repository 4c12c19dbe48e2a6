"""Norm, ReLU and linear layer in chunks against the layers of torch."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from p2wss.nets import pointwise
from p2wss.nets.layers import BatchNorm
from p2wss.nets.pointwise import norm_relu_linear


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Several chunks, the last one smaller; float64, so that only mistakes differ."""
    monkeypatch.setattr(pointwise, "CHUNK_NUMBERS", 150)
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def layers() -> tuple[BatchNorm, nn.Linear]:
    norm, linear = BatchNorm(6), nn.Linear(6, 5)
    nn.init.normal_(norm.weight)  # negative scales too
    nn.init.normal_(norm.bias)
    nn.init.normal_(norm.get_buffer("running_mean"))
    return norm, linear


def results(y: list[Tensor], inputs: list[Tensor], modules: list[nn.Module]) -> list[Tensor]:
    """Outputs, gradients of all that goes in, and what the norm remembers."""
    torch.manual_seed(1)
    loss = torch.stack([(x * torch.randn_like(x)).sum() for x in y]).sum()
    weights = [p for module in modules for p in module.parameters()]
    remembered = [b.double() for module in modules for b in module.buffers()]
    return [*y, *torch.autograd.grad(loss, [*inputs, *weights]), *remembered]


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("num_pooled", [0, 2, 5])
@pytest.mark.parametrize("shared", [True, False])
def test_outputs_gradients_and_running_moments(training: bool, num_pooled: int, shared: bool) -> None:
    norm, linear = layers()
    norm.train(training)
    rows = 3 + torch.randn(1 if shared else 11, 4, 6)
    inputs = [rows.requires_grad_()] + ([torch.randn(11, 6).requires_grad_()] if shared else [])
    other, other_linear = copy.deepcopy(norm), copy.deepcopy(linear)

    z = rows + inputs[1][:, None] if shared else rows
    y = other_linear(F.relu(nn.BatchNorm1d.forward(other, z.flatten(0, 1)))).view(11, 4, 5)
    parts = [y[..., :num_pooled].amax(1), y[..., num_pooled:]]
    expected = results(parts, inputs, [other, other_linear])

    offset = inputs[1] if shared else None
    outputs = norm_relu_linear(rows, norm, linear.weight, linear.bias, num_pooled, offset)
    for ours, theirs in zip(results(list(outputs), inputs, [norm, linear]), expected, strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-6, atol=1e-8)


def test_a_channel_that_the_norm_silences_gets_finite_gradients() -> None:
    norm, linear = layers()
    nn.init.zeros_(norm.weight)
    rows = torch.randn(11, 4, 6, requires_grad=True)
    _, y = norm_relu_linear(rows, norm, linear.weight, linear.bias)
    y.square().sum().backward()
    assert rows.grad is not None and norm.weight.grad is not None
    assert rows.grad.isfinite().all() and norm.weight.grad.isfinite().all()
