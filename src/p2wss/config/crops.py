"""Section crops: the points of each building and the splits. Section dataset: several regions, and several draws of
each, as one data set."""

from typing import Any, Literal, Self

from pydantic import Field, model_validator

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


class Member(Section):
    """A region of the data set: the settings that differ from the other sections of the config."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9_-]*[A-Za-z_-][A-Za-z0-9_-]*$",
        description="name of the folders of this member; must not be a number, because numbers name draws",
    )
    draws: int = Field(
        1,
        ge=1,
        le=999,
        description="number of random draws of heights, roofs and survey, each with its own seeds",
    )
    split: Literal["", "blocks", "train", "val", "test"] = Field(
        "", description="value of crops.split for this member; '' = as in section crops"
    )
    region: dict[str, Any] = Field({}, description="settings of section region that differ for this member")
    fetch: dict[str, Any] = Field({}, description="settings of section fetch that differ for this member")
    scenes: dict[str, Any] = Field({}, description="settings of section scenes that differ for this member")
    scans: dict[str, Any] = Field({}, description="settings of section scans that differ for this member")


class Dataset(Section):
    """Several regions combined in one data set, and the number of their buildings to use."""

    name: str = Field(
        "", pattern=r"^[A-Za-z0-9_-]*$", description="results go to results/<name>; '' = region.name"
    )
    members: list[Member] = Field(
        [], description="regions with their draws; [] = only the region of section region"
    )
    seed: int = Field(0, ge=0, description="seed of the selection of buildings")
    num_pairs: int = Field(
        0,
        ge=0,
        description="number of simulated buildings to use, selected at random: 80 % train, 10 % val, 10 % "
        "test; 0 = all",
    )
    num_lidar_dvae: int = Field(
        0,
        ge=0,
        description="number of real clouds for the training of the dVAE; 0 = all, including those of the "
        "test",
    )
    num_lidar_test: int = Field(
        0,
        ge=0,
        description="number of other real clouds for the evaluation; 0 = all, including those of the dVAE",
    )

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        names = [member.name for member in self.members]
        if len(set(names)) < len(names):
            raise ValueError("members must have different names")
        if (self.num_lidar_dvae == 0) != (self.num_lidar_test == 0):
            raise ValueError("num_lidar_dvae and num_lidar_test must both be 0 or both be above 0")
        return self
