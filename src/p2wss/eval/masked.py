"""Table 1 with the footprint masked too: what the network reads, and the same after the outline is fitted.

The network reads the outline and the height (:meth:`MaskedPredictor.reconstruct_all_masked`), the outline is fitted to
the points (:mod:`p2wss.reconstruct.outline_fit`), the network reads height and angles again with the fitted outline
given, and these are fitted to the points as ``p2wss reconstruct`` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from p2wss.config import Reconstruct
from p2wss.data.building import Building
from p2wss.eval.predict import for_dataset
from p2wss.reconstruct.network import Predictor
from p2wss.reconstruct.outline_fit import fit_outline
from p2wss.reconstruct.product import reconstruct_buildings
from p2wss.storage.schemas.crops import SIMULATED


class MaskedPredictor(Predictor, Protocol):
    """The part of :class:`p2wss.nets.predictor.Predictor` that Table 1 needs."""

    def reconstruct_all_masked(
        self, points_m: Sequence[np.ndarray], footprints_m: Sequence[np.ndarray], signs_visible: bool = True
    ) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        """Heights (b,), footprints (v, 2) and angles (v,) with all numerical tokens masked."""
        ...


@dataclass(frozen=True)
class MaskedParameters:
    """Parameters of b buildings: eave_height_m (b,), above the ground; per building xy_m (v, 2) and angle_deg (v,)."""

    eave_height_m: np.ndarray
    xy_m: list[np.ndarray]
    angle_deg: list[np.ndarray]


def read_all_masked(
    buildings: Sequence[Building], predictor: MaskedPredictor, signs_visible: bool
) -> MaskedParameters:
    """The reading of the network. Of the footprints it gets the number of vertices and their order, and perhaps the
    signs of the centred coordinates."""
    if not buildings:
        return MaskedParameters(np.zeros(0), [], [])
    height, xy, angle = predictor.reconstruct_all_masked(
        [_above_ground(building) for building in buildings],
        [building.rings[0] for building in buildings],
        signs_visible,
    )
    return MaskedParameters(height, xy, angle)


def fit_all_masked(
    buildings: Sequence[Building], reading: MaskedParameters, predictor: MaskedPredictor, config: Reconstruct
) -> MaskedParameters:
    """``reading`` (with visible signs) after the fit of the outlines and that of heights and angles.

    A building keeps the height and the angles of its reading where the second pass has none.
    """
    if not buildings:
        return reading
    outlines = []
    for i, building in enumerate(buildings):
        # the order of the tokens, which begin at the uppermost vertex, is no secret: see the tokenizer
        first = uppermost_vertex(building.rings[0])
        read_m = np.roll(reading.xy_m[i], -first, axis=0)
        height_m = float(reading.eave_height_m[i])
        outline = fit_outline(read_m, height_m, _above_ground(building), building.classification)
        outlines.append(np.roll(outline, first, axis=0))
    fitted = [
        replace(building, rings=[outline]) for building, outline in zip(buildings, outlines, strict=True)
    ]
    rows = reconstruct_buildings(fitted, predictor, for_dataset(config, SIMULATED))
    height, angle = reading.eave_height_m.copy(), list(reading.angle_deg)
    for i, row in enumerate(rows):
        if (
            row.eave_height_m is not None
            and row.angle_deg is not None
            and len(row.angle_deg) == len(angle[i])
        ):
            height[i], angle[i] = row.eave_height_m, row.angle_deg
    return MaskedParameters(height, outlines, angle)


def uppermost_vertex(ring: np.ndarray) -> int:
    """The vertex (v, 2) with the largest y, of several the leftmost, in whole centimetres."""
    x, y = np.rint(100 * ring).T
    return int(np.lexsort([x, -y])[0])


def _above_ground(building: Building) -> np.ndarray:
    return building.point_m - [0, 0, building.ground_z_m]
