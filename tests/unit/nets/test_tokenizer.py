"""Tokens and parameter sets are in bijection."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from p2wss.nets.tokenizer import (
    FIRST_DIGIT,
    KIND_ANGLE,
    KIND_HEIGHT,
    KIND_PAD,
    MASK,
    MINUS,
    PAD,
    Tokenizer,
)

FORMATS = [(2, False), (1, False), (2, True), (1, True)]


def star(rng: np.random.Generator, n: int, radius: float = 40) -> np.ndarray:
    """A simple counter-clockwise ring (n, 2) around the origin."""
    # no gap of half a turn: the origin stays inside
    theta = 2 * math.pi * (np.arange(n) + rng.uniform(0, 0.45, n)) / n
    return np.column_stack([np.cos(theta), np.sin(theta)]) * rng.uniform(radius / 4, radius, (n, 1))


def buildings(seed: int, count: int, most: int = 12) -> tuple[torch.Tensor, ...]:
    """height (b,), xy (b, n, 2), angle (b, n), num_vertices (b,) in metres and degrees, padded with 0."""
    rng = np.random.default_rng(seed)
    num = rng.integers(3, most + 1, count)
    xy, angle = np.zeros((count, num.max(), 2)), np.zeros((count, num.max()))
    for i, n in enumerate(num):
        xy[i, :n] = star(rng, n)
        angle[i, :n] = rng.choice([0, 90, *range(20, 46)], n)
    return tuple(map(torch.from_numpy, (rng.uniform(0, 99, count), xy, angle, num)))


def length(tok: Tokenizer, num_vertices: torch.Tensor) -> torch.Tensor:
    """Numbers of tokens of buildings with these numbers of vertices."""
    return tok.header_length + tok.block_length * num_vertices + 1


def numbers(tok: Tokenizer, tokens: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Heights (b,) m, vertices (b, n, 2) m and angles (b, n) degrees that the digits of sequences state."""
    block = tok.blocks(tokens)
    value = tok.token_value.double()[block]
    places = len(tok.coord_places)
    axes = [
        value[..., slot + 1 : slot + 1 + places].sum(-1) * torch.where(block[..., slot] == MINUS, -1, 1)
        for slot in (tok.x_slot, tok.y_slot)
    ]
    height = tok.token_value.double()[tokens[:, 2 : tok.header_length]].sum(1)
    return height, torch.stack(axes, -1), value[..., tok.angle_slot :].sum(-1)


def test_vocabulary_and_length_are_the_papers() -> None:
    tok = Tokenizer()
    assert tok.vocabulary_size == len(tok.vocabulary) == len(set(tok.vocabulary)) == 51
    assert length(tok, torch.tensor([4, 8, 16])).tolist() == [71, 135, 263]
    assert tok.token_value[tok.vocabulary.index("[7·10^-1]")] == pytest.approx(0.7)


def test_the_sequence_of_a_square_token_by_token() -> None:
    tok = Tokenizer()
    square = torch.tensor([[[-3.0, -2.5], [3.0, -2.5], [3.0, 2.5], [-3.0, 2.5]]])
    parameters, start = tok.canonical(
        tok.quantise(torch.tensor([12.34]), square, torch.tensor([[45, 90, 30.0, 0]]), torch.tensor([4]))
    )
    assert start.tolist() == [3]  # uppermost, then leftmost
    text = "".join(tok.vocabulary[i] for i in tok.encode(parameters)[0])
    assert text.startswith(
        "[start][height][1·10^1][2·10^0][3·10^-1][4·10^-2]"
        "[point][x][-][0·10^1][3·10^0][0·10^-1][0·10^-2][y][+][0·10^1][2·10^0][5·10^-1][0·10^-2]"
        "[angle][0·10^1][0·10^0][point][x][-][0·10^1][3·10^0][0·10^-1][0·10^-2][y][-]"
    )
    assert text.endswith("[angle][3·10^1][0·10^0][end]")


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from(FORMATS), st.floats(0, 2 * math.pi))
def test_tokens_to_parameters_to_tokens(seed: int, fmt: tuple[int, bool], theta: float) -> None:
    tok = Tokenizer(*fmt)
    height, xy, angle, num = buildings(seed, 5)
    turn = torch.tensor([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])
    parameters, _ = tok.canonical(tok.quantise(height, xy @ turn.double(), angle, num))
    tokens = tok.encode(parameters)
    height_m, xy_m, angle_deg = numbers(tok, tokens)
    assert torch.equal((height_m * 100).round().long(), parameters.height)
    assert torch.equal((xy_m * 10 ** fmt[0]).round().long(), parameters.xy)
    assert torch.equal(angle_deg.round().long(), parameters.angle)
    assert torch.equal((tokens != PAD).sum(1), length(tok, num))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32), st.integers(0, 11))
def test_start_vertex_of_the_input_does_not_matter(seed: int, roll: int) -> None:
    tok = Tokenizer()
    height, xy, angle, num = buildings(seed, 4)
    rolled_xy, rolled_angle = xy.clone(), angle.clone()
    for i, n in enumerate(num.tolist()):
        rolled_xy[i, :n] = xy[i, :n].roll(roll, 0)
        rolled_angle[i, :n] = angle[i, :n].roll(roll, 0)
    one, _ = tok.canonical(tok.quantise(height, xy, angle, num))
    other, start = tok.canonical(tok.quantise(height, rolled_xy, rolled_angle, num))
    assert torch.equal(tok.encode(one), tok.encode(other))
    for i, n in enumerate(num.tolist()):  # the start leads back to the input's order
        assert torch.equal(other.angle[i, :n].roll(int(start[i])), rolled_angle[i, :n].long())


def test_the_inference_sequence_masks_height_and_angles_only() -> None:
    tok = Tokenizer()
    height, xy, angle, num = buildings(3, 6)
    parameters, _ = tok.canonical(tok.quantise(height, xy, angle, num))
    full = tok.encode(parameters)
    incomplete, kind = tok.mask_targets(parameters)
    masked = incomplete == MASK
    assert torch.equal(incomplete[~masked], full[~masked])
    assert torch.equal(masked.sum(1), 4 + 2 * num)
    assert (full[masked] >= FIRST_DIGIT).all()
    assert torch.equal((incomplete != PAD).sum(1), length(tok, num))
    assert torch.equal(kind == KIND_PAD, full == PAD)


def test_targets_are_the_digits_of_height_and_angles_edge_by_edge() -> None:
    tok = Tokenizer()
    kind = tok.kinds(torch.Size([1, int(length(tok, torch.tensor(5)))]), torch.tensor([5]))[0]
    targets = tok.target_positions(5)
    assert kind[targets].tolist() == [KIND_HEIGHT] * 4 + [KIND_ANGLE] * 10
    assert torch.equal(targets[4:], torch.nonzero(kind == KIND_ANGLE)[:, 0])


@pytest.mark.parametrize("value", [100.0, -0.01])
def test_heights_that_do_not_fit_are_refused(value: float) -> None:
    tok = Tokenizer()
    _, xy, angle, num = buildings(0, 1)
    with pytest.raises(ValueError, match="number format"):
        tok.encode(tok.quantise(torch.tensor([value]), xy, angle, num))
    hundreds = Tokenizer(2, True)
    hundreds.encode(hundreds.quantise(torch.tensor([100.0]), xy, angle, num))
