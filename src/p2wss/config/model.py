"""Section model: the Point2WSS network and its training."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from p2wss.config.base import Section, Share
from p2wss.config.training import Compute, Optimiser


class Masking(Section):
    """What is masked during training, for the model to predict. The paper: random tokens only (share not stated)."""

    inference_share: Share = Field(
        0.8,
        description="share of samples with all digits of height and angles masked, as at inference",
    )
    table1_share: Share = Field(
        0.1,
        description="share of samples with all digits masked",
    )
    disturbed_share: Share = Field(
        0.0,
        description="share of samples with all digits of height and angles masked, and with misplaced vertices "
        "whose true coordinates are to be predicted, too; in the remaining samples, random tokens are masked",
    )
    disturbance_m: float = Field(
        2.0,
        gt=0,
        description="largest standard deviation of the misplaced coordinates; each sample has its own",
    )
    random_ratio: tuple[Share, Share] = Field(
        (0.15, 1.0), description="range of the share of tokens masked at random"
    )
    patch_ratio: tuple[Share, Share] = Field(
        (0.25, 0.45), description="range of the share of patches masked, in one block"
    )


class Augmentation(Section):
    """Random changes of each training sample, in addition to the paper's rotation."""

    scale: tuple[float, float] = Field(
        (0.8, 1.25), description="range of the scale applied to the whole building; [1, 1] = off"
    )
    lift_m: float = Field(
        2.0, ge=0, description="maximum vertical shift, up or down, of everything above the ground"
    )
    jitter_m: float = Field(0.02, ge=0, description="standard deviation of the noise added to the points")
    keep_points: tuple[Share, Share] = Field(
        (0.4, 1.0), description="range of the share of points that are kept; [1, 1] = off"
    )
    on_building_share: Share = Field(
        0.0,
        description="share of samples that keep only the points on the building; above 0, so does inference",
    )
    occlusion_share: Share = Field(
        0.1, description="share of samples from which the points of a wedge are removed, as in a scan shadow"
    )


class LossWeights(Section):
    """Weights of the losses in the total. The paper has four: 1, 1, 1, 1."""

    cloud: float = Field(0.3, ge=0, description="weight of predicting masked patches")
    sequence: float = Field(1.0, ge=0, description="weight of predicting masked parameter tokens")
    number: float = Field(
        0.1, ge=0, description="weight of predicting the values of numbers, with numerical_decoding"
    )
    modal: float = Field(0.1, ge=0, description="weight of the alignment of both encoders")
    match: float = Field(
        0.1, ge=0, description="weight of the matching loss after the cross-modality encoders"
    )


class Decoding(Section):
    """How the probabilities of digits are turned into values. The paper: argmax, all, 1, 0."""

    mode: Literal["argmax", "median"] = Field(
        "median",
        description="argmax = the most likely digit at each position; median = the median of the joint "
        "distribution of all digits",
    )
    angle_support: Literal["roofs", "all"] = Field(
        "roofs", description="angles that may be predicted: roofs = 0, 90 and 20 to 45; all = 0 to 90"
    )
    num_rotations: int = Field(
        4, ge=1, le=64, description="number of rotated views of a building whose probabilities are averaged"
    )
    num_refinements: int = Field(
        1,
        ge=0,
        description="with all digits masked, how often the predicted footprint is given to the network again: "
        "the last time for height and angles, before that for better coordinates",
    )


class ModelOptimiser(Optimiser):
    """AdamW with a cosine warm-up and a cosine decay of the learning rate."""

    num_steps: int = Field(800, ge=1, description="number of training steps (batches)")
    batch_size: int = Field(32, ge=2, le=65536, description="number of buildings per batch")


class Model(Section):
    """Stage model: Point2WSS, the multimodal transformer. Points and patches are those of section dvae."""

    weights: str = Field("", description="file with trained weights to use instead of training; '' = train")
    start: str = Field("", description="file with trained weights to start from; '' = from random weights")
    seed: int = Field(0, ge=0, description="seed of initial weights, batches and augmentation")
    max_vertices: int = Field(
        16, ge=3, le=128, description="buildings with more vertices are not used for training"
    )
    coord_decimals: Literal[1, 2] = Field(1, description="decimals of coordinates in tokens; 2 is slower")
    hundreds: bool = Field(
        False, description="encode heights and coordinates up to 999 m; false = below 100 m"
    )
    dim: int = Field(64, ge=8, le=4096, multiple_of=8, description="width of the transformer")
    num_heads: int = Field(4, ge=1, le=256, description="number of attention heads; must divide dim")
    mlp_ratio: float = Field(4.0, gt=0, le=64, description="hidden width of the MLPs, as a multiple of dim")
    drop_path: Share = Field(
        0.0, description="rate of stochastic depth in the last block; lower in earlier blocks"
    )
    cloud_depth: int = Field(2, ge=1, le=128, description="number of blocks of the point cloud encoder")
    sequence_depth: int = Field(1, ge=1, le=128, description="number of blocks of the parameter encoder")
    cross_depth: int = Field(2, ge=1, le=128, description="number of blocks of each cross-modality encoder")
    align_dim: int = Field(
        64, ge=1, le=4096, description="width of the space in which both modalities are aligned"
    )
    auxiliary_share: float = Field(
        0.25,
        ge=0,
        le=1,
        description="share of each batch for which the losses cloud, modal and match are computed; 0 = without "
        "these losses; the paper: 1",
    )
    similar_lengths: bool = Field(
        True,
        description="batches hold buildings with similar numbers of vertices, which takes less time and "
        "memory; false = any buildings",
    )
    dvae_start: bool = Field(
        True,
        description="the encoder of patches starts from that of the dVAE, as in Point-BERT; false = from "
        "random weights",
    )
    match_balanced: bool = Field(
        True,
        description="matching and non-matching pairs have equal weight in the matching loss; false = 0.1 and "
        "0.9 as in the paper",
    )
    ground_relative: bool = Field(True, description="patches also encode their height above the ground")
    numerical_decoding: bool = Field(
        True, description="the digits of a number are also predicted from a value that they share"
    )
    edge_embedding: bool = Field(
        True,
        description="parameter tokens also encode the geometry of their footprint edge, unless it is masked",
    )
    edge_attention: bool = Field(
        True, description="parameter tokens also attend to the patches by their position relative to the edge"
    )
    loss_weights: LossWeights = LossWeights()
    masking: Masking = Masking()
    augmentation: Augmentation = Augmentation()
    decoding: Decoding = Decoding()
    optimiser: ModelOptimiser = ModelOptimiser()
    checkpoint_every_steps: int = Field(
        200, ge=1, description="number of steps between checkpoints, and between validations"
    )
    num_validation: int = Field(
        128, ge=1, description="number of buildings of the split val used for validation during training"
    )
    compute: Compute = Compute()

    @model_validator(mode="after")
    def _heads_divide(self) -> Self:
        if self.dim % self.num_heads:
            raise ValueError("num_heads must divide dim")
        return self
