"""Sizes of a network that runs in milliseconds, too small to learn anything."""

from p2wss.config import Dvae, Model

DVAE = Dvae(num_patches=12, patch_size=8, patch_dim=16, token_dim=16, num_tokens=12)
MODEL = Model(
    dim=16,
    num_heads=2,
    mlp_ratio=2,
    cloud_depth=1,
    cross_depth=1,
    max_vertices=12,
    align_dim=8,
    coord_decimals=2,
)
