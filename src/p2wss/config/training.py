"""What the sections of both trainings share."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from p2wss.config.base import Section, Share


class Optimiser(Section):
    """AdamW, cosine warm-up, then cosine decay, per step."""

    num_steps: int = Field(200, ge=1, description="batches to train on")
    batch_size: int = Field(64, ge=2, description="buildings per step")
    learning_rate: float = Field(2e-3, gt=0, description="highest")
    learning_rate_end: float = Field(1e-6, ge=0, description="at the last step")
    warmup_share: Share = Field(0.05, description="of the steps, with the rate rising")
    weight_decay: float = Field(
        5e-4, ge=0, description="not on biases, norms, embeddings, codebooks and tokens"
    )
    beta2: float = Field(0.98, gt=0, lt=1, description="of AdamW")
    gradient_clip: float = Field(1.0, gt=0, description="largest norm of the gradient")


class Compute(Section):
    """Where and how it is trained; what is learnt depends on it by rounding only."""

    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="auto: a GPU where there is one")
    precision: Literal["float32", "bfloat16"] = Field(
        "float32", description="of matrix products (autocast); weights and losses stay float32"
    )
    compile: bool = Field(
        False, description="compile the networks first (torch.compile): long trainings only"
    )
    resident: bool = Field(False, description="keep the clouds in the memory of the device")
    tensorboard: bool = Field(False, description="metrics for TensorBoard too, beside the checkpoints")
