"""The network: padding, masks and losses."""

from __future__ import annotations

import math

import pytest
import tiny_network
import torch
from torch.nn import functional as F

from p2wss.nets.patches import Patches, make_patches
from p2wss.nets.point2wss import (
    EdgeAttention,
    NumberHead,
    Point2Wss,
    Sequences,
    edge_features,
    inference_weights,
)
from p2wss.nets.tokenizer import (
    FIRST_DIGIT,
    KIND_ANGLE,
    KIND_COORDINATE,
    KIND_FRAME,
    KIND_HEIGHT,
    MASK,
    Tokenizer,
)
from p2wss.training.model import length_groups, mask_patches

from .test_tokenizer import FORMATS, buildings, length

DVAE = tiny_network.DVAE.model_copy(update={"num_tokens": 20})


def network(**switches: object) -> Point2Wss:
    torch.manual_seed(0)
    return Point2Wss(tiny_network.MODEL.model_copy(update=switches), DVAE)


def sample(count: int = 4) -> tuple[Patches, torch.Tensor, torch.Tensor]:
    """Patches, complete tokens (b, l) and num_vertices (b,)."""
    torch.manual_seed(1)
    points = torch.randn(count, 100, 3)
    patches = make_patches(points, torch.ones(count, 100, dtype=torch.bool), 12, 8)
    tok = Tokenizer()
    height, xy, angle, num = buildings(5, count)
    return patches, tok.encode(tok.canonical(tok.quantise(height, xy, angle, num))[0]), num


def test_padding_of_the_sequence_changes_nothing() -> None:
    model = network().eval()
    patches, tokens, num = sample()
    shortest = int(num.argmin())
    together = model.restore(tokens, num, patches, torch.zeros(4))
    num_tokens = int(length(Tokenizer(), num[shortest]))
    one = slice(shortest, shortest + 1)
    few = Patches(patches.centre[one], patches.points[one], patches.valid[one])
    alone = model.restore(tokens[one, :num_tokens], num[one], few, torch.zeros(1))
    assert num_tokens < tokens.shape[1]
    assert torch.allclose(together[shortest, :num_tokens], alone[0], atol=1e-5)


def test_positions_are_a_part_of_the_whole() -> None:
    """Target positions only, on padded clouds and sequences, against all positions."""
    tok = Tokenizer()
    model = network().eval()
    patches, tokens, num = sample()
    patches.valid[1, 7:] = False
    kind = tok.kinds(tokens.shape, num)
    tokens = tokens.masked_fill((kind == KIND_HEIGHT) | (kind == KIND_ANGLE), MASK)
    targets = tok.target_positions(int(num.max()))
    ground = torch.randn(4)
    result = model.restore(tokens, num, patches, ground, targets)
    plain = model.restore(tokens, num, patches, ground)
    assert result.shape == (4, len(targets), tok.vocabulary_size) and len(targets) < plain.shape[1]
    assert torch.allclose(result, plain[:, targets], atol=2e-5)
    assert plain[:, targets].std() > 0.1


def test_repeated_patches_change_nothing() -> None:
    model = network().eval()
    patches, tokens, num = sample()
    expected = model.restore(tokens, num, patches, torch.zeros(4))
    more = Patches(
        torch.cat([patches.centre, torch.full((4, 3, 3), 9.0)], 1),
        torch.cat([patches.points, torch.full((4, 3, 8, 3), 9.0)], 1),
        torch.cat([patches.valid, torch.zeros(4, 3, dtype=torch.bool)], 1),
    )
    assert torch.allclose(model.restore(tokens, num, more, torch.zeros(4)), expected, atol=1e-5)


def test_masked_digits_cannot_leak() -> None:
    """The input of the encoder does not depend on any masked token."""
    tok = Tokenizer()
    model = network().eval()
    patches, tokens, num = sample()
    kind = tok.kinds(tokens.shape, num)
    digits = (kind == KIND_HEIGHT) | (kind == KIND_ANGLE) | (kind == KIND_COORDINATE)
    captured: list[torch.Tensor] = []
    model.sequence.encoder.register_forward_pre_hook(lambda _m, inputs: captured.append(inputs[0].detach()))
    other = tokens.clone()
    other[digits] = FIRST_DIGIT + (other[digits] - FIRST_DIGIT + 3) % 10
    for sequence in (tokens, other):
        model.losses(
            patches, torch.zeros(4), mask_patches(patches, (0.3, 0.3)), torch.zeros(4, 12, dtype=torch.long),
            Sequences(sequence, sequence.masked_fill(digits, MASK), digits, num),
        )  # fmt: skip
    assert torch.equal(captured[0][4:], captured[1][4:])  # the masked half of the doubled batch
    assert not torch.equal(captured[0][:4], captured[1][:4])


