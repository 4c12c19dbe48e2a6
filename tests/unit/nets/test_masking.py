"""What is hidden while training."""

from __future__ import annotations

import torch

from p2wss.nets.masking import mask_parameters, mask_patches
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

from .test_tokenizer import buildings


def kinds(count: int = 400) -> torch.Tensor:
    tok = Tokenizer()
    num = buildings(0, count)[3]
    return tok.kinds(torch.Size((count, tok.length(12))), num)


def test_each_pattern_hides_what_it_says() -> None:
    torch.manual_seed(0)
    kind = kinds()
    asked = (kind == KIND_HEIGHT) | (kind == KIND_ANGLE)
    assert torch.equal(mask_parameters(kind, 1, 0, (0.3, 0.3)), asked)
    assert torch.equal(mask_parameters(kind, 0, 1, (0.3, 0.3)), asked | (kind == KIND_COORDINATE))
    free = mask_parameters(kind, 0, 0, (0.3, 0.3))
    allowed = (kind != KIND_PAD) & (kind != KIND_FRAME)
    assert not free[~allowed].any()
    assert abs(float(free[allowed].float().mean()) - 0.3) < 0.02
    assert free[kind == KIND_TYPE].any() and free[kind == KIND_SIGN].any()


def test_shares_of_the_mixture() -> None:
    torch.manual_seed(0)
    kind = kinds()
    masked = mask_parameters(kind, 0.5, 0.2, (0.15, 1))
    asked = (kind == KIND_HEIGHT) | (kind == KIND_ANGLE)
    inference = (masked == asked).all(1).float().mean()
    table1 = (masked == (asked | (kind == KIND_COORDINATE))).all(1).float().mean()
    assert abs(float(inference) - 0.5) < 0.08 and abs(float(table1) - 0.2) < 0.06


def test_patches_are_hidden_in_one_block_around_a_valid_patch() -> None:
    torch.manual_seed(0)
    centre = torch.rand(50, 20, 3)
    valid = torch.ones(50, 20, dtype=torch.bool)
    valid[:, 15:] = False
    masked = mask_patches(Patches(centre, centre[:, :, None], valid), (0.25, 0.45))
    assert not (masked & ~valid).any()
    count = masked.sum(1)
    assert count.min() >= 3 and count.max() <= 6 and len(count.unique()) > 2
    for row in range(50):
        own = centre[row][valid[row]]
        hidden = masked[row][valid[row]]
        distance = torch.cdist(own, own)
        # some hidden patch is nearer to all the others hidden than to any visible one
        assert any(distance[i][hidden].max() < distance[i][~hidden].min() for i in torch.where(hidden)[0])
