"""The whole config: all sections."""

import itertools
from typing import Any, Self, TypeVar

from pydantic import ValidationError, model_validator

from p2wss.config.base import Section, merge
from p2wss.config.crops import Crops, Dataset
from p2wss.config.eval import Eval
from p2wss.config.fetch import Fetch
from p2wss.config.reconstruct import Reconstruct
from p2wss.config.region import Region
from p2wss.config.scans import Scans
from p2wss.config.scenes import Buildings, Scenes
from p2wss.config.training import Ablation, Dvae, Model

S = TypeVar("S", bound=Section)
# sections that a member of a data set may change
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
    def _sections_fit(self) -> Self:
        for name, changes in self.ablation.variants.items():
            changed(self.model, changes, f"ablation.variants.{name}")
        members = [self._of_member(number) for number in range(len(self.dataset.members))]
        keys = ["", *(f"dataset.members.{number}: " for number in range(len(members)))]
        # a command gets only the sections of its stage; the other sections have their defaults
        given = self.model_fields_set
        for key, each in zip(keys, [self, *members], strict=True):
            if {"fetch", "scenes"} <= given and each.fetch.margin_m < each.scenes.margin_m + 30:
                raise ValueError(f"{key}fetch.margin_m must be at least scenes.margin_m + 30")
            # at the border of a tile, a crop would lack a part of its points
            if {"scans", "crops"} <= given and each.scans.keep_margin_m < each.crops.buffer_m:
                raise ValueError(f"{key}scans.keep_margin_m must be at least crops.buffer_m")
        # terrain and clouds are stored by vintage and tile alone: two members with the same ones would share the first
        # one's
        for first, second in itertools.combinations(
            range(len(members)) if {"region", "fetch"} <= given else (), 2
        ):
            one, other = members[first], members[second]
            is_same = (one.fetch.of_tiles, one.region.crs) == (other.fetch.of_tiles, other.region.crs)
            if one.region.shares_files(other.region) and not is_same:
                raise ValueError(
                    f"{keys[1 + second]}has the region.vintage and a part of the area of member "
                    f"{self.dataset.members[first].name}, but other terrain, clouds or fetch.margin_m; name a vintage "
                    "of its own"
                )
        return self

    def _of_member(self, number: int) -> Self:
        """The config with the changes of a member."""
        member, key = self.dataset.members[number], f"dataset.members.{number}"
        return self.model_copy(
            update={
                name: changed(getattr(self, name), getattr(member, name), f"{key}.{name}")
                for name in MEMBER_SECTIONS
            }
        )


def changed(section: S, changes: dict[str, Any], key: str) -> S:
    """``section`` with ``changes``. key: the place of the changes in the config, for the ``ValueError`` of a wrong
    change."""
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
