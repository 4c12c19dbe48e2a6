"""Buildings from networks: heights and angles that are predicted, and roofs that are supposed between few points."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction
from p2wss.fit.parametric import (
    MIN_NUM_POINTS,
    build_meshes,
    kernel_angles,
    simplify_exterior,
    transfer_angles,
)
from p2wss.fit.settings import THRESHOLDS
from p2wss.nets.prediction import Prediction
from p2wss.nets.supposed import supposed_roof


class Predictor(Protocol):
    """The part of :class:`p2wss.nets.predictor.Point2WssPredictor` that reconstruction needs."""

    @property
    def max_num_vertices(self) -> int:
        """The largest number of vertices of an exterior ring that the network takes."""

    @property
    def on_building(self) -> bool:
        """Whether the network was also trained on clouds of only the points on a building, and should get only such."""

    def predict(self, points_m: Sequence[np.ndarray], rings: Sequence[Sequence[np.ndarray]]) -> Prediction:
        """The heights and angles of buildings. points_m: for each building (n, 3), z above the ground. rings: as in
        :class:`Building`."""


def reconstruct_with_network(
    buildings: Sequence[Building], predictor: Predictor, config: Reconstruct
) -> list[Reconstruction]:
    """One reconstruction per building with the network's height and angles, in order.

    A building with fewer than ``min_num_points`` points, or whose mesh the kernel rejects, has a status and no mesh;
    :func:`p2wss.reconstruction.flat.with_fallback` replaces it by a flat roof.
    """
    mesh_rings = [building.rings for building in buildings]
    network_rings = [simplify_exterior(rings, predictor.max_num_vertices) for rings in mesh_rings]
    height = np.full(len(buildings), np.nan)
    angle = [np.zeros(sum(map(len, rings))) for rings in mesh_rings]
    num_points = [len(building.point_m) for building in buildings]
    with_points = [i for i, num in enumerate(num_points) if num >= config.min_num_points]
    status = [reasons.TOO_FEW_POINTS if num else reasons.NO_POINTS for num in num_points]
    if with_points:
        prediction = predictor.predict(
            [
                _on_building_m(buildings[i]) if predictor.on_building else buildings[i].point_m
                for i in with_points
            ],
            [network_rings[i] for i in with_points],
        )
        for k, i in enumerate(with_points):
            if np.isfinite(prediction.eave_height_m[k]):
                height[i] = max(float(prediction.eave_height_m[k]), config.min_eave_height_m)
                angle_deg = transfer_angles(network_rings[i], prediction.angle_deg[k], mesh_rings[i])
                angle[i] = kernel_angles(angle_deg)
            status[i] = reasons.OK if np.isfinite(height[i]) else reasons.FOOTPRINT_TOO_LARGE
    return build_meshes(buildings, mesh_rings, height, angle, "point2wss", config, status)


def with_supposed_roofs(buildings: Sequence[Building]) -> list[Building]:
    """The buildings, in which buildings with few points per square metre get ``supposed_m``: the roof that a network
    supposes between the points (:mod:`p2wss.nets.supposed`)."""
    result = []
    for building in buildings:
        roof_m = building.point_m[building.is_on_building]
        has_planes = len(roof_m) + len(building.around_m) >= THRESHOLDS.min_plane_points
        if has_planes and MIN_NUM_POINTS <= len(roof_m) < THRESHOLDS.known_per_m2 * building.polygon.area:
            supposed_m = supposed_roof(building.polygon, roof_m, building.around_m)
            building = replace(building, supposed_m=supposed_m)
        result.append(building)
    return result


def _on_building_m(building: Building) -> np.ndarray:
    """The points (n, 3) on the building; all points if these are too few to show a roof. Plants, neighbours and things
    on the ground are left out because they look different in the simulation from which the network learnt."""
    on_m = building.point_m[building.is_on_building]
    return on_m if len(on_m) >= MIN_NUM_POINTS else building.point_m
