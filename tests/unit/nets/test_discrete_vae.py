"""The parts of the discrete VAE against plain implementations."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial import cKDTree
from torch.nn import functional as F

from p2wss.config import Dvae
from p2wss.nets.discrete_vae import (
    DiscreteVae,
    EdgeConvolution,
    MiniPointNet,
    centre_graph,
    chamfer_l1,
    kl_weight,
    temperature,
)
from p2wss.nets.patches import Patches, make_patches

CONFIG = Dvae(num_patches=12, patch_size=8, patch_dim=16, token_dim=16, num_tokens=20)


def patches(seed: int = 0, count: int = 3) -> Patches:
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(count, 100, 3, generator=generator)
    return make_patches(points, torch.ones(count, 100, dtype=torch.bool), 12, 8)


def test_edge_convolution_is_that_of_gathered_differences() -> None:
    torch.manual_seed(0)
    layer = EdgeConvolution(16, 24)
    torch.nn.init.normal_(layer.norm.weight)  # negative scales too
    x = torch.randn(2, 12, 16)
    graph = torch.randint(12, (2, 12, 4))
    weight = torch.cat([layer.difference.weight, layer.self.weight], 1)
    rows = torch.arange(2)[:, None, None]
    centre = x[:, :, None].expand(-1, -1, 4, -1)
    edges = F.linear(torch.cat([x[rows, graph] - centre, centre], -1), weight).permute(0, 3, 1, 2)
    expected = F.leaky_relu(layer.norm(edges), 0.2).amax(-1).transpose(1, 2)
    result = layer(x, graph)
    assert torch.allclose(result, expected, atol=1e-5)
    weights = torch.randn_like(result)
    parameters = list(layer.parameters())
    for ours, theirs in zip(
        torch.autograd.grad((result * weights).sum(), parameters),
        torch.autograd.grad((expected * weights).sum(), parameters),
        strict=True,
    ):
        assert torch.allclose(ours, theirs, atol=1e-4)


def test_point_net_reads_each_point_beside_its_patchs_maximum() -> None:
    torch.manual_seed(0)
    net = MiniPointNet(16).eval()
    points = torch.randn(2, 5, 7, 3)
    x = net.second(F.relu(net.first_norm(net.first(points.reshape(-1, 3))))).view(10, 7, 16)
    both = torch.cat([x.amax(1, keepdim=True).expand(-1, 7, -1), x], -1)
    weight = torch.cat([net.third_patch.weight, net.third_point.weight], 1)
    h = F.linear(both, weight, net.third_patch.bias).flatten(0, 1)
    expected = net.fourth(F.relu(net.third_norm(h))).view(2, 5, 7, 16).amax(2)
    assert torch.allclose(net(points), expected, atol=1e-5)


def test_the_point_net_does_not_depend_on_the_order_of_points() -> None:
    torch.manual_seed(0)
    net = MiniPointNet(16).eval()
    points = torch.randn(2, 5, 7, 3)
    assert torch.allclose(net(points), net(points[:, :, torch.randperm(7)]), atol=1e-6)


def test_chamfer_is_that_of_nearest_neighbours_and_skips_invalid_patches() -> None:
    torch.manual_seed(1)
    reconstruction, target = torch.randn(2, 3, 8, 3), torch.randn(2, 3, 12, 3)
    valid = torch.tensor([[True, True, False], [True, False, True]])
    expected = []
    for row, group in valid.nonzero().tolist():
        a, b = reconstruction[row, group].numpy(), target[row, group].numpy()
        forth, back = cKDTree(b).query(a)[0].mean(), cKDTree(a).query(b)[0].mean()
        expected.append((forth + back) / 2)
    assert float(chamfer_l1(reconstruction, target, valid)) == pytest.approx(
        sum(expected) / len(expected), abs=1e-5
    )


def test_no_neighbour_in_the_graph_is_a_repeated_patch() -> None:
    some = patches()
    valid = some.valid.clone()
    valid[:, 5] = False
    graph = centre_graph(Patches(some.centre, some.points, valid))
    assert not (graph == 5).any()
    distance = torch.cdist(some.centre, some.centre).masked_fill(~valid[:, None], torch.inf)
    assert torch.equal(graph.sort(-1)[0], distance.topk(4, largest=False)[1].sort(-1)[0])


def test_divergence_is_zero_for_uniform_codes_and_positive_otherwise() -> None:
    torch.manual_seed(0)
    vae = DiscreteVae(CONFIG)
    assert float(vae(patches(), 1.0)["kl"].detach()) > 0
    torch.nn.init.zeros_(vae.to_logits.norm.weight)
    assert float(vae(patches(), 1.0)["kl"].detach()) == pytest.approx(0, abs=1e-5)


def test_every_weight_gets_a_gradient() -> None:
    torch.manual_seed(0)
    vae = DiscreteVae(CONFIG)
    losses = vae(patches(), 0.5)
    (losses["coarse"] + losses["fine"] + losses["kl"]).backward()
    idle = [name for name, p in vae.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    # a bias before a batch norm has no effect
    assert [name for name in idle if "first.bias" not in name and "third_patch.bias" not in name] == []


def test_schedules_are_point_berts_as_shares() -> None:
    assert temperature(0, 0.0625) == 1 and temperature(0.5, 0.0625) == temperature(1, 0.0625) == 0.0625
    assert temperature(0.25, 0.0625) == pytest.approx((1 + 0.0625) / 2)
    assert kl_weight(0.04, 0.1) == 0 and kl_weight(0.3, 0.1) == pytest.approx(0.05)
    assert kl_weight(0.55, 0.1) == pytest.approx(0.1) == kl_weight(1, 0.1)
    assert math.isclose(kl_weight(0.175, 0.1), 0.1 * (1 - math.cos(math.pi / 4)) / 2)
