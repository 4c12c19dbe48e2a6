"""Clutter on roofs: dormers and chimneys."""

from __future__ import annotations

import numpy as np

from p2wss.scans.clutter.buildings import (
    ClutterTriangles,
    LocalBuildings,
    between,
    blocks,
    copies,
    draw_buildings,
    left_of,
    rectangles,
)
from p2wss.scans.clutter.roofs import NUM_TRIES, Anchors, Roofs, fitting_anchors
from p2wss.scans.surface import ClutterKind

# Sizes are drawn evenly between two values in metres, unless they are shares or slopes; half sizes are from the middle.
_MAX_DORMERS = 3
_DORMER_HALF_WIDTH_M, _DORMER_HEIGHT_M = (0.5, 1.1), (0.8, 1.4)
# height of the gable of a dormer, as a share of its half width; slopes (rise over run) of the roofs that carry dormers;
# the least slope with which the length of a dormer is computed
_DORMER_RISE, _DORMER_SLOPES, _MIN_DORMER_SLOPE = (0.3, 1.0), (0.35, 2.0), 0.05
# sizes of a chimney, and how far it reaches below the lowest point of the roof beside it
_CHIMNEY_HALF_LENGTH_M, _CHIMNEY_HALF_WIDTH_M, _CHIMNEY_HEIGHT_M = (0.2, 0.5), (0.2, 0.4), (0.5, 1.6)
_CHIMNEY_DEPTH_M = 0.2
# corners as in _dormer_corners: front wall with its gable, two side walls, two roof faces
_DORMER_TRIANGLES = [
    (0, 1, 3),
    (0, 3, 2),
    (2, 3, 4),
    (0, 2, 5),
    (1, 6, 3),
    (2, 4, 7),
    (2, 7, 5),
    (3, 6, 7),
    (3, 7, 4),
]


def dormers(roofs: Roofs, buildings: LocalBuildings, share: float) -> ClutterTriangles:
    """Gabled dormers: a front wall stands on the slope, the ridge runs level into it."""
    building_rows, u = draw_buildings(buildings, ClutterKind.DORMER, share)
    num_dormers = 1 + np.minimum((u[:, 0] * _MAX_DORMERS).astype(int), _MAX_DORMERS - 1)
    is_used = (np.arange(_MAX_DORMERS)[None] < num_dormers[:, None]).ravel()
    rows = np.repeat(building_rows, _MAX_DORMERS)[is_used]
    size = np.repeat(u[:, 1:4], _MAX_DORMERS, axis=0)[is_used]  # dormers of a building are alike
    place = u[:, 4 : 4 + 3 * NUM_TRIES * _MAX_DORMERS].reshape(-1, 3 * NUM_TRIES)[is_used]
    half_width, height = between(size[:, 0], *_DORMER_HALF_WIDTH_M), between(size[:, 1], *_DORMER_HEIGHT_M)
    rise = half_width * between(size[:, 2], *_DORMER_RISE)

    def outline(at: Anchors, index: np.ndarray) -> np.ndarray:
        return _dormer_corners(at, half_width[index], height[index], rise[index])[:, [0, 1, 5, 6, 7], :2]

    index, at = fitting_anchors(roofs, rows, place, outline, slopes=_DORMER_SLOPES)
    corner = _dormer_corners(at, half_width[index], height[index], rise[index])
    return copies(corner, _DORMER_TRIANGLES, at.row)


def _dormer_corners(at: Anchors, half_width: np.ndarray, height: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Corners (k, 8, 3): bottom left and right, top left and right, gable; where the left eave, the right
    eave and the ridge meet the slope."""
    corner = np.empty((len(half_width), 8, 3))
    side, slope = left_of(at.uphill) * half_width[:, None], np.maximum(at.slope, _MIN_DORMER_SLOPE)
    back, ridge_back = (height / slope)[:, None], ((height + rise) / slope)[:, None]
    xy = at.point_m[:, :2]
    corner[:, 0, :2] = corner[:, 2, :2] = xy + side
    corner[:, 1, :2] = corner[:, 3, :2] = xy - side
    corner[:, 4, :2] = xy
    corner[:, 5, :2], corner[:, 6, :2] = xy + side + back * at.uphill, xy - side + back * at.uphill
    corner[:, 7, :2] = xy + ridge_back * at.uphill
    z = at.point_m[:, 2]
    corner[:, :2, 2] = z[:, None]
    corner[:, [2, 3, 5, 6], 2] = (z + height)[:, None]
    corner[:, [4, 7], 2] = (z + height + rise)[:, None]
    return corner


def chimneys(roofs: Roofs, buildings: LocalBuildings, share: float) -> ClutterTriangles:
    """Small blocks anywhere on the roof."""
    rows, u = draw_buildings(buildings, ClutterKind.CHIMNEY, share)
    half = np.stack(
        [between(u[:, 0], *_CHIMNEY_HALF_LENGTH_M), between(u[:, 1], *_CHIMNEY_HALF_WIDTH_M)], axis=1
    )
    height = between(u[:, 2], *_CHIMNEY_HEIGHT_M)

    def outline(at: Anchors, index: np.ndarray) -> np.ndarray:
        return rectangles(at.point_m[:, :2], at.uphill, half[index])

    index, at = fitting_anchors(roofs, rows, u[:, 3:], outline, on_one_face=False)
    low = at.point_m[:, 2] - at.slope - _CHIMNEY_DEPTH_M
    return blocks(outline(at, index), low, at.point_m[:, 2] + height[index], at.row)
