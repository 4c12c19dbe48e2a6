"""Section dataset: several regions, and several draws of each, as one data set."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from p2wss.config.base import Section


class Member(Section):
    """A region of the data set: what differs from the other sections of the config."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9_-]*[A-Za-z_-][A-Za-z0-9_-]*$",
        description="names its folders; not a number alone, which would be a draw",
    )
    draws: int = Field(
        1,
        ge=1,
        le=999,
        description="times that heights, roofs and survey are drawn, each with seeds of its own",
    )
    split: Literal["", "blocks", "train", "val", "test"] = Field(
        "", description="crops.split of this member; '' = as in section crops"
    )
    region: dict[str, Any] = Field({}, description="settings of section region that differ for this member")
    fetch: dict[str, Any] = Field({}, description="settings of section fetch that differ for this member")
    scenes: dict[str, Any] = Field({}, description="settings of section scenes that differ for this member")
    scans: dict[str, Any] = Field({}, description="settings of section scans that differ for this member")


class Dataset(Section):
    """Several regions as one data set, and how many of their buildings are used."""

    name: str = Field(
        "", pattern=r"^[A-Za-z0-9_-]*$", description="results go to results/<name>; '' = region.name"
    )
    members: list[Member] = Field([], description="regions with their draws; [] = the one of section region")
    seed: int = Field(0, ge=0, description="seed of the choice of buildings")
    num_pairs: int = Field(
        0,
        ge=0,
        description="simulated buildings to use, chosen at random: 80 % train, 10 % val, 10 % test; 0 = all",
    )
    num_lidar_dvae: int = Field(
        0, ge=0, description="real clouds for the training of the dvae; 0 = all, also those of the test"
    )
    num_lidar_test: int = Field(
        0, ge=0, description="other real clouds for the evaluation; 0 = all, also those of the dvae"
    )

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        names = [member.name for member in self.members]
        if len(set(names)) < len(names):
            raise ValueError("members must have different names")
        if (self.num_lidar_dvae == 0) != (self.num_lidar_test == 0):
            raise ValueError("num_lidar_dvae and num_lidar_test must both be 0 or both be given")
        return self
