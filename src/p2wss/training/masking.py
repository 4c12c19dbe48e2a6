"""The choice of tokens that the network has to restore during training."""

from __future__ import annotations

import torch
from torch import Tensor

from p2wss.nets.patches import Patches, squared_distance
from p2wss.nets.tokenizer import KIND_ANGLE, KIND_COORDINATE, KIND_FRAME, KIND_HEIGHT, KIND_PAD


def mask_patches(patches: Patches, ratio: tuple[float, float]) -> Tensor:
    """bool (b, g): a random valid patch and its nearest neighbours; a share drawn from ``ratio`` (Point-BERT)."""
    valid = patches.valid
    batch = len(valid)
    device = valid.device
    seed = torch.rand(valid.shape, device=device).masked_fill(~valid, -1).argmax(1)
    centre = patches.centre[torch.arange(batch, device=device), seed]
    distance = squared_distance(centre[:, None], patches.centre)[:, 0].masked_fill(~valid, torch.inf)
    rank = distance.argsort(1).argsort(1)
    share = ratio[0] + (ratio[1] - ratio[0]) * torch.rand(batch, device=device)
    count = (share * valid.sum(1)).long().clamp(min=1)
    return (rank < count[:, None]) & valid


def mask_parameters(
    kind: Tensor, inference_share: float, table1_share: float, random_ratio: tuple[float, float]
) -> Tensor:
    """bool (b, l): tokens to hide, each sample by one of three patterns drawn with the given shares.

    Inference pattern: all digits of height and angles. Table-1 pattern: all digits. Random pattern, for the rest:
    each token but [start] and [end] with a probability drawn per sample from ``random_ratio``. The paper's masking
    has shares of 0 and a ratio of (0.3, 0.3). ``kind`` is the result of :meth:`Tokenizer.kinds`.
    """
    batch = len(kind)
    device = kind.device
    draw = torch.rand(batch, 1, device=device)
    ratio = random_ratio[0] + (random_ratio[1] - random_ratio[0]) * torch.rand(batch, 1, device=device)
    random = torch.rand(kind.shape, device=device) < ratio
    random &= (kind != KIND_PAD) & (kind != KIND_FRAME)
    targets = (kind == KIND_HEIGHT) | (kind == KIND_ANGLE)
    return torch.where(
        draw < inference_share,
        targets,
        torch.where(draw < inference_share + table1_share, targets | (kind == KIND_COORDINATE), random),
    )
