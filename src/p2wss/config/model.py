"""Section model: Point2WSS."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from p2wss.config.base import Section, Share
from p2wss.config.training import Compute, Optimiser


class Masking(Section):
    """What the model must restore while it trains. The paper: 0, 0 and [0.3, 0.3]."""

    inference_share: Share = Field(0.8, description="samples that hide all digits of height and angles")
    table1_share: Share = Field(0.1, description="samples that hide all digits; the rest hide random tokens")
    random_ratio: tuple[Share, Share] = Field((0.15, 1.0), description="share of tokens hidden at random")
    patch_ratio: tuple[Share, Share] = Field((0.25, 0.45), description="share of patches hidden, in a block")


class Augmentation(Section):
    """Random changes of a building each time it is seen, besides the paper's rotation."""

    mirror: bool = Field(True, description="mirror half of the samples")
    scale: tuple[float, float] = Field(
        (0.8, 1.25), description="[1, 1] = off; scales the building as a whole"
    )
    lift_m: float = Field(2.0, ge=0, description="raise or lower what stands above the ground by up to this")
    jitter_m: float = Field(0.02, ge=0, description="noise on the points, standard deviation")
    keep_points: tuple[Share, Share] = Field((0.4, 1.0), description="share of the points kept; [1, 1] = off")
    occlusion_share: Share = Field(0.1, description="samples that lack the points of a wedge")


class LossWeights(Section):
    """Weights of the four losses in the total. The paper: 1, 1, 1, 1."""

    cloud: float = Field(0.3, ge=0, description="restoring masked patches")
    sequence: float = Field(1.0, ge=0, description="restoring masked parameter tokens")
    modal: float = Field(0.1, ge=0, description="alignment of the encoders")
    match: float = Field(0.1, ge=0, description="matching of pairs after the cross-modality encoders")


class Decoding(Section):
    """From probabilities of digits to values. The paper: argmax, all, 1."""

    mode: Literal["argmax", "median"] = Field("median", description="per digit, or of the joint distribution")
    angle_support: Literal["roofs", "all"] = Field(
        "roofs", description="angles that may be answered: 0, 90 and 20 to 45, or 0 to 90"
    )
    num_rotations: int = Field(4, ge=1, le=64, description="views whose probabilities are averaged")


class ModelOptimiser(Optimiser):
    """AdamW, cosine warm-up, then cosine decay, per step."""

    num_steps: int = Field(800, ge=1, description="batches to train on")
    batch_size: int = Field(32, ge=2, description="buildings per step")


class Model(Section):
    """Point2WSS, the multimodal transformer. Points and patches are those of the dvae."""

    weights: str = Field("", description="trained weights to use instead of training; '' = train")
    seed: int = Field(0, ge=0, description="of weights, batches and augmentation")
    max_vertices: int = Field(16, ge=3, le=128, description="buildings with more are left out of training")
    coord_decimals: Literal[1, 2] = Field(1, description="of coordinates in tokens; the paper's 2 is slower")
    hundreds: bool = Field(False, description="digits up to 999 m; without, heights and coordinates < 100 m")
    dim: int = Field(64, ge=8, multiple_of=8, description="width")
    num_heads: int = Field(4, ge=1, description="of attention; divides the width")
    mlp_ratio: float = Field(4.0, gt=0, description="hidden width of the MLPs over the width")
    drop_path: Share = Field(0.0, description="stochastic depth, at the last block")
    cloud_depth: int = Field(2, ge=1, description="blocks of the point cloud encoder")
    sequence_depth: int = Field(1, ge=1, description="blocks of the parameter encoder")
    cross_depth: int = Field(2, ge=1, description="blocks of each cross-modality encoder")
    align_dim: int = Field(64, ge=1, description="width of the space in which both modalities are aligned")
    auxiliary_share: float = Field(
        0.25,
        gt=0,
        le=1,
        description="share of a batch that also restores patches, is aligned and matched; the paper: 1",
    )
    match_balanced: bool = Field(
        True, description="matching loss halved between pairs and non-pairs, or 0.1/0.9"
    )
    ground_relative: bool = Field(True, description="patches also know their height above the ground")
    numerical_encoding: bool = Field(
        True, description="digits also carry their value (Regression Transformer)"
    )
    edge_embedding: bool = Field(
        True, description="tokens also carry the geometry of their edge where visible"
    )
    edge_attention: bool = Field(
        True, description="tokens also gather from the patches what lies where, seen from their edge"
    )
    ema_decay: float = Field(0.99, ge=0, lt=1, description="of the averaged weights that are kept; 0 = off")
    loss_weights: LossWeights = LossWeights()
    masking: Masking = Masking()
    augmentation: Augmentation = Augmentation()
    decoding: Decoding = Decoding()
    optimiser: ModelOptimiser = ModelOptimiser()
    checkpoint_every_steps: int = Field(200, ge=1, description="also: how often validation runs")
    num_validation: int = Field(128, ge=1, description="buildings of the val split to measure while training")
    compute: Compute = Compute()

    @model_validator(mode="after")
    def _heads_divide(self) -> Self:
        if self.dim % self.num_heads:
            raise ValueError("num_heads must divide dim")
        return self
