"""The tokenizer and the networks, built from the config."""

from __future__ import annotations

from p2wss.config import Dvae as DvaeConfig
from p2wss.config import Model as ModelConfig
from p2wss.nets.batch import NETWORK_SCALE
from p2wss.nets.dataset import TrainingLimits
from p2wss.nets.discrete_vae import DiscreteVae, DvaeSizes
from p2wss.nets.point2wss import ModelSizes, Point2Wss
from p2wss.nets.tokenizer import Tokenizer


def build_dvae(config: DvaeConfig) -> DiscreteVae:
    """An untrained discrete VAE."""
    return DiscreteVae(
        DvaeSizes(
            num_patches=config.num_patches,
            patch_size=config.patch_size,
            patch_dim=config.patch_dim,
            token_dim=config.token_dim,
            num_tokens=config.num_tokens,
        )
    )


def build_tokenizer(config: ModelConfig) -> Tokenizer:
    """The tokenizer that a model with this config reads and writes."""
    return Tokenizer(config.coord_decimals, config.hundreds)


def build_model(config: ModelConfig, dvae_config: DvaeConfig, tokenizer: Tokenizer) -> Point2Wss:
    """An untrained Point2WSS."""
    sizes = ModelSizes(
        dim=config.dim,
        num_heads=config.num_heads,
        mlp_ratio=config.mlp_ratio,
        drop_path=config.drop_path,
        cloud_depth=config.cloud_depth,
        sequence_depth=config.sequence_depth,
        cross_depth=config.cross_depth,
        patch_dim=dvae_config.patch_dim,
        num_tokens=dvae_config.num_tokens,
        max_vertices=config.max_vertices,
        align_dim=config.align_dim,
        ground_relative=config.ground_relative,
        numerical_encoding=config.numerical_encoding,
        edge_embedding=config.edge_embedding,
        edge_attention=config.edge_attention,
    )
    return Point2Wss(sizes, tokenizer, NETWORK_SCALE)


def training_limits(config: ModelConfig, dvae_config: DvaeConfig, tokenizer: Tokenizer) -> TrainingLimits:
    """The limits within which every augmentation keeps a building representable in tokens."""
    largest_m = 10.0 ** (tokenizer.places[0] + 1)
    # 0.9, because the centroid of a subsampled cloud is not that of the whole one
    length_m = 0.9 * (largest_m / max(config.augmentation.scale[1], 1.0)) - config.augmentation.lift_m
    return TrainingLimits(dvae_config.min_points, config.max_vertices, length_m)
