"""The whole config: all sections."""

from __future__ import annotations

from typing import Any, Self, TypeVar

from pydantic import ValidationError, model_validator

from p2wss.config.ablation import Ablation
from p2wss.config.base import Section, merge
from p2wss.config.buildings import Buildings
from p2wss.config.crops import Crops
from p2wss.config.dataset import Dataset
from p2wss.config.dvae import Dvae
from p2wss.config.eval import Eval
from p2wss.config.fetch import Fetch
from p2wss.config.model import Model
from p2wss.config.reconstruct import Reconstruct
from p2wss.config.region import Region
from p2wss.config.scans import Scans
from p2wss.config.scenes import Scenes

S = TypeVar("S", bound=Section)
# of which a member of a data set may have changes
MEMBER_SECTIONS = ("region", "fetch", "scenes", "scans")


class Config(Section):
    """All sections, in the order of the pipeline."""

    region: Region = Region()
    dataset: Dataset = Dataset()
    fetch: Fetch = Fetch()
    scenes: Scenes = Scenes()
    buildings: Buildings = Buildings()
    scans: Scans = Scans()
    crops: Crops = Crops()
    dvae: Dvae = Dvae()
    model: Model = Model()
    ablation: Ablation = Ablation()
    eval: Eval = Eval()
    reconstruct: Reconstruct = Reconstruct()

    @model_validator(mode="after")
    def _changes_are_valid(self) -> Self:
        for name, changes in self.ablation.variants.items():
            changed(self.model, changes, f"ablation.variants.{name}")
        for number, member in enumerate(self.dataset.members):
            for name in MEMBER_SECTIONS:
                changed(getattr(self, name), getattr(member, name), f"dataset.members.{number}.{name}")
        return self

    @model_validator(mode="after")
    def _terrain_under_margins(self) -> Self:
        # a command gets only the sections of its stage; the other sections have their defaults
        if not {"fetch", "scenes"} <= self.model_fields_set:
            return self
        margins_m = {"": (self.fetch.margin_m, self.scenes.margin_m)}
        for number, member in enumerate(self.dataset.members):
            key = f"dataset.members.{number}: "
            fetch, scenes = changed(self.fetch, member.fetch, key), changed(self.scenes, member.scenes, key)
            margins_m[key] = fetch.margin_m, scenes.margin_m
        for key, (of_fetch_m, of_scenes_m) in margins_m.items():
            if of_fetch_m < of_scenes_m + 30:
                raise ValueError(f"{key}fetch.margin_m must be at least scenes.margin_m + 30")
        return self

    @model_validator(mode="after")
    def _points_in_buffers(self) -> Self:
        # at the border of a tile, a crop would lack a part of its points
        if {"scans", "crops"} <= self.model_fields_set:
            keys = {
                f"dataset.members.{number}: ": each.scans for number, each in enumerate(self.dataset.members)
            }
            for key, changes in {"": {}, **keys}.items():
                if changed(self.scans, changes, key).keep_margin_m < self.crops.buffer_m:
                    raise ValueError(f"{key}scans.keep_margin_m must be at least crops.buffer_m")
        return self

    @model_validator(mode="after")
    def _vintages_have_one_source(self) -> Self:
        # terrain and clouds are stored by vintage and tile alone: of two members, both would get those of the first
        if not {"region", "fetch"} <= self.model_fields_set:
            return self
        members: dict[str, tuple[Region, dict[str, Any]]] = {}
        for number, member in enumerate(self.dataset.members):
            key = f"dataset.members.{number}"
            region, fetch = changed(self.region, member.region, key), changed(self.fetch, member.fetch, key)
            source = fetch.of_tiles | {"crs": region.crs}
            for name, (other, of_other) in members.items():
                if other.shares_files(region) and source != of_other:
                    raise ValueError(
                        f"{key}: has the region.vintage and a part of the area of member {name}, but other terrain, "
                        "clouds or fetch.margin_m; name a vintage of its own"
                    )
            members[member.name] = region, source
        return self


def changed(section: S, changes: dict[str, Any], key: str) -> S:
    """A section with changes. key: where they stand, for the ``ValueError`` of a wrong one."""
    values = section.model_dump(mode="json")
    merge(values, changes)
    try:
        return section.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{'.'.join([key, *map(str, first['loc'])])}: {first['msg']}") from None


def ablated(config: Config, variant: str) -> Config:
    """The config with the changes of an ablation variant applied to section model."""
    return config.model_copy(
        update={"model": changed(config.model, config.ablation.variants[variant], variant)}
    )
