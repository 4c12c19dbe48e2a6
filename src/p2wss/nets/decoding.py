"""From logits of masked digits to heights, angles and coordinates.

The digits of one number are predicted side by side, so their joint distribution is the product. The paper
takes the most probable digit at each place; a slip at the tens then costs ten metres. The median of the
joint distribution is the value of least expected absolute error, and averages well over rotations.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from scipy.special import expit, logit
from torch import Tensor
from torch.nn import functional as F

from p2wss.nets.tokenizer import Tokenizer

Mode = Literal["argmax", "median"]
Support = Literal["roofs", "all"]

CONFIDENT_HEIGHT_M = 0.5
CONFIDENT_ANGLE_DEG = 5
# The mean of several views is too modest, and so is a product of digits about a height. What becomes of the logarithm
# of the odds that a height or an angle is right, coefficients of 1 and of itself:
# python benchmarks/confidence.py MANIFEST .. --model models/point2wss.safetensors --fit
HEIGHT_CALIBRATION, ANGLE_CALIBRATION = (1.99, 0.76), (0.66, 0.97)
_LEAST_PROBABILITY = 1e-3


def number_distribution(logits: Tensor, tokenizer: Tokenizer, places: tuple[int, ...]) -> Tensor:
    """(..., 10^k) probabilities of the integers 0 .. 10^k - 1 from logits (..., k, words) of k digits.

    Only the ten words of each place count.
    """
    joint = torch.ones(*logits.shape[:-2], 1, device=logits.device)
    for index, place in enumerate(places):
        digit = F.softmax(logits[..., index, tokenizer.digit_tokens(place)].float(), -1)
        joint = (joint[..., :, None] * digit[..., None, :]).flatten(-2)
    return joint


def angle_support(support: Support) -> Tensor:
    """bool (100,): degrees that an answer may have; "roofs" is the paper's 0, 90 and 20 to 45."""
    allowed = torch.zeros(100, dtype=torch.bool)
    if support == "all":
        allowed[:91] = True
    else:
        allowed[[0, 90, *range(20, 46)]] = True
    return allowed


def constrain(distribution: Tensor, allowed: Tensor) -> Tensor:
    """Set what is not ``allowed`` (v,) to 0 and renormalise (..., v); uniform where nothing is left."""
    kept = distribution * allowed
    total = kept.sum(-1, keepdim=True)
    return torch.where(total > 0, kept / total.clamp_min(1e-30), allowed / allowed.sum())


def class_probability(distribution: Tensor) -> Tensor:
    """(..., 3): of 0 degrees, of 90 degrees and of a slope, from probabilities of angles (..., 100)."""
    flat, upright = distribution[..., 0], distribution[..., 90]
    return torch.stack([flat, upright, (distribution.sum(-1) - flat - upright).clamp_min(0)], -1)


def decode(distribution: Tensor, mode: Mode) -> Tensor:
    """int64 (...): most probable value, or smallest value with half of the mass below or at it."""
    if mode == "argmax":
        return distribution.argmax(-1)
    # double: the sum over 10^4 values must not stop short of one half
    cumulated = distribution.double().cumsum(-1)
    return (cumulated < 0.5 * cumulated[..., -1:]).sum(-1)


def mass_near(distribution: Tensor, value: Tensor, tolerance: int) -> Tensor:
    """(...): probability of the integers within ``tolerance`` of ``value``."""
    cumulated = F.pad(distribution.cumsum(-1), (1, 0))
    low = (value - tolerance).clamp(min=0)
    high = (value + tolerance + 1).clamp(max=distribution.shape[-1])
    return (cumulated.gather(-1, high[..., None]) - cumulated.gather(-1, low[..., None]))[..., 0].clamp(0, 1)


def expected_share(probability: np.ndarray) -> float:
    """The share of a building's numbers that is to be expected within 0.5 m and 5 degrees, from probabilities
    (1 + n,) as the network tells them: of the height, then of the angles."""
    odds = log_odds(probability)
    odds[0] = HEIGHT_CALIBRATION[0] + HEIGHT_CALIBRATION[1] * odds[0]
    odds[1:] = ANGLE_CALIBRATION[0] + ANGLE_CALIBRATION[1] * odds[1:]
    return float(expit(odds).mean())


def log_odds(probability: np.ndarray) -> np.ndarray:
    """log(p / (1 - p)), of probabilities that are neither 0 nor 1."""
    return logit(np.clip(probability, _LEAST_PROBABILITY, 1.0 - _LEAST_PROBABILITY))
