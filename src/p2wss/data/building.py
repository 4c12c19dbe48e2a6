"""A building before and after its reconstruction, as every stage sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from p2wss.data.points import points_on_building


@dataclass(frozen=True)
class Building:
    """A footprint with its points, before its reconstruction.

    rings: footprint, each (n, 2), exterior first and counter-clockwise, courtyards clockwise, relative to
    ``origin_xy_m``. point_m: (m, 3), x and y relative to the origin, z in the height system of the cloud.
    classification: uint8 (m,), LAS classes. ground_z_m: z of the ground at the building as the cloud shows it
    (:func:`p2wss.data.cloud_crops.crop_cloud`), the zero of all its heights; NaN only without points.
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

    @property
    def is_on_building(self) -> np.ndarray:
        """Which points are on the building, bool (m,): see :func:`p2wss.data.points.points_on_building`."""
        return points_on_building(self.polygon, self.point_m, self.classification, self.ground_z_m)


@dataclass(frozen=True)
class Reconstruction:
    """What a method makes of a building: parameters and a mesh, or a status that says why there is none.

    rings: of the mesh, relative to ``origin_xy_m`` like its x and y; z is above ``ground_z_m``. vertex_m: (v, 3).
    triangle: int32 (t, 3), (0, 3) without a mesh. kind: uint8 (t,), :class:`p2wss.skeleton.FaceKind`. edge: int32
    (t,), the footprint edge that the face grows from, -1 for none; of several parts the number of its plane.
    eave_height_m: above ``ground_z_m``. angle_deg: one per edge over all rings. num_parts: with a height each; of
    several, ``eave_height_m`` is that of the largest and ``angle_deg`` those of the parts along the footprint.
    confidence: the expected share of right numbers, 0 to 1. class_probability: of a network, (edges, 3): that each
    edge has 0 degrees, 90 degrees or a slope. status: a value of :mod:`p2wss.data.reasons`; a mesh with another
    status than "ok" is the flat roof that stands in for one.
    """

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


def no_mesh(building: Building, method: str, status: str) -> Reconstruction:
    """The row of a building that a method could not reconstruct."""
    return Reconstruction(
        building.building_id,
        building.tile,
        method,
        status,
        building.origin_xy_m,
        building.ground_z_m,
        building.rings,
        None,
        None,
        None,
        np.zeros((0, 3)),
        np.zeros((0, 3), np.int32),
        np.zeros(0, np.uint8),
        np.zeros(0, np.int32),
    )
