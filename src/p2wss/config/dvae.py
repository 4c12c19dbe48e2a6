"""Section dvae: the discrete VAE that tokenises point patches."""

from __future__ import annotations

from pydantic import Field

from p2wss.config.base import Section
from p2wss.config.training import Compute, Optimiser


class Dvae(Section):
    """Stage dvae: the discrete VAE that encodes point patches as tokens."""

    seed: int = Field(0, ge=0, description="seed of initial weights, batches and augmentation")
    num_points: int = Field(
        768, ge=64, le=1_000_000, description="number of points used per cloud; larger clouds are subsampled"
    )
    min_points: int = Field(64, ge=1, description="clouds with fewer points are not used for training")
    num_patches: int = Field(
        32, ge=4, le=4096, description="number of patches per cloud, centred by farthest point sampling"
    )
    patch_size: int = Field(
        16,
        ge=4,
        le=4096,
        multiple_of=4,
        description="number of points per patch (nearest neighbours of its centre)",
    )
    patch_dim: int = Field(32, ge=8, le=4096, multiple_of=8, description="width of a patch embedding")
    token_dim: int = Field(
        32, ge=8, le=4096, multiple_of=8, description="width of a codebook entry and of the DGCNN"
    )
    num_tokens: int = Field(128, ge=8, le=65536, multiple_of=4, description="number of codebook entries")
    temperature_end: float = Field(
        0.0625,
        gt=0,
        le=1,
        description="temperature of the Gumbel softmax in the second half of the training; it starts at 1",
    )
    kl_weight: float = Field(
        0.1,
        ge=0,
        description="weight of the KL divergence from uniform codes, reached after 55 % of the steps",
    )
    use_lidar: bool = Field(True, description="also train on real LiDAR, because this stage needs no labels")
    optimiser: Optimiser = Optimiser()
    checkpoint_every_steps: int = Field(
        100, ge=1, description="number of steps between checkpoints, and between validations"
    )
    num_validation: int = Field(
        128, ge=1, description="number of clouds of the split val used for validation during training"
    )
    compute: Compute = Compute()
