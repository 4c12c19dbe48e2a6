"""A building as it is generated: wings with simple roofs, independent of the kernel, so that they can test it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import cast

import numpy as np
import shapely


@dataclass
class Wing:
    """A piece of roof: eaves along ``slopes`` (edges of ``outline``), gables or walls along the others."""

    outline: np.ndarray  # (n, 2) m, counter-clockwise
    eave_m: float  # above the ground
    pitch_deg: float
    slopes: tuple[int, ...]  # edge i runs from vertex i to i + 1; none = a flat roof

    def rise_m(self, xy: np.ndarray) -> np.ndarray:
        """Roof above the eave at ``xy`` (n, 2): the lowest of the planes that rise from the eaves."""
        if not self.slopes:
            return np.zeros(len(xy))
        start = self.outline[list(self.slopes)]
        end = np.roll(self.outline, -1, axis=0)[list(self.slopes)]
        along = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
        offset = xy[:, None, :] - start
        inside = along[:, 0] * offset[..., 1] - along[:, 1] * offset[..., 0]
        return np.maximum(inside, 0).min(axis=1) * np.tan(np.radians(self.pitch_deg))


@dataclass
class DrawnBuilding:
    """Wings that touch; their union is the footprint."""

    wings: list[Wing]
    kind: str  # house, row, block, hall, annex
    footprint: shapely.Polygon = field(default_factory=shapely.Polygon)

    def __post_init__(self) -> None:
        # 0.1 m is the resolution of BD TOPO; the tiny opening closes slits between wings
        union = shapely.union_all(
            [shapely.Polygon(wing.outline).buffer(0.01, join_style="mitre") for wing in self.wings]
        )
        union = union.buffer(-0.01, join_style="mitre").simplify(0.03)
        # wings that do not touch make a MultiPolygon, which draw_town throws away
        self.footprint = cast(shapely.Polygon, shapely.normalize(shapely.set_precision(union, 0.1)))

    @property
    def eave_m(self) -> float:
        """Eave height of the largest wing, above the ground."""
        return max(self.wings, key=lambda wing: shapely.Polygon(wing.outline).area).eave_m
