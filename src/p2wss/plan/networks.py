"""Floating point operations of the networks, from their sizes; matrix products only."""

from __future__ import annotations

from itertools import pairwise

from p2wss.config import Dvae, Model

# the backward pass costs twice the forward pass
TRAINING_PASSES = 3
# vertices of a mean footprint: the buildings of the miniature have 5.7
NUM_VERTICES = 6
_POSITION_WIDTH = 128


def dvae_flop(config: Dvae) -> float:
    """Forward pass of the discrete VAE over one cloud."""
    patch, token, size = config.patch_dim, config.token_dim, config.patch_size
    encoder_per_point = 1.5 * patch + patch * patch / 2 + 4 * patch * patch
    widths = [token // 2, token, 2 * token, 2 * token, 4 * token]
    graph = sum(2 * a * b for a, b in pairwise(widths))
    to_logits = patch * token / 2 + graph + sum(widths[1:]) * config.num_tokens
    to_features = token * token / 2 + graph + sum(widths[1:]) * token
    decoder = 4 * token * token + 16 * token * token + 3 * token * size
    decoder_per_point = 10 * token + 4 * token * token + 6 * token
    codebook = config.num_tokens * token
    per_patch = to_logits + codebook + to_features + decoder
    return 2 * config.num_patches * (per_patch + size * (encoder_per_point + decoder_per_point))


def model_flop(config: Model, dvae: Dvae) -> float:
    """Forward pass of Point2WSS over one building, cross-modality encoders included."""
    dim = config.dim
    num_digits = (3 if config.hundreds else 2) + config.coord_decimals
    num_patches, num_tokens = dvae.num_patches + 1, 7 + (8 + 2 * num_digits) * NUM_VERTICES

    def block(num: int, num_other: int = 0) -> float:
        attention: float = 4 * dim * dim + 2 * num * dim
        if num_other:
            attention += 4 * dim * dim + 2 * num_other * dim
        return num * (attention + 2 * config.mlp_ratio * dim * dim)

    patches: float = num_patches * (dvae.patch_dim * dim + _POSITION_WIDTH * dim)
    encoder_per_point = 1.5 * dvae.patch_dim + 4.5 * dvae.patch_dim**2
    patches += dvae.num_patches * dvae.patch_size * encoder_per_point
    encoders = config.cloud_depth * block(num_patches) + config.sequence_depth * block(num_tokens)
    cross = config.cross_depth * (block(num_patches, num_tokens) + block(num_tokens, num_patches))
    heads = num_patches * dim * dvae.num_tokens
    return 2 * (patches + encoders + cross + heads)


def training_tflop(config: Dvae | Model, dvae: Dvae) -> float:
    """A whole training, in 10^12 operations. The auxiliary losses need three more passes over their share."""
    num_samples = config.optimiser.num_steps * config.optimiser.batch_size
    if isinstance(config, Dvae):
        per_sample = dvae_flop(config)
    else:
        per_sample = model_flop(config, dvae) * (1 + 3 * config.auxiliary_share)
    return TRAINING_PASSES * num_samples * per_sample / 1e12


def inference_tflop(config: Model, dvae: Dvae, num_buildings: float) -> float:
    """The network's predictions for ``num_buildings``, all views averaged."""
    return num_buildings * config.decoding.num_rotations * model_flop(config, dvae) / 1e12
