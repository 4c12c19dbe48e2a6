"""A building before and after its reconstruction, as every stage sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

NO_POINT = "no point"
# of the heights of a cloud without ground points: the foot of a wall, at best
GROUND_QUANTILE = 0.02


@dataclass(frozen=True)
class Building:
    """What is known of one building before its reconstruction.

    rings: footprint, each (n, 2), exterior first and counter-clockwise, courtyards clockwise, relative to
    ``origin_xy_m``. point_m: (m, 3), x and y relative to the origin, z in the height system of the cloud.
    classification: uint8 (m,). ground_z_m: z of the ground at the building, NaN if unknown.
    """

    building_id: str
    tile: str
    origin_xy_m: tuple[float, float]
    rings: Sequence[np.ndarray]
    point_m: np.ndarray
    classification: np.ndarray
    ground_z_m: float

    @property
    def polygon(self) -> shapely.Polygon:
        return shapely.Polygon(self.rings[0], self.rings[1:])


@dataclass(frozen=True)
class Reconstruction:
    """One row of ``io.RECONSTRUCTIONS``: what a method made of a building. Without a mesh, ``triangle`` is
    (0, 3) and ``status`` says why. Mesh: x and y relative to ``origin_xy_m``, z above ``ground_z_m``.

    num_parts: with a height each. Of several, ``eave_height_m`` is that of the largest, ``angle_deg`` those of
    the parts along the footprint, and ``edge`` numbers the planes instead of the edges. class_probability: of a
    network, (edges, 3): that each edge has 0 degrees, 90 degrees or a slope."""

    building_id: str
    tile: str
    method: str
    status: str
    origin_xy_m: tuple[float, float]
    ground_z_m: float
    rings: Sequence[np.ndarray]
    eave_height_m: float | None
    angle_deg: np.ndarray | None
    confidence: float | None
    vertex_m: np.ndarray
    triangle: np.ndarray
    kind: np.ndarray
    edge: np.ndarray
    num_parts: int = 1
    class_probability: np.ndarray | None = None

    @property
    def has_mesh(self) -> bool:
        return len(self.triangle) > 0


def ground_z_m(building: Building) -> float:
    """The ground that the crop found, else a low quantile of the points; NaN without any."""
    if np.isfinite(building.ground_z_m):
        return float(building.ground_z_m)
    return (
        float(np.quantile(building.point_m[:, 2], GROUND_QUANTILE)) if len(building.point_m) else float("nan")
    )


def no_mesh(building: Building, method: str, status: str) -> Reconstruction:
    """The row of a building that a method could not reconstruct."""
    return Reconstruction(
        building.building_id,
        building.tile,
        method,
        status,
        building.origin_xy_m,
        ground_z_m(building),
        building.rings,
        None,
        None,
        None,
        np.zeros((0, 3)),
        np.zeros((0, 3), np.int32),
        np.zeros(0, np.uint8),
        np.zeros(0, np.int32),
    )