def test_edge_features_restate_the_visible_coordinates_only() -> None:
    tok = Tokenizer()
    square = torch.tensor([[[-3.0, 2.5], [-3.0, -2.5], [3.0, -2.5], [3.0, 2.5]]])
    parameters = tok.quantise(torch.tensor([5.0]), square, torch.zeros(1, 4), torch.tensor([4]))
    tokens, _ = tok.mask_targets(parameters)
    edges = edge_features(tok, tokens, torch.tensor([4]), tok.token_value)[0]
    #         visible  start        end          length normal  distance
    expected = [
        [1, -0.3, 0.25, -0.3, -0.25, 0.5, -1, 0, 0.3],
        [1, -0.3, -0.25, 0.3, -0.25, 0.6, 0, -1, 0.25],
        [1, 0.3, -0.25, 0.3, 0.25, 0.5, 1, 0, 0.3],
        [1, 0.3, 0.25, -0.3, 0.25, 0.6, 0, 1, 0.25],
    ]
    assert torch.allclose(edges, torch.tensor(expected), atol=1e-6)
    masked = tokens.clone()
    masked[0, tok.header_length + tok.block_length + tok.x_slot + 2] = MASK  # a digit of vertex 1
    edges = edge_features(tok, masked, torch.tensor([4]), tok.token_value)[0]
    assert (edges[:2] == 0).all()
    assert torch.allclose(edges[2:], torch.tensor(expected)[2:], atol=1e-6)


def test_edges_attend_to_patches_in_their_own_frame() -> None:
    """A patch that moves with its edge has the same effect; masked edges and repeated patches have none."""
    torch.manual_seed(0)
    look = EdgeAttention(16, 2)
    tok = Tokenizer()
    square = torch.tensor([[[-3.0, 2.5], [-3.0, -2.5], [3.0, -2.5], [3.0, 2.5]]])
    num = torch.tensor([4])
    patches, _, _ = sample(1)
    cloud, ground = torch.randn(1, 12, 16), torch.zeros(1)

    def attended(shift: float, some: Patches, masked: int | None = None) -> torch.Tensor:
        parameters = tok.quantise(torch.tensor([5.0]), square + shift, torch.zeros(1, 4), num)
        tokens, _ = tok.mask_targets(parameters)
        if masked is not None:
            tokens[0, tok.header_length + tok.block_length * masked + tok.x_slot + 1] = MASK
        return look(edge_features(tok, tokens, num, tok.token_value), cloud, some, ground)[0]

    moved = Patches(patches.centre + torch.tensor([0.2, 0.2, 0]), patches.points, patches.valid)
    assert torch.allclose(attended(0, patches), attended(2, moved), atol=1e-5)
    assert not torch.allclose(attended(0, patches), attended(0, moved), atol=1e-3)
    assert torch.equal(
        attended(0, patches, masked=2).abs().sum(1) == 0, torch.tensor([False, True, True, False])
    )
    valid = patches.valid.clone()
    valid[:, 3] = False
    centre = patches.centre.clone()
    centre[:, 3] += 5
    some, other = (Patches(c, patches.points, valid) for c in (patches.centre, centre))
    assert torch.equal(attended(0, some), attended(0, other))


def test_averaging_before_the_value_layer_is_averaging_after_it() -> None:
    """Against a value for every pair of edge and patch."""
    torch.manual_seed(0)
    look = EdgeAttention(16, 2)
    look.decay.data.zero_()
    patches, tokens, num = sample()
    patches.valid[1, 7:] = False
    tok = Tokenizer()
    edges = edge_features(tok, tokens, num, tok.token_value)
    pairs: list[torch.Tensor] = []
    look.logits.register_forward_pre_hook(lambda _module, inputs: pairs.append(inputs[0]))
    result = look(edges, torch.randn(4, 12, 16), patches, torch.randn(4))
    share = look.logits(pairs[0]).masked_fill(~patches.valid[:, None, :, None], -torch.inf).softmax(2)
    value = look.value(pairs[0]).unflatten(-1, (2, 8))
    mixed = (share[..., None] * value).sum(2).flatten(2)
    assert torch.allclose(result, look.out(mixed) * edges[..., :1], atol=1e-6)


