"""Sections of the config for networks that train in seconds."""

SMALL_DVAE = {
    "num_points": 128,
    "num_patches": 8,
    "patch_size": 8,
    "patch_dim": 16,
    "token_dim": 16,
    "num_tokens": 16,
    "checkpoint_every_steps": 10,
    "optimiser": {"num_steps": 30, "batch_size": 8},
}

SMALL_MODEL = {
    "max_vertices": 8,
    "dim": 32,
    "num_heads": 2,
    "cloud_depth": 1,
    "cross_depth": 1,
    "align_dim": 16,
    "checkpoint_every_steps": 5,
    "num_validation": 8,
    "decoding": {"num_rotations": 2},
    "optimiser": {"num_steps": 10, "batch_size": 8},
}
