"""Section crops: the points of each building, and the splits."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from p2wss.config.base import Section


class Crops(Section):
    """Points of each building, in shards, with splits."""

    seed: int = Field(0, ge=0, description="of the split")
    buffer_m: float = Field(
        1, gt=0, le=20, description="points within this distance of the footprint are kept"
    )
    min_points: int = Field(20, ge=1, description="buildings with fewer points are left out")
    max_points: int = Field(
        2048, ge=1, description="buildings with more points are marked as truncated; all points are kept"
    )
    split: Literal["blocks", "train", "val", "test"] = Field(
        "blocks", description="blocks: by place, see below; else every building of the region is in this one"
    )
    block_size_m: float = Field(
        125, gt=0, description="edge of the square blocks that go to train, val or test as a whole"
    )
    guard_m: float = Field(
        10, ge=0, description="val and test buildings nearer than this to another split are set aside"
    )