@pytest.mark.parametrize("balanced", [False, True])
def test_match_loss_is_that_of_all_fused_pairs(balanced: bool) -> None:
    model = network(match_balanced=balanced)
    g_p, g_s = torch.randn(6, 16), torch.randn(6, 16)
    fused = (g_p[:, None] * g_s[None]).flatten(0, 1)
    target = torch.eye(6, dtype=torch.long).flatten()
    weight = torch.tensor([1 / 30, 1 / 6]) if balanced else torch.tensor([0.1, 0.9])
    expected = F.cross_entropy(model.match(fused), target, weight=weight)
    assert torch.allclose(model._match_loss(g_p, g_s), expected, atol=1e-6)


def test_losses_start_near_chance_and_reach_every_weight() -> None:
    model = network()
    patches, tokens, num = sample(8)
    wanted = torch.rand(tokens.shape) < 0.3
    wanted &= Tokenizer().kinds(tokens.shape, num) > KIND_FRAME
    given = tokens.masked_fill(wanted, MASK)
    losses = model.losses(
        patches, torch.zeros(8), mask_patches(patches, (0.25, 0.45)),
        torch.randint(20, (8, 12)), Sequences(tokens, given, wanted, num),
    )  # fmt: skip
    assert float(losses["sequence"].detach()) == pytest.approx(math.log(51), abs=0.7)
    assert float(losses["cloud"]) == pytest.approx(math.log(20), abs=0.7)
    torch.stack(list(losses.values())).sum().backward()
    idle = [name for name, p in model.named_parameters() if p.grad is None]
    assert idle == []


def test_losses_do_not_depend_on_groups() -> None:
    """Into which a batch is divided, so that short sequences are not padded to the longest."""
    model = network().eval()
    patches, tokens, num = sample(8)
    order = num.argsort(stable=True)
    tokens, num = tokens[order], num[order]
    wanted = torch.rand(tokens.shape) < 0.3
    wanted &= Tokenizer().kinds(tokens.shape, num) > KIND_FRAME
    arguments = (
        patches, torch.zeros(8), mask_patches(patches, (0.25, 0.45)),
        torch.randint(20, (8, 12)), Sequences(tokens, tokens.masked_fill(wanted, MASK), wanted, num),
    )  # fmt: skip
    groups = length_groups(num.numpy(), Tokenizer())
    assert len(groups) > 1 and groups[0].length < groups[-1].length == tokens.shape[1]
    expected, divided = model.losses(*arguments), model.losses(*arguments, groups)
    assert expected.keys() == divided.keys()
    for name, value in expected.items():
        assert torch.allclose(divided[name], value, atol=1e-5), name


def test_auxiliary_losses_are_those_of_the_first_pairs_alone() -> None:
    model = network().eval()
    patches, tokens, num = sample(8)
    wanted = torch.rand(tokens.shape) < 0.3
    wanted &= Tokenizer().kinds(tokens.shape, num) > KIND_FRAME
    sequences = Sequences(tokens, tokens.masked_fill(wanted, MASK), wanted, num)
    patch_masked, labels = mask_patches(patches, (0.25, 0.45)), torch.randint(20, (8, 12))
    whole = model.losses(patches, torch.zeros(8), patch_masked, labels, sequences)
    some = model.losses(patches, torch.zeros(8), patch_masked[:3], labels[:3], sequences)
    first = Sequences(*(each[:3] for each in sequences))
    alone = model.losses(patches[:3], torch.zeros(3), patch_masked[:3], labels[:3], first)
    assert torch.allclose(some["sequence"], whole["sequence"], atol=1e-5)
    assert torch.allclose(some["number"], whole["number"], atol=1e-5)
    for name in ("cloud", "modal", "match"):
        assert torch.allclose(some[name], alone[name], atol=1e-5)
        assert not torch.allclose(some[name], whole[name], atol=1e-4)
    none = model.losses(patches, torch.zeros(8), patch_masked[:0], labels[:0], sequences)
    assert list(none) == ["sequence", "number"] and torch.allclose(
        none["sequence"], whole["sequence"], atol=1e-5
    )


