"""Section eval: tables, figures, report."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from p2wss.config.base import Section


class Eval(Section):
    """Tables 1 and 2 of the paper, and the report."""

    seed: int = Field(0, ge=0, description="of the points sampled on meshes")
    baselines: list[Literal["lod1", "constant", "roofer"]] = Field(
        ["lod1", "constant", "roofer"], description="methods beside ours; roofer only where it is installed"
    )
    lidar_name: str = Field(
        "stand-in LiDAR", min_length=1, description="what the report calls the clouds of region.lidar_tiles"
    )
    attribution: list[str] = Field(
        [], description="lines of the report's footer beside those of fetch.sources"
    )
    num_samples: int = Field(2048, gt=0, description="points sampled on each mesh for the Chamfer distance")
    max_num_points: int = Field(2048, gt=0, description="points of a cloud used for it: a subset by the seed")
    num_resamples: int = Field(1000, ge=10, description="bootstrap draws behind each 95 % interval")
    num_worst: int = Field(
        20, ge=0, le=100, description="buildings shown per data set, worst first, with the reason"
    )
    num_pictures: int = Field(
        2, ge=0, le=20, description="buildings shown for each counterpart of the paper's Figures 7 to 14"
    )
    roofer_command: str = Field(
        "roofer",
        description="Roofer and its options ({folder} = folder of its input and output, for containers); '' = never",
    )
    roofer_recorded: str = Field(
        "",
        description="what an earlier Roofer made of this LiDAR (CityJSON, folder), where none is installed; '' = none",
    )
    roofer_timeout_s: float = Field(3600, gt=0, description="for one run of Roofer, one tile")
