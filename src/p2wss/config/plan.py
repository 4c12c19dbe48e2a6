"""Section plan: what ``p2wss plan`` assumes."""

from __future__ import annotations

from pydantic import Field

from p2wss.config.base import Section


class Plan(Section):
    """Assumptions of p2wss plan where no counts exist yet; no result depends on them."""

    buildings_per_km2: float = Field(
        900,
        gt=0,
        description="number of usable buildings per km2 of the tiles; 900 as in the miniature, a small town",
    )
    member_buildings_per_km2: dict[str, float] = Field(
        {}, description="the same for individual members of the data set, by name"
    )
