"""Masks of the training."""

from __future__ import annotations

import torch
from nets.test_tokenizer import buildings, length

from p2wss.nets.patches import Patches
from p2wss.nets.tokenizer import (
    KIND_ANGLE,
    KIND_COORDINATE,
    KIND_FRAME,
    KIND_HEIGHT,
    KIND_PAD,
    KIND_SIGN,
    KIND_TYPE,
    Tokenizer,
)
from p2wss.training.masking import mask_parameters, mask_patches


def kinds(count: int = 400) -> torch.Tensor:
    tok = Tokenizer()
    num = buildings(0, count)[3]
    return tok.kinds(torch.Size((count, int(length(tok, torch.tensor(12))))), num)


def test_each_pattern_masks_its_kinds_of_tokens() -> None:
    torch.manual_seed(0)
    kind = kinds()
    targets = (kind == KIND_HEIGHT) | (kind == KIND_ANGLE)
    assert torch.equal(mask_parameters(kind, 1, 0, (0.3, 0.3)), targets)
    assert torch.equal(mask_parameters(kind, 0, 1, (0.3, 0.3)), targets | (kind == KIND_COORDINATE))
    free = mask_parameters(kind, 0, 0, (0.3, 0.3))
    allowed = (kind != KIND_PAD) & (kind != KIND_FRAME)
    assert not free[~allowed].any()
    assert abs(float(free[allowed].float().mean()) - 0.3) < 0.02
    assert free[kind == KIND_TYPE].any() and free[kind == KIND_SIGN].any()


def test_shares_of_the_mixture() -> None:
    torch.manual_seed(0)
    kind = kinds()
    masked = mask_parameters(kind, 0.5, 0.2, (0.15, 1))
    targets = (kind == KIND_HEIGHT) | (kind == KIND_ANGLE)
    inference = (masked == targets).all(1).float().mean()
    table1 = (masked == (targets | (kind == KIND_COORDINATE))).all(1).float().mean()
    assert abs(float(inference) - 0.5) < 0.08 and abs(float(table1) - 0.2) < 0.06


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