@pytest.mark.parametrize("fmt", FORMATS)
def test_a_value_with_a_small_deviation_gives_the_digits_of_each_number(fmt: tuple[int, bool]) -> None:
    """Features that state the number and its deviation, over whole sequences and over the targets of inference."""
    tok = Tokenizer(*fmt)
    height, xy, angle, num = buildings(3, 20)
    tokens = tok.encode(tok.canonical(tok.quantise(height, xy, angle, num))[0])
    place, rank = tok.digits(tokens.shape[1])
    head = NumberHead(2, tok)
    with torch.no_grad():
        head.linear.weight.copy_(torch.eye(2))
        head.linear.bias.zero_()
    value = torch.zeros(tokens.shape, dtype=torch.float64)
    for first in (rank == 0).nonzero()[:, 0].tolist():
        count = 1 + int((torch.cumprod((rank[first + 1 :] > 0).long(), 0)).sum())
        number = tok.token_value.double()[tokens[:, first : first + count]].sum(1)
        # numbers are rounded: the middle of what has these digits
        last = tok.places[place[first + count - 1]]
        value[:, first] = (number + 0.5 * 10.0**last) / 10
    x = torch.stack([value, torch.full_like(value, -9.0)], -1).float()
    whole = head(x, tokens.shape[1])
    is_digit = (tokens >= FIRST_DIGIT) & (place >= 0)
    assert torch.equal(whole.argmax(-1)[is_digit], tokens[is_digit])
    assert not whole[:, place < 0].any()
    targets = tok.target_positions(int(num.max()))
    assert torch.equal(head(x[:, targets], tokens.shape[1], targets), whole[:, targets])


def test_a_deviation_of_decimetres_says_nothing_of_centimetres() -> None:
    tok = Tokenizer()
    head = NumberHead(2, tok)
    with torch.no_grad():
        head.linear.weight.copy_(torch.eye(2))
        head.linear.bias.zero_()
    x = torch.zeros(1, tok.header_length + 1, 2)
    x[0, 2] = torch.tensor([0.7455, math.log(0.02)])  # 7.45 m, of 0.2 m
    logits = head(x, tok.header_length + 1)[0]
    probability = [logits[2 + i, tok.digit_tokens(place)].softmax(-1) for i, place in enumerate(tok.places)]
    assert [int(p.argmax()) for p in probability[:3]] == [0, 7, 4]
    assert probability[1][7] > 0.9 and 0.15 < probability[2][4] < 0.4
    assert torch.allclose(probability[3], torch.full((10,), 0.1), atol=1e-3)


def test_the_loss_of_numbers_is_least_at_their_values() -> None:
    """Of the numbers that are wanted, and of no others."""
    tok = Tokenizer()
    height, xy, angle, num = buildings(4, 2)
    tokens = tok.encode(tok.canonical(tok.quantise(height, xy, angle, num))[0])
    head = NumberHead(2, tok)
    with torch.no_grad():
        head.linear.weight.copy_(torch.eye(2))
        head.linear.bias.zero_()
    kind = tok.kinds(tokens.shape, num)
    x = torch.tensor([50.0, 0.0]).expand(*tokens.shape, 2).clone()
    x[:, 2] = torch.stack([torch.round(height.float() * 100) / 1000, torch.zeros(2)], -1)

    def loss(x: torch.Tensor, wanted: int = KIND_HEIGHT) -> float:
        each, chosen = head.likelihood(x, tokens, kind == wanted, tok.token_value)
        assert not each[~chosen].any() and not chosen[kind != wanted].any()
        return float(each.sum() / chosen.sum())

    assert loss(x) == pytest.approx(0, abs=1e-5)
    for shift in (-0.1, 0.1):
        other = x.clone()
        other[0, 2, 0] += shift
        assert loss(other) == pytest.approx(0.05, abs=1e-5)
    assert loss(x, KIND_ANGLE) > 40


def test_inference_needs_only_the_parts_that_are_kept() -> None:
    model = network().eval()
    patches, tokens, num = sample()
    weights = inference_weights(model.state_dict())
    assert not any(name.startswith(("cloud_cross", "cloud_head", "align", "match")) for name in weights)
    torch.manual_seed(9)
    other = Point2Wss(tiny_network.MODEL, DVAE).eval()
    other.load_state_dict(weights, strict=False)
    answers = [net.restore(tokens, num, patches, torch.zeros(4)) for net in (model, other)]
    assert torch.equal(*answers)


def test_ground_enters_only_where_it_is_switched_on() -> None:
    patches, _, _ = sample()
    for on in (True, False):
        model = network(ground_relative=on).eval()
        low, high = (
            model.cloud.embed_patches(patches, ground)[1] for ground in (torch.zeros(4), torch.ones(4))
        )
        assert torch.equal(low, high) is not on
