"""From points and footprints to closed buildings: by the network, flat, or with constant values.

Everything here works on buildings in memory. The evaluation and ``p2wss reconstruct`` share it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction
from p2wss.fit.mesh import build_meshes, kernel_angles, mesh_footprint, simplify_exterior, transfer_angles


class Parameters(Protocol):
    """Decoded parameters of b buildings: heights above ground (b,), an array of angles per building with a
    value per edge over all rings, another (edges, 3) with the probabilities of 0 degrees, 90 degrees and a slope,
    confidence (b,) from 0 to 1. NaN: the network cannot take the footprint."""

    @property
    def eave_height_m(self) -> np.ndarray: ...

    @property
    def angle_deg(self) -> Sequence[np.ndarray]: ...

    @property
    def class_probability(self) -> Sequence[np.ndarray]: ...

    @property
    def confidence(self) -> np.ndarray: ...


class Predictor(Protocol):
    """The part of :class:`p2wss.model.Predictor` that reconstruction needs."""

    @property
    def max_num_vertices(self) -> int:
        """Largest number of vertices of an exterior ring."""
        ...

    def with_num_views(self, num_views: int) -> Predictor:
        """The same network, which averages over so many views of a building."""
        ...

    def predict(self, points_m: Sequence[np.ndarray], rings: Sequence[Sequence[np.ndarray]]) -> Parameters:
        """From points (n, 3) with z above the estimated ground, and rings as in :class:`Building`."""
        ...


def reconstruct_with_network(
    buildings: Sequence[Building], predictor: Predictor, config: Reconstruct, method: str = "point2wss"
) -> list[Reconstruction]:
    """One reconstruction per building with the network's height and angles, in the order given.

    A building with fewer than ``min_num_points`` points, or whose mesh the kernel rejects, has no mesh here
    and a status; :func:`with_fallback` gives it a flat roof.
    """
    meshed = [mesh_footprint(building, config) for building in buildings]
    seen = [simplify_exterior(rings, predictor.max_num_vertices) for rings in meshed]
    ground = [building.ground_z_m for building in buildings]
    height = np.full(len(buildings), np.nan)
    confidence = np.full(len(buildings), np.nan)
    angle = [np.zeros(sum(map(len, rings))) for rings in meshed]
    odds: list[np.ndarray | None] = [None] * len(buildings)
    status = [reasons.OK if len(b.point_m) else reasons.NO_POINTS for b in buildings]
    enough = []
    for i, building in enumerate(buildings):
        if len(building.point_m) >= config.min_num_points:
            enough.append(i)
        elif status[i] == reasons.OK:
            status[i] = reasons.TOO_FEW_POINTS
    if enough:
        decoded = predictor.predict(
            [buildings[i].point_m - [0, 0, ground[i]] for i in enough], [seen[i] for i in enough]
        )
        for k, i in enumerate(enough):
            if np.isfinite(decoded.eave_height_m[k]):
                height[i] = max(float(decoded.eave_height_m[k]), config.min_eave_height_m)
                confidence[i] = decoded.confidence[k]
                angle[i] = kernel_angles(transfer_angles(seen[i], decoded.angle_deg[k], meshed[i]))
                odds[i] = transfer_angles(seen[i], decoded.class_probability[k], meshed[i])
            else:
                status[i] = reasons.FOOTPRINT_TOO_LARGE
    made = build_meshes(buildings, meshed, ground, height, angle, confidence, method, config, status)
    return [replace(one, class_probability=own) for one, own in zip(made, odds, strict=True)]
