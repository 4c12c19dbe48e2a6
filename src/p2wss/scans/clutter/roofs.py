"""Places on roofs where a clutter object fits."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from p2wss.scans.surface import Surface
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.types import FaceKind

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
        fits &= _are_over_roof(
            outline(tried, pending), tried.row, face, roofs.corner_m, roofs.face, roofs.offset
        )
        indices.append(pending[fits])
        anchors.append(Anchors(*(column[fits] for column in tried)))
        pending = pending[~fits]
    return np.concatenate(indices), Anchors(
        *(np.concatenate(column) for column in zip(*anchors, strict=True))
    )


@entry
def _are_over_roof(
    xy: np.ndarray,
    row: np.ndarray,
    face: np.ndarray,
    corner: np.ndarray,
    faces: np.ndarray,
    offset: np.ndarray,
) -> np.ndarray:
    """Which objects have all their corners xy (k, p, 2) over the roof of building ``row``, over the face
    ``face`` only unless it is -1; bool (k,)."""
    result = np.ones(len(xy), np.bool_)
    for k in range(len(xy)):
        for p in range(xy.shape[1]):
            x, y = xy[k, p, 0], xy[k, p, 1]
            inside = False
            for t in range(offset[row[k]], offset[row[k] + 1]):
                if face[k] >= 0 and faces[t] != face[k]:
                    continue
                sides = 0
                for i in range(3):
                    ax, ay = corner[t, i, 0], corner[t, i, 1]
                    bx, by = corner[t, (i + 1) % 3, 0], corner[t, (i + 1) % 3, 1]
                    cross = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
                    sides += (cross >= 0) - (cross <= 0)
                if abs(sides) >= 2:
                    inside = True
                    break
            if not inside:
                result[k] = False
                break
    return result
