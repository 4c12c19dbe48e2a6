"""Base class and types of all sections."""

import json
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

Share = Annotated[float, Field(ge=0, le=1)]


class Section(BaseModel):
    """Base class of all sections: unknown keys are errors, and instances are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Shares(Section):
    """Relative frequencies. At least one must be above zero."""

    @model_validator(mode="after")
    def _not_all_zero(self) -> Self:
        if not sum(self.model_dump().values()) > 0:
            raise ValueError("at least one share must be above 0")
        return self


def _in_order(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError("must be [lower bound, upper bound]")
    return bounds


NonNegativeRange = Annotated[
    tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]], AfterValidator(_in_order)
]
PositiveRange = Annotated[
    tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]], AfterValidator(_in_order)
]
HalfAngleRange = Annotated[
    tuple[Annotated[float, Field(ge=1, le=45)], Annotated[float, Field(ge=1, le=45)]],
    AfterValidator(_in_order),
]


def merge(target: dict[str, Any], other: dict[str, Any]) -> None:
    """Overwrite values of ``target`` with values of ``other``, recursively in nested mappings."""
    for key, value in other.items():
        if isinstance(value, dict) and isinstance(target.get(key), dict):
            merge(target[key], value)
        else:
            target[key] = json.loads(json.dumps(value)) if isinstance(value, dict) else value
