"""Section scenes: tiles, clean footprints, heights and roof angles."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from p2wss.config.base import Section, Share


class RoofShares(Section):
    """How often each roof type is drawn; what cannot be built on a footprint becomes the nearest that can."""

    gable: float = Field(0.44, ge=0, description="two slopes, vertical gables; wings get gables of their own")
    hip: float = Field(0.18, ge=0, description="slopes on all sides")
    half_hip: float = Field(0.1, ge=0, description="one end hipped, the other a gable")
    shed: float = Field(0.06, ge=0, description="one slope")
    flat: float = Field(0.14, ge=0, description="no slope")
    mixed: float = Field(0.08, ge=0, description="each edge on its own")

    @model_validator(mode="after")
    def _not_all_zero(self) -> Self:
        if not sum(self.model_dump().values()) > 0:
            raise ValueError("at least one share must be above 0")
        return self


class Scenes(Section):
    """Cut tiles, clean footprints, draw heights and roof angles."""

    seed: int = Field(0, ge=0, description="of heights and angles")
    margin_m: float = Field(
        60, ge=0, description="buildings this near to a tile stand in its scene, as occluders"
    )
    simplify_tolerance_m: float = Field(
        0.2,
        ge=0,
        le=5,
        description="outlines may move by this much to lose vertices (Douglas-Peucker); 0 = never",
    )
    min_edge_m: float = Field(0.1, ge=0.01, le=5, description="shorter edges are taken out")
    min_area_m2: float = Field(2, gt=0, description="smaller footprints and courtyards are left out")
    max_edges: int = Field(1000, ge=3, le=5000, description="footprints with more edges are left out")
    min_eave_height_m: float = Field(1.5, gt=0, description="a lower height counts as unknown")
    max_eave_height_m: float = Field(99, gt=0, description="higher buildings are left out")
    storey_height_m: float = Field(
        3, gt=0, description="of a building whose number of floors is all that is known"
    )
    min_terrain_share: Share = Field(
        0.5, description="of a footprint's outline that must lie on known terrain, else it is left out"
    )
    sampler: Literal["realistic", "uniform"] = Field(
        "realistic",
        description="angles by roof type, or (the paper's words) each edge from 0, 90, 20..45 alike",
    )
    roof_shares: RoofShares = RoofShares()
    max_rise_m: float = Field(
        7,
        gt=0,
        description="the realistic sampler draws flatter roofs for buildings whose roof would rise more",
    )
    max_failed_fraction: Share = Field(
        0.1, description="share of rejected buildings past which the job fails; too small ones do not count"
    )
