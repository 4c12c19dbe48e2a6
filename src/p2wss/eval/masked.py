"""Table 1 with the footprint masked too: what the network predicts, and the same after the outline is fitted.

The network predicts the outline and the height (:meth:`MaskedPredictor.reconstruct_all_masked`). In its place comes the
outline of ``p2wss outlines`` that has as many vertices, its edges moved as the registration moves footprints. The
network predicts height and angles again with this outline given, and these are fitted as ``p2wss reconstruct`` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import shapely

from p2wss.clouds.reading import Cloud
from p2wss.config import Outlines, Reconstruct
from p2wss.data.building import Building
from p2wss.reconstruct.network import Predictor
from p2wss.reconstruct.outlines import outlines
from p2wss.reconstruct.product import reconstruct_buildings
from p2wss.reconstruct.shifts import edge_steps, point_weights
from p2wss.storage.errors import InputError

# one outline without seams around all points; from outlines of more and more short edges to ever coarser ones
_OUTLINES = [
    Outlines(overhang_m=0, jump_m=1000, max_area_m2=1e9, min_edge_m=min_edge_m)
    for min_edge_m in (0.8, 1.5, 2.5, 4.0)
]
# points of class building this far below the eaves are on a wall or on a lower annex
_BELOW_EAVES_M = 0.6
# where the roof of the building ends before them: half a sign
_LOW_WEIGHT = -0.5
# an edge that the network predicted farther from where the points end is misplaced
_MAX_MISREADING_M = 2.0
# edges whose directions differ by less (the sine) have no corner
_MIN_SINE = 0.3


class MaskedPredictor(Predictor, Protocol):
    """The part of :class:`p2wss.nets.predictor.Point2WssPredictor` that Table 1 needs."""

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
        [building.point_m for building in buildings],
        [building.rings[0] for building in buildings],
        signs_visible,
    )
    return MaskedParameters(height, xy, angle)


def fit_all_masked(
    buildings: Sequence[Building], reading: MaskedParameters, predictor: MaskedPredictor, config: Reconstruct
) -> MaskedParameters:
    """``reading`` (with visible signs) after the fit of the outlines and that of heights and angles.

    A building keeps its reading where no outline has as many vertices, and the height and the angles of its reading
    where the second pass has none.
    """
    height, xy_m, angle = reading.eave_height_m.copy(), list(reading.xy_m), list(reading.angle_deg)
    fitted = {}
    for i, building in enumerate(buildings):
        outline = fitted_outline(xy_m[i], float(height[i]), building.point_m, building.classification)
        if outline is not None:
            xy_m[i], fitted[i] = outline, replace(building, rings=[outline])
    rows = reconstruct_buildings(list(fitted.values()), predictor, config) if fitted else []
    for i, row in zip(fitted, rows, strict=True):
        if (
            row.eave_height_m is not None
            and row.angle_deg is not None
            and len(row.angle_deg) == len(angle[i])
        ):
            height[i], angle[i] = row.eave_height_m, row.angle_deg
    return MaskedParameters(height, xy_m, angle)


def fitted_outline(
    reading_m: np.ndarray, eave_height_m: float, point_m: np.ndarray, classification: np.ndarray
) -> np.ndarray | None:
    """The outline of the points (v, 2), its vertices in the order of the reading; None where there is none of as many
    vertices.

    reading_m: (v, 2), counter-clockwise, as the network predicts it, not necessarily simple. eave_height_m: as the
    network predicts it, above the ground. point_m: (n, 3), z above the ground. classification: LAS classes (n,).

    An edge is where its step from building to ground is. Where a building continues beyond it, as at a party wall,
    there is none, and the edge is where the network predicted it.
    """
    outline = _traced(reading_m, point_m, classification)
    if outline is None:
        return None
    ends = np.column_stack([outline, np.roll(outline, -1, axis=0)])
    x_m, y_m = point_m[:, :2].T.copy()
    weight = point_weights(classification)
    weight[(weight > 0) & (point_m[:, 2] < eave_height_m - _BELOW_EAVES_M)] = _LOW_WEIGHT
    inside = np.where(shapely.contains_xy(shapely.Polygon(outline), x_m, y_m), 0, -1)
    of_outline = np.zeros(len(outline), np.int64)
    step_m = edge_steps(ends, of_outline, x_m, y_m, weight, inside).offset_m
    along = ends[:, 2:] - ends[:, :2]
    normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    middle = (ends[:, :2] + ends[:, 2:]) / 2
    read_m = (((reading_m + np.roll(reading_m, -1, axis=0)) / 2 - middle) * normal).sum(axis=1)
    read_m[np.abs(read_m) > _MAX_MISREADING_M] = 0
    offset = (middle * normal).sum(axis=1) + np.where(np.isfinite(step_m), step_m, read_m)
    matrix = np.stack([np.roll(normal, 1, axis=0), normal], axis=1)
    if (np.abs(np.linalg.det(matrix)) < _MIN_SINE).any():
        return outline
    corner: np.ndarray = np.linalg.solve(matrix, np.column_stack([np.roll(offset, 1), offset])[..., None])
    return corner[..., 0] if shapely.Polygon(corner[..., 0]).is_valid else outline


def _traced(reading_m: np.ndarray, point_m: np.ndarray, classification: np.ndarray) -> np.ndarray | None:
    """The finest outline with as many vertices as the reading, which begins where that does."""
    count, (x_m, y_m, z_m) = len(reading_m), point_m.T
    cloud = Cloud(x_m, y_m, z_m, classification, None)
    for settings in _OUTLINES:
        try:
            polygons = outlines(cloud, settings)
        except InputError:
            return None
        largest = shapely.orient_polygons(polygons[np.argmax(shapely.area(polygons))])
        corner = shapely.get_coordinates(largest.exterior)[:-1]
        if len(corner) == count:
            turned = [np.roll(corner, first, axis=0) for first in range(count)]
            return min(turned, key=lambda xy_m: float(np.abs(xy_m - reading_m).sum()))
    return None
