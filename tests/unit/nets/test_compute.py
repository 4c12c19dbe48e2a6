"""Compiled networks compute what others do. The traces are whole, and few; the compiler itself is torch's."""

from __future__ import annotations

import copy

import pytest
import tiny_network
import torch
from torch import nn
from torch._dynamo.utils import counters
from torch.nn import functional as F

from p2wss.config import Model
from p2wss.nets import compute
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.patches import make_patches
from p2wss.nets.transformer import Block


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compute, "COMPILER", "aot_eager")
    compute.compiled.cache_clear()
    torch.compiler.reset()
    counters.clear()


@pytest.mark.slow
def test_blocks_of_any_rate_and_length_share_their_code(traced: None) -> None:
    config = Model(drop_path=0.1, dim=16, num_heads=2)
    blocks = nn.ModuleList(Block(config, 0.02 * number, cross=True) for number in range(5))
    parts = copy.deepcopy(blocks)
    compute.compile_parts(parts, (Block,))
    assert parts.state_dict().keys() == blocks.state_dict().keys()
    for num, length in ((6, 20), (8, 44), (5, 37)):
        x, allowed = torch.randn(num, length, 16), torch.rand(num, 1, 1, length) > 0.2
        source = torch.randn(num, 13, 16), torch.ones(num, 1, 1, 13, dtype=torch.bool)
        for block, part in zip(blocks, parts, strict=True):
            torch.manual_seed(1)
            expected = block(x, allowed, source)
            torch.manual_seed(1)
            assert torch.equal(part(x, allowed, source), expected)
    # without stochastic depth, and with it
    assert counters["stats"]["unique_graphs"] == 2


@pytest.mark.slow
def test_a_compiled_dvae_has_the_same_losses_and_gradients(
    traced: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(F, "gumbel_softmax", lambda logits, tau: F.softmax(logits / tau, -1))
    vae = DiscreteVae(tiny_network.DVAE)
    part = copy.deepcopy(vae)
    compute.compile_parts(part, (DiscreteVae,))
    for num, temperature in ((6, 1.0), (8, 0.3)):
        points = torch.randn(num, 100, 3)
        patches = make_patches(points, torch.ones(num, 100, dtype=torch.bool), 8, 8)
        for module in (vae, part):
            module.zero_grad()
            module(patches, torch.full((), temperature))["fine"].backward()
        for one, other in zip(vae.parameters(), part.parameters(), strict=True):
            assert (one.grad is None) == (other.grad is None)
            assert one.grad is None or torch.allclose(one.grad, other.grad, atol=1e-6)
    assert counters["stats"]["unique_graphs"] <= 2
