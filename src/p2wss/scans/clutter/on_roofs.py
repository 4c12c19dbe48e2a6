"""Clutter on roofs: dormers, chimneys, raised parts, skylights, parapets; and wedges of missing data."""

from __future__ import annotations

import numpy as np

from p2wss.scans.clutter.buildings import LocalBuildings, between, draw_buildings, edges, left_of, rectangles
from p2wss.scans.clutter.roofs import NUM_TRIES, Anchors, Roofs, draw_anchors, fitting_anchors
from p2wss.scans.clutter.triangles import BLOCK_TRIANGLES, ClutterTriangles, blocks, copies
from p2wss.scans.surface import ClutterKind

# Sizes are drawn evenly between two values in metres, unless they are shares or slopes; half sizes are from the middle.
_MAX_DORMERS = 3
_DORMER_HALF_WIDTH_M, _DORMER_HEIGHT_M = (0.5, 1.1), (0.8, 1.4)
# of the gable of a dormer, as a share of its half width; slopes (rise over run) of the roofs that carry dormers; and
# the least slope that the length of a dormer is computed with
_DORMER_RISE, _DORMER_SLOPES, _MIN_DORMER_SLOPE = (0.3, 1.0), (0.35, 2.0), 0.05
# a chimney reaches so far below the lowest point of the roof beside it
_CHIMNEY_HALF_LENGTH_M, _CHIMNEY_HALF_WIDTH_M, _CHIMNEY_HEIGHT_M = (0.2, 0.5), (0.2, 0.4), (0.5, 1.6)
_CHIMNEY_DEPTH_M = 0.2
# a raised part reaches so far below the roof at so many metres downhill of its middle
_RAISED_HALF_SIZE_M, _RAISED_HEIGHT_M = (1.0, 2.2), (1.0, 3.0)
_RAISED_DEPTH_M, _RAISED_DOWNHILL_M = 0.5, 3
_SKYLIGHT_HALF_LENGTH_M, _SKYLIGHT_HALF_WIDTH_M, _SKYLIGHT_ABOVE_M = (0.4, 1.2), (0.4, 2.5), 0.04
_PARAPET_HEIGHT_M, _PARAPET_WIDTH_M, _PARAPET_DEPTH_M = (0.3, 1.0), 0.25, 0.1
# half the opening angle of a wedge without points, radians; its length; and how far above the roof it hides pulses
_SHADE_HALF_ANGLE_RAD, _SHADE_LENGTH_M, _SHADE_ABOVE_M = (0.15, 0.5), (5, 15), (6, 14)
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


def raised_parts(roofs: Roofs, buildings: LocalBuildings, share: float) -> ClutterTriangles:
    """Higher parts inside the footprint: stair heads, lift houses, raised bays."""
    rows, u = draw_buildings(buildings, ClutterKind.RAISED_PART, share)
    half, height = between(u[:, :2], *_RAISED_HALF_SIZE_M), between(u[:, 2], *_RAISED_HEIGHT_M)

    def outline(at: Anchors, index: np.ndarray) -> np.ndarray:
        return rectangles(at.point_m[:, :2], at.uphill, half[index])

    index, at = fitting_anchors(roofs, rows, u[:, 3:], outline, on_one_face=False)
    low = at.point_m[:, 2] - _RAISED_DOWNHILL_M * at.slope - _RAISED_DEPTH_M
    return blocks(outline(at, index), low, at.point_m[:, 2] + height[index], at.row)


def skylights(
    roofs: Roofs, buildings: LocalBuildings, share: float, loss: tuple[float, float]
) -> ClutterTriangles:
    """Windows and solar panels, 4 cm above the slope: they mirror most pulses away from the sensor."""
    rows, u = draw_buildings(buildings, ClutterKind.SKYLIGHT, share)
    half = np.stack(
        [between(u[:, 0], *_SKYLIGHT_HALF_LENGTH_M), between(u[:, 1], *_SKYLIGHT_HALF_WIDTH_M)], axis=1
    )

    def outline(at: Anchors, index: np.ndarray) -> np.ndarray:
        half_in_plan = half[index] / np.stack([np.sqrt(1 + at.slope**2), np.ones(len(at.slope))], axis=1)
        return rectangles(at.point_m[:, :2], at.uphill, half_in_plan)

    index, at = fitting_anchors(roofs, rows, u[:, 3:], outline)
    xy = outline(at, index)
    rise = ((xy - at.point_m[:, None, :2]) * at.uphill[:, None]).sum(axis=2) * at.slope[:, None]
    corner = np.concatenate([xy, (at.point_m[:, 2:3] + rise + _SKYLIGHT_ABOVE_M)[..., None]], axis=2)
    panes = copies(corner, [(0, 1, 2), (0, 2, 3)], at.row)
    return panes._replace(loss=np.repeat(between(u[index, 2], *loss), 2).astype(np.float32))


def parapets(roofs: Roofs, buildings: LocalBuildings, share: float) -> ClutterTriangles:
    """A low wall along every edge of a flat roof."""
    rows, u = draw_buildings(buildings, ClutterKind.PARAPET, share)
    is_flat = roofs.is_flat(rows)
    rows, height = rows[is_flat], between(u[is_flat, 0], *_PARAPET_HEIGHT_M)
    start, end = edges(buildings.polygons)
    offset = buildings.polygons.vertex_offset
    num_edges = np.diff(offset)[rows]
    edge = np.repeat(offset[rows] - np.cumsum(num_edges) + num_edges, num_edges) + np.arange(num_edges.sum())
    number = np.repeat(np.arange(len(rows)), num_edges)
    a, b = start[edge], end[edge]
    inwards = _PARAPET_WIDTH_M * left_of((b - a) / np.maximum(np.linalg.norm(b - a, axis=1), 1e-9)[:, None])
    outline = np.stack([a, b, b + inwards, a + inwards], axis=1)
    eave = buildings.eave_z_m[rows][number]
    walls = blocks(outline, eave - _PARAPET_DEPTH_M, eave + height[number], rows[number])
    return walls._replace(number=np.repeat(number, len(BLOCK_TRIANGLES)).astype(np.int32))


def shades(roofs: Roofs, buildings: LocalBuildings, share: float) -> ClutterTriangles:
    """Missing data: a triangle high above the roof from which no return is detected hides a wedge of it."""
    rows, u = draw_buildings(buildings, ClutterKind.SHADE, share)
    has_roof = roofs.has_roof(rows)
    rows, u = rows[has_roof], u[has_roof]
    at = draw_anchors(roofs, rows, u[:, :3])
    turn = 2 * np.pi * u[:, 3:4] + between(u[:, 4:5], *_SHADE_HALF_ANGLE_RAD) * np.array([[-1.0, 1.0]])
    corner = np.repeat(at.point_m[:, None], 3, axis=1)
    corner[:, 1:, :2] += between(u[:, 5], *_SHADE_LENGTH_M)[:, None, None] * np.stack(
        [np.cos(turn), np.sin(turn)], axis=2
    )
    corner[:, :, 2] += between(u[:, 6], *_SHADE_ABOVE_M)[:, None]
    wedges = copies(corner, [(0, 1, 2)], at.row)
    return wedges._replace(loss=np.ones(len(wedges.loss), np.float32))
