"""Section buildings: parametric buildings by weighted straight skeleton."""

from __future__ import annotations

from pydantic import Field

from p2wss.config.base import Section, Share


class Buildings(Section):
    """Parametric buildings by weighted straight skeleton."""

    max_roof_height_m: float = Field(12, gt=0, description="a roof that would rise further is cut flat")
    max_failed_fraction: Share = Field(
        0.02, description="share of rejected buildings past which the job fails"
    )
