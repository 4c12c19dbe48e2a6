"""From digits to values."""

from __future__ import annotations

import itertools

import torch

from p2wss.nets.predictor import angle_support, constrain, decode, number_distribution
from p2wss.nets.tokenizer import Tokenizer


def test_joint_distribution_is_the_product_of_the_digits() -> None:
    tok = Tokenizer()
    torch.manual_seed(0)
    logits = torch.randn(2, 3, tok.vocabulary_size)
    joint = number_distribution(logits, tok, (1, 0, -1))
    digit = torch.stack(
        [logits[:, i, tok.digit_tokens(place)].softmax(-1) for i, place in enumerate((1, 0, -1))], 1
    )
    for a, b, c in itertools.product(range(0, 10, 3), repeat=3):
        expected = digit[:, 0, a] * digit[:, 1, b] * digit[:, 2, c]
        assert torch.allclose(joint[:, 100 * a + 10 * b + c], expected, atol=1e-6)
    assert torch.allclose(joint.sum(-1), torch.ones(2), atol=1e-5)
    assert torch.equal(decode(joint, "argmax"), (digit.argmax(-1) * torch.tensor([100, 10, 1])).sum(-1))


def test_median_minimises_the_expected_absolute_error() -> None:
    torch.manual_seed(0)
    distribution = torch.rand(20, 50).pow(4)
    distribution /= distribution.sum(-1, keepdim=True)
    value = torch.arange(50.0)
    cost = distribution @ (value[:, None] - value).abs()
    median = decode(distribution, "median")
    assert torch.allclose(cost.gather(1, median[:, None])[:, 0], cost.amin(1), atol=1e-5)


def test_a_wrong_tens_digit_does_not_move_the_median() -> None:
    """9.9 or 10.1 with equal probability: the most probable digits on their own could make it 10.9."""
    tok = Tokenizer()
    logits = torch.full((1, 4, tok.vocabulary_size), -30.0)
    for index, (place, digits) in enumerate({1: (0, 1), 0: (9, 0), -1: (9, 1), -2: (0, 0)}.items()):
        for digit in digits:
            logits[0, index, tok.digit_tokens(place).start + digit] = 0
    joint = number_distribution(logits, tok, (1, 0, -1, -2))
    assert 900 <= int(decode(joint, "median")) <= 1010


def test_support_is_the_papers() -> None:
    allowed = angle_support("roofs")
    assert allowed.nonzero()[:, 0].tolist() == [0, *range(20, 46), 90]
    assert int(angle_support("all").sum()) == 91
    distribution = torch.zeros(3, 100)
    distribution[0, 10], distribution[0, 30] = 0.8, 0.2
    distribution[1, 99] = 1
    distribution[2, 0], distribution[2, 90] = 0.6, 0.4
    constrained = constrain(distribution, allowed)
    assert decode(constrained, "median").tolist()[0] == 30 and decode(constrained, "median").tolist()[2] == 0
    assert torch.allclose(constrained.sum(-1), torch.ones(3))
