"""The whole config: all sections."""

from __future__ import annotations

from typing import Self

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
from p2wss.config.plan import Plan
from p2wss.config.reconstruct import Reconstruct
from p2wss.config.region import Region
from p2wss.config.scans import Scans
from p2wss.config.scenes import Scenes


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
    plan: Plan = Plan()

    @model_validator(mode="after")
    def _variants_are_models(self) -> Self:
        for name in self.ablation.variants:
            try:
                ablated(self, name)
            except ValidationError as error:
                first = error.errors()[0]
                key = ".".join(["ablation.variants", name, *map(str, first["loc"])])
                raise ValueError(f"{key}: {first['msg']}") from None
        return self

    @model_validator(mode="after")
    def _members_are_regions(self) -> Self:
        sections: dict[str, type[Section]] = {
            "region": Region,
            "fetch": Fetch,
            "scenes": Scenes,
            "scans": Scans,
        }
        for number, member in enumerate(self.dataset.members):
            for name, model in sections.items():
                try:
                    merged = getattr(self, name).model_dump(mode="json")
                    merge(merged, getattr(member, name))
                    model.model_validate(merged)
                except ValidationError as error:
                    first = error.errors()[0]
                    key = ".".join(["dataset.members", str(number), name, *map(str, first["loc"])])
                    raise ValueError(f"{key}: {first['msg']}") from None
        return self

    @model_validator(mode="after")
    def _terrain_under_margins(self) -> Self:
        # a command gets only the sections of its stage; the other sections have their defaults
        both_given = {"fetch", "scenes"} <= self.model_fields_set
        if both_given and self.fetch.margin_m < self.scenes.margin_m + 30:
            raise ValueError("fetch.margin_m must be at least scenes.margin_m + 30")
        return self


def ablated(config: Config, variant: str) -> Config:
    """The config with the changes of an ablation variant applied to section model."""
    section = config.model.model_dump(mode="json")
    merge(section, config.ablation.variants[variant])
    return config.model_copy(update={"model": Model.model_validate(section)})
