"""The choice of tokens that the network has to restore during training."""

from dataclasses import replace

import torch
from torch import Tensor

from p2wss.config.training import Masking
from p2wss.nets.patches import Patches, squared_distance
from p2wss.nets.tokenizer import (
    KIND_ANGLE,
    KIND_COORDINATE,
    KIND_FRAME,
    KIND_HEIGHT,
    KIND_PAD,
    MASK,
    Quantised,
    Tokenizer,
)


def mask_patches(patches: Patches, ratio: tuple[float, float]) -> Tensor:
    """bool (b, g): a random valid patch and its nearest neighbours, a share of the patches drawn from ``ratio``
    (Point-BERT)."""
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
    tokenizer: Tokenizer, parameters: Quantised, tokens: Tensor, settings: Masking
) -> tuple[Tensor, Tensor]:
    """(what the network reads in place of ``tokens``, int64 (b, l); which tokens it has to predict, bool (b, l)).

    tokens: (b, l), of canonical ``parameters``. Each sample has one of four patterns, drawn with the given shares.
    Inference pattern: all digits of height and angles are masked. Table-1 pattern: all digits. Disturbed pattern: all
    digits are to be predicted, but the coordinates are misplaced instead of masked, with their true signs. Random
    pattern, for the remaining share: each token but [start] and [end] with a probability drawn per sample from
    ``random_ratio``. The paper's masking has shares of 0 and a ratio of (0.3, 0.3).
    """
    kind = tokenizer.kinds(tokens.shape, parameters.num_vertices)
    shares = torch.tensor([settings.inference_share, settings.table1_share, settings.disturbed_share])
    shares = shares.cumsum(0).to(kind.device, non_blocking=True)
    pattern = torch.searchsorted(shares, torch.rand(len(kind), 1, device=kind.device), right=True)
    low, high = settings.random_ratio
    ratio = low + (high - low) * torch.rand(len(kind), 1, device=kind.device)
    random = torch.rand(kind.shape, device=kind.device) < ratio
    random &= (kind != KIND_PAD) & (kind != KIND_FRAME)
    is_coordinate = (kind == KIND_COORDINATE) & (pattern > 0)
    targets = (kind == KIND_HEIGHT) | (kind == KIND_ANGLE) | is_coordinate
    wanted = torch.where(pattern < len(shares), targets, random)
    given = tokens.masked_fill(wanted, MASK)
    if settings.disturbed_share:
        misplaced = tokenizer.encode(disturb(parameters, tokenizer, settings.disturbance_m))
        given = torch.where((pattern == 2) & is_coordinate, misplaced, given)
    return given, wanted


def disturb(parameters: Quantised, tokenizer: Tokenizer, largest_m: float) -> Quantised:
    """The parameters with Gaussian noise on the sizes of all coordinates, whose signs stay. The standard deviation of
    each sample is drawn from 0 to ``largest_m``."""
    xy = parameters.xy
    sigma = largest_m * 10**tokenizer.coord_decimals * torch.rand(len(xy), 1, 1, device=xy.device)
    noise = torch.round(sigma * torch.randn(xy.shape, device=xy.device)).long()
    size = (xy.abs() + noise).clamp(1, tokenizer.max_coord)
    return replace(parameters, xy=torch.where(xy < 0, -size, size))
