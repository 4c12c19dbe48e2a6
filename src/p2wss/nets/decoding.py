"""From logits of masked digits to heights, angles and coordinates.

The digits of one number are predicted independently, so their joint distribution is the product. The paper takes
the most probable digit at each place; a wrong tens digit then costs ten metres. The median of the joint
distribution has the least expected absolute error, and the distributions of several views can be averaged.
"""

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from p2wss.config.roof_angles import FLAT_DEG, MAX_SLOPE_DEG, MIN_SLOPE_DEG, VERTICAL_DEG
from p2wss.nets.tokenizer import Tokenizer


def number_distribution(logits: Tensor, tokenizer: Tokenizer, places: tuple[int, ...]) -> Tensor:
    """(..., 10^k) probabilities of the integers 0 .. 10^k - 1 from logits (..., k, vocabulary) of k digits.

    At each place only its ten digit tokens count.
    """
    joint = torch.ones(*logits.shape[:-2], 1, device=logits.device)
    for index, place in enumerate(places):
        digit = F.softmax(logits[..., index, tokenizer.digit_tokens(place)].float(), -1)
        joint = (joint[..., :, None] * digit[..., None, :]).flatten(-2)
    return joint


def angle_support(support: Literal["roofs", "all"]) -> Tensor:
    """bool (100,): the angles in degrees that may be predicted; "roofs" is the paper's 0, 90 and 20 to 45."""
    allowed = torch.zeros(100, dtype=torch.bool)
    if support == "all":
        allowed[:91] = True
    else:
        allowed[[FLAT_DEG, VERTICAL_DEG, *range(MIN_SLOPE_DEG, MAX_SLOPE_DEG + 1)]] = True
    return allowed


def constrain(distribution: Tensor, allowed: Tensor) -> Tensor:
    """Set the values that are not ``allowed`` (v,) to 0 and renormalise (..., v); uniform where all are 0."""
    masked = distribution * allowed
    total = masked.sum(-1, keepdim=True)
    return torch.where(total > 0, masked / total.clamp_min(1e-30), allowed / allowed.sum())


def decode(distribution: Tensor, mode: Literal["argmax", "median"]) -> Tensor:
    """int64 (...): the most probable value ("argmax"), or the smallest with half of the mass at or below it."""
    if mode == "argmax":
        return distribution.argmax(-1)
    # double: the sum over 10^4 values must not stop short of one half
    cumulated = distribution.double().cumsum(-1)
    return (cumulated < 0.5 * cumulated[..., -1:]).sum(-1)
