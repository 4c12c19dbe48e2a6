"""Section buildings: building meshes from the weighted straight skeleton."""

from __future__ import annotations

from pydantic import Field

from p2wss.config.base import Section, Share


class Buildings(Section):
    """Stage buildings: closed meshes from the weighted straight skeleton."""

    max_roof_height_m: float = Field(
        12, gt=0, description="roofs that would rise further above the eaves are cut off horizontally"
    )
    max_failed_fraction: Share = Field(
        0.02, description="the job fails if a larger share of the buildings is rejected"
    )
