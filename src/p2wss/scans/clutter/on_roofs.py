"""Clutter on roofs: dormers and chimneys, and the places where they fit."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

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
from p2wss.scans.surface import ClutterKind, Surface
from p2wss.skeleton.types import FaceKind, cross

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
NUM_TRIES = 4  # places that are tried for an object that must fit on a roof


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


class Roofs(NamedTuple):
    """m roof triangles, ordered by building: building b has ``offset[b]:offset[b + 1]``.

    corner_m: float64 (m, 3, 3). face: int32 (m,), face ids. area_before_m2: float64 (m + 1,), of all
    triangles before each.
    """

    corner_m: np.ndarray
    face: np.ndarray
    offset: np.ndarray
    area_before_m2: np.ndarray


class Anchors(NamedTuple):
    """k points on roofs.

    row: of the building. face: face id. point_m: float64 (k, 3). uphill: float64 (k, 2), unit direction.
    slope: float64 (k,), rise over run.
    """

    row: np.ndarray
    face: np.ndarray
    point_m: np.ndarray
    uphill: np.ndarray
    slope: np.ndarray


def roofs_of(surface: Surface, num_buildings: int) -> Roofs:
    """The roof triangles of a surface."""
    kind = surface.face & 3
    triangle = np.flatnonzero((kind == FaceKind.ROOF) | (kind == FaceKind.FLAT))
    triangle = triangle[np.argsort(surface.building[triangle], kind="stable")]
    corner = surface.vertex_m[surface.triangle[triangle]]
    area = 0.5 * np.linalg.norm(_normals(corner), axis=1)
    offset = np.searchsorted(surface.building[triangle], np.arange(num_buildings + 1))
    return Roofs(corner, surface.face[triangle], offset, np.concatenate([[0.0], np.cumsum(area)]))


def _normals(corner_m: np.ndarray) -> np.ndarray:
    """Upward normals of triangles (n, 3, 3), whose lengths are twice the areas."""
    normal = np.cross(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])
    return normal * np.where(normal[:, 2:] < 0, -1.0, 1.0)


def _draw_anchors(roofs: Roofs, rows: np.ndarray, u: np.ndarray) -> Anchors:
    """A random point on the roof of each of ``rows``, from three uniform draws each, u (k, 3)."""
    first, last = roofs.area_before_m2[roofs.offset[rows]], roofs.area_before_m2[roofs.offset[rows + 1]]
    target = first + u[:, 0] * (last - first)
    index = np.searchsorted(roofs.area_before_m2, target, side="right") - 1
    index = np.clip(index, roofs.offset[rows], roofs.offset[rows + 1] - 1)
    corner = roofs.corner_m[index]
    root = np.sqrt(u[:, 1:2])
    point = (
        (1 - root) * corner[:, 0] + root * (1 - u[:, 2:3]) * corner[:, 1] + root * u[:, 2:3] * corner[:, 2]
    )
    normal = _normals(corner)
    horizontal = np.linalg.norm(normal[:, :2], axis=1)
    is_level = horizontal < 1e-9 * np.abs(normal[:, 2])
    uphill = np.where(
        is_level[:, None], [1.0, 0.0], -normal[:, :2] / np.where(is_level, 1, horizontal)[:, None]
    )
    return Anchors(rows, roofs.face[index], point, uphill, np.where(is_level, 0, horizontal / normal[:, 2]))


def fitting_anchors(
    roofs: Roofs,
    rows: np.ndarray,
    u: np.ndarray,
    outline: Callable[[Anchors, np.ndarray], np.ndarray],
    on_one_face: bool = True,
    slopes: tuple[float, float] = (0.0, np.inf),
) -> tuple[np.ndarray, Anchors]:
    """Anchors at which an object lies on the roof: for each of ``rows`` the first that fits, if any does.

    ``outline(anchors, index)`` gives the corners (k, p, 2) of the objects ``rows[index]`` in plan. ``u`` has
    three draws per row and try. Returns the indices into ``rows`` of the objects that fit, and their anchors.
    """
    indices, anchors = [], []
    pending = np.flatnonzero(roofs.offset[rows + 1] > roofs.offset[rows])
    for attempt in range(NUM_TRIES):
        tried = _draw_anchors(roofs, rows[pending], u[pending, 3 * attempt : 3 * attempt + 3])
        fits = (tried.slope >= slopes[0]) & (tried.slope <= slopes[1])
        face = tried.face if on_one_face else np.full(len(pending), -1, np.int32)
        fits &= _are_over_roof(outline(tried, pending), tried.row, face, roofs)
        indices.append(pending[fits])
        anchors.append(Anchors(*(column[fits] for column in tried)))
        pending = pending[~fits]
    return np.concatenate(indices), Anchors(
        *(np.concatenate(column) for column in zip(*anchors, strict=True))
    )


def _are_over_roof(xy: np.ndarray, row: np.ndarray, face: np.ndarray, roofs: Roofs) -> np.ndarray:
    """Which objects have all their corners xy (k, p, 2) over the roof of building ``row``, over the face
    ``face`` only unless it is -1; bool (k,)."""
    count = np.diff(roofs.offset)[row]
    anchor = np.repeat(np.arange(len(row)), count)
    triangle = np.arange(len(anchor)) + np.repeat(roofs.offset[row] + count - np.cumsum(count), count)
    is_own = (face[anchor] < 0) | (roofs.face[triangle] == face[anchor])
    anchor, triangle = anchor[is_own], triangle[is_own]
    start = roofs.corner_m[triangle, None, :, :2]
    side = cross(np.roll(start, -1, axis=2) - start, xy[anchor, :, None] - start)
    is_in_triangle = np.abs((side >= 0).sum(axis=2) - (side <= 0).sum(axis=2)) >= 2
    is_over = np.zeros(xy.shape[:2], bool)
    np.logical_or.at(is_over, anchor, is_in_triangle)
    return np.asarray(is_over.all(axis=1))
