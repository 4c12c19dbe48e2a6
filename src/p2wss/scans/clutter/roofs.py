"""Places on roofs where a clutter object fits."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from p2wss.scans.surface import Surface
from p2wss.skeleton.types import FaceKind, cross

NUM_TRIES = 4  # places that are tried for an object that must fit on a roof


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
