"""Masks of the training."""

from __future__ import annotations

import torch
from nets.test_tokenizer import buildings, numbers

from p2wss.config.training import Masking
from p2wss.nets.patches import Patches
from p2wss.nets.tokenizer import (
    KIND_ANGLE,
    KIND_COORDINATE,
    KIND_FRAME,
    KIND_HEIGHT,
    KIND_PAD,
    KIND_SIGN,
    KIND_TYPE,
    MASK,
    Tokenizer,
)
from p2wss.training.model import mask_parameters, mask_patches

TOKENIZER = Tokenizer()


def hidden(**settings: object) -> tuple[torch.Tensor, ...]:
    """Kinds of tokens, tokens, what the network gets of them and what it has to predict, of 400 buildings."""
    torch.manual_seed(0)
    parameters, _ = TOKENIZER.canonical(TOKENIZER.quantise(*buildings(0, 400)))
    tokens = TOKENIZER.encode(parameters)
    given, wanted = mask_parameters(TOKENIZER, parameters, tokens, Masking(**settings))
    return TOKENIZER.kinds(tokens.shape, parameters.num_vertices), tokens, given, wanted


def test_each_pattern_masks_its_kinds_of_tokens() -> None:
    kind, tokens, given, wanted = hidden(inference_share=1, table1_share=0)
    targets = (kind == KIND_HEIGHT) | (kind == KIND_ANGLE)
    assert torch.equal(wanted, targets)
    assert torch.equal(given, tokens.masked_fill(wanted, MASK))
    _, _, _, wanted = hidden(inference_share=0, table1_share=1)
    assert torch.equal(wanted, targets | (kind == KIND_COORDINATE))
    _, _, _, free = hidden(inference_share=0, table1_share=0, random_ratio=(0.3, 0.3))
    allowed = (kind != KIND_PAD) & (kind != KIND_FRAME)
    assert not free[~allowed].any()
    assert abs(float(free[allowed].float().mean()) - 0.3) < 0.02
    assert free[kind == KIND_TYPE].any() and free[kind == KIND_SIGN].any()


def test_disturbed_coordinates_are_given_and_the_true_ones_wanted() -> None:
    kind, tokens, given, wanted = hidden(
        inference_share=0, table1_share=0, disturbed_share=1, disturbance_m=2
    )
    targets = (kind == KIND_HEIGHT) | (kind == KIND_ANGLE)
    coordinates = kind == KIND_COORDINATE
    assert torch.equal(wanted, targets | coordinates)
    assert (given[targets] == MASK).all()
    assert torch.equal(given[~wanted], tokens[~wanted])  # signs among them
    off_m = (numbers(TOKENIZER, given)[1] - numbers(TOKENIZER, tokens)[1]).abs()
    assert 0.5 < off_m[off_m > 0].mean() < 1.1 and off_m.max() < 8


def test_shares_of_the_mixture() -> None:
    kind, tokens, given, masked = hidden(inference_share=0.4, table1_share=0.2, disturbed_share=0.3)
    targets = (kind == KIND_HEIGHT) | (kind == KIND_ANGLE)
    inference = (masked == targets).all(1)
    all_digits = (masked == (targets | (kind == KIND_COORDINATE))).all(1)
    disturbed = all_digits & ((given != MASK) & (given != tokens)).any(1)
    for rows, share in ((inference, 0.4), (all_digits & ~disturbed, 0.2), (disturbed, 0.3)):
        assert abs(float(rows.float().mean()) - share) < 0.06


def test_patches_are_masked_in_one_block_around_a_valid_patch() -> None:
    torch.manual_seed(0)
    centre = torch.rand(50, 20, 3)
    valid = torch.ones(50, 20, dtype=torch.bool)
    valid[:, 15:] = False
    masked = mask_patches(Patches(centre, centre[:, :, None], valid), (0.25, 0.45))
    assert not (masked & ~valid).any()
    count = masked.sum(1)
    assert count.min() >= 3 and count.max() <= 6 and len(count.unique()) > 2
    for row in range(50):
        xyz = centre[row][valid[row]]
        in_block = masked[row][valid[row]]
        distance = torch.cdist(xyz, xyz)
        # some masked patch is nearer to all other masked ones than to any visible one
        assert any(
            distance[i][in_block].max() < distance[i][~in_block].min() for i in torch.where(in_block)[0]
        )
