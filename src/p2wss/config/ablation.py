"""Section ablation: variants of the model to train and compare."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from p2wss.config.base import Section

_PAPER_MASKING = {"masking": {"inference_share": 0, "table1_share": 0, "random_ratio": [0.3, 0.3]}}
_PAPER_DECODING = {
    "decoding": {"mode": "argmax", "angle_support": "all", "num_rotations": 1, "num_refinements": 0}
}
_NO_AUGMENTATION = {
    "augmentation": {
        "scale": [1, 1],
        "lift_m": 0,
        "jitter_m": 0,
        "keep_points": [1, 1],
        "occlusion_share": 0,
    }
}
_NO_EDGES = {"edge_embedding": False, "edge_attention": False}
_PAPER_LOSSES = {
    "auxiliary_share": 1,
    "match_balanced": False,
    "loss_weights": {"cloud": 1, "sequence": 1, "modal": 1, "match": 1},
}
_PLAIN_NUMBERS = {"ground_relative": False, "numerical_decoding": False}
_PAPER_TRAINING = {"dvae_start": False, "similar_lengths": False}
_PAPER = {
    **_PAPER_MASKING,
    **_PAPER_DECODING,
    **_NO_AUGMENTATION,
    **_NO_EDGES,
    **_PAPER_LOSSES,
    **_PLAIN_NUMBERS,
    **_PAPER_TRAINING,
}


class Ablation(Section):
    """Variants of the model with individual settings changed (target ablation)."""

    variants: dict[Annotated[str, Field(pattern=r"^[a-z0-9_]+$")], dict[str, Any]] = Field(
        {
            "plus": {},
            "plus_seed_1": {"seed": 1},
            "plus_seed_2": {"seed": 2},
            "paper": _PAPER,
            "masking_of_paper": _PAPER_MASKING,
            "decoding_of_paper": _PAPER_DECODING,
            "one_view": {"decoding": {"num_rotations": 1}},
            "losses_of_paper": _PAPER_LOSSES,
            "no_augmentation": _NO_AUGMENTATION,
            "no_occlusion": {"augmentation": {"occlusion_share": 0}},
            "all_auxiliary": {"auxiliary_share": 1},
            "no_ground": {"ground_relative": False},
            "no_numerical_decoding": {"numerical_decoding": False},
            "no_edge_attention": {"edge_attention": False},
            "no_edges": _NO_EDGES,
        },
        min_length=1,
        description="for each variant, by name: its changes of section model; each variant is trained once",
    )
