"""The networks, put together as the config says."""

from __future__ import annotations

from p2wss.config import Dvae as DvaeConfig
from p2wss.config import Model as ModelConfig
from p2wss.nets.dataset import Limits
from p2wss.nets.network_patches import SCALE
from p2wss.nets.point2wss import ModelSizes, Point2Wss
from p2wss.nets.tokenizer import Tokenizer


def make_tokenizer(config: ModelConfig) -> Tokenizer:
    return Tokenizer(config.coord_decimals, config.hundreds)


def make_module(config: ModelConfig, dvae_config: DvaeConfig, tokenizer: Tokenizer) -> Point2Wss:
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
    return Point2Wss(sizes, tokenizer, SCALE)


def limits_of(config: ModelConfig, dvae_config: DvaeConfig, tokenizer: Tokenizer) -> Limits:
    """Buildings that every augmentation leaves within the number format."""
    longest = 10.0 ** (tokenizer.places[0] + 1)
    # the middle of a thinned cloud is not that of the whole one
    room = 0.9 * (longest / max(config.augmentation.scale[1], 1.0)) - config.augmentation.lift_m
    return Limits(dvae_config.min_points, config.max_vertices, room)
