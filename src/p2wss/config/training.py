"""Sections dvae and model, the trainings of both networks, and what they share. Section ablation: variants of the model
to train and compare."""

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from p2wss.config.base import Section, Share

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


class Optimiser(Section):
    """AdamW with a cosine warm-up and a cosine decay of the learning rate, or a constant rate between ramps."""

    num_steps: int = Field(200, ge=1, description="number of training steps (batches)")
    batch_size: int = Field(64, ge=2, le=65536, description="number of buildings per batch")
    learning_rate: float = Field(2e-3, gt=0, description="peak learning rate, after the warm-up")
    learning_rate_end: float = Field(1e-6, ge=0, description="learning rate at the last step")
    warmup_share: Share = Field(
        0.05, description="share of the steps in which the learning rate rises to its peak"
    )
    ramp_steps: int = Field(
        0,
        ge=0,
        description="number of steps in which the learning rate rises at the beginning, and falls at the end; "
        "in between it is constant, so that a training can be extended. 0 = warmup_share and a cosine decay",
    )
    weight_decay: float = Field(
        5e-4, ge=0, description="weight decay, not applied to biases, norms, embeddings, codebooks and tokens"
    )
    beta2: float = Field(0.98, gt=0, lt=1, description="beta2 of AdamW")
    gradient_clip: float = Field(1.0, gt=0, description="gradients with a larger norm are scaled down to it")


DeviceName = Literal["auto", "cpu", "cuda"]


class Compute(Section):
    """Where and how training runs; results change by rounding only, with several processes by their draws, too."""

    device: DeviceName = Field("auto", description="where to train; auto = a GPU if there is one")
    num_gpus: int = Field(
        1,
        ge=1,
        description="number of processes of the training in the workflow, started by torchrun: one per GPU, "
        "or as many on CPUs; the resource gpu of a profile takes precedence",
    )
    compile: bool = Field(
        False,
        description="compile the networks when a training begins (torch.compile): steps are faster after a minute or "
        "more; for one process, on a GPU",
    )
    precision: Literal["float32", "bfloat16"] = Field(
        "float32", description="precision of matrix products (autocast); weights and losses stay in float32"
    )


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
