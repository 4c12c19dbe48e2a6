"""Section dvae: the discrete VAE."""

from __future__ import annotations

from pydantic import Field

from p2wss.config.base import Section
from p2wss.config.training import Compute, Optimiser


class Dvae(Section):
    """Discrete VAE that turns patches of points into tokens."""

    seed: int = Field(0, ge=0, description="of weights, batches and augmentation")
    num_points: int = Field(
        768, ge=64, description="points of a cloud that are used; larger ones are thinned"
    )
    min_points: int = Field(64, ge=1, description="smaller clouds are left out of training")
    num_patches: int = Field(32, ge=4, description="patches per cloud (farthest point sampling)")
    patch_size: int = Field(16, ge=4, multiple_of=4, description="points per patch (nearest neighbours)")
    patch_dim: int = Field(32, ge=8, multiple_of=8, description="width of a patch embedding")
    token_dim: int = Field(32, ge=8, multiple_of=8, description="width of a code and of the DGCNN")
    num_tokens: int = Field(128, ge=8, multiple_of=4, description="size of the codebook")
    temperature_end: float = Field(
        0.0625, gt=0, le=1, description="of the Gumbel softmax, from 1, at half-time"
    )
    kl_weight: float = Field(0.1, ge=0, description="of the divergence from uniform codes, reached at 55 %")
    use_lidar: bool = Field(True, description="train on real LiDAR too: this stage needs no labels")
    optimiser: Optimiser = Optimiser()
    checkpoint_every_steps: int = Field(100, ge=1, description="also: how often validation runs")
    num_validation: int = Field(128, ge=1, description="clouds of the val split to measure while training")
    compute: Compute = Compute()
