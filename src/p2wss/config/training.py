"""Settings shared by the sections of both trainings, dvae and model."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from p2wss.config.base import Section, Share


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
