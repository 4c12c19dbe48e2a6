"""Section crops: the points of each building and the splits."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from p2wss.config.base import Section


class Crops(Section):
    """Stage crops: the points of each building, in shards, with splits."""

    seed: int = Field(0, ge=0, description="seed of the split")
    buffer_m: float = Field(
        1, gt=0, le=20, description="distance from the footprint within which points belong to a building"
    )
    min_points: int = Field(20, ge=1, description="buildings with fewer points are excluded")
    split: Literal["blocks", "train", "val", "test"] = Field(
        "blocks",
        description="blocks = split by location, see below; otherwise all buildings are in the named split",
    )
    block_size_m: float = Field(
        125, gt=0, description="edge length of the square blocks that are assigned to train, val or test"
    )
    guard_m: float = Field(
        10,
        ge=0,
        description="val and test buildings closer than this to a building of another split are not used",
    )
