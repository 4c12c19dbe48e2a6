"""Low flat parts inside a footprint, as of a garage: the roof above them is cut away.

The triangles of the building change, not its label.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely

from p2wss.data.polygon_arrays import to_geometries
from p2wss.scans.clutter.buildings import (
    LocalBuildings,
    between,
    draw_buildings,
    draw_edges,
    left_of,
    rectangles,
)
from p2wss.scans.surface import CLUTTER_REFLECTANCE, ClutterKind, Surface, encode_clutter
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.types import FaceKind

# Sizes are drawn evenly between two values in metres; a lower part is lower than the eaves by at least the given height
# and covers at most this share of the footprint.
_WIDTH_M, _DEPTH_M, _HEIGHT_M = (2.5, 5), (3, 6), (2.2, 3.2)
_BELOW_EAVE_M, _MAX_AREA_SHARE = 0.5, 0.5
# how far a lower part may reach beyond the footprint, which is rounding
_TOLERANCE_M = 0.005
# places on a side, as shares of its length, that are all on an outer wall or all away from it
_PLACES = (0.05, 0.5, 0.95)
_ON_WALL_M = 0.02
_MAX_CORNERS = 16  # of a triangle that five planes have cut


class _Prisms(NamedTuple):
    """n vertical prisms with four sides: x, y with ``normal . xy <= limit``, above ``bottom_m``.

    building: (n,). outline: (n, 4, 2). normal: (n, 4, 2), outwards. limit: (n, 4). bottom_m: (n,).
    """

    building: np.ndarray
    outline: np.ndarray
    normal: np.ndarray
    limit: np.ndarray
    bottom_m: np.ndarray


def add_lower_parts(surface: Surface, buildings: LocalBuildings, share: float) -> tuple[Surface, int]:
    """``surface`` with a low flat roof over a corner of a share of the buildings, where it fits, and the
    number of these buildings.

    What the building has above that roof is cut away; the new roof and the wall behind it are clutter of the
    kind :attr:`surface.ClutterKind.LOWER_PART`.
    """
    rows, u = draw_buildings(buildings, ClutterKind.LOWER_PART, share)
    edge, length, outwards = draw_edges(buildings, rows, u[:, 0])
    width = np.minimum(between(u[:, 1], *_WIDTH_M), length)
    depth = between(u[:, 2], *_DEPTH_M)
    along = left_of(outwards)
    from_start = np.where(u[:, 3] < 0.5, 0.5 * width, length - 0.5 * width)
    middle = buildings.polygons.xy_m[edge] + from_start[:, None] * along - 0.5 * depth[:, None] * outwards
    outline = rectangles(middle, along, np.stack([width, depth], axis=1) / 2)
    top = buildings.terrain_z_m[rows] + between(u[:, 4], *_HEIGHT_M)
    shapes, boxes = to_geometries(buildings.polygons)[rows], shapely.polygons(outline)
    fits = (length >= _WIDTH_M[0]) & (top < buildings.eave_z_m[rows] - _BELOW_EAVE_M)
    fits &= shapely.covers(shapely.buffer(shapes, _TOLERANCE_M), boxes)
    fits &= shapely.area(boxes) < _MAX_AREA_SHARE * shapely.area(shapes)
    # each side is on an outer wall from end to end, or nowhere on one
    following = np.roll(outline, -1, axis=1)
    places = np.stack([w * outline + (1 - w) * following for w in _PLACES], axis=2)
    to_wall: np.ndarray = shapely.distance(shapely.boundary(shapes)[:, None, None], shapely.points(places))
    is_wall = np.all(to_wall < _ON_WALL_M, axis=2)
    is_apart = np.all(to_wall > 2 * _ON_WALL_M, axis=2)
    fits &= np.all(is_wall | is_apart, axis=1)

    side = following - outline
    normal = -left_of(side / np.maximum(np.linalg.norm(side, axis=2), 1e-9)[..., None])
    # a little beyond outer walls, so that these are cut too
    limit = (normal * outline).sum(axis=2) + np.where(is_wall, _ON_WALL_M, 0.0)
    prisms = _Prisms(rows[fits], outline[fits], normal[fits], limit[fits], top[fits])
    return _cut(surface, prisms), int(fits.sum())


def _cut(surface: Surface, prisms: _Prisms) -> Surface:
    """``surface`` without what is inside the prisms, closed by walls and by a low roof in each."""
    prism_of = np.full(int(surface.building.max(initial=-1)) + 2, -1)
    prism_of[prisms.building] = np.arange(len(prisms.building))
    touched = np.flatnonzero(prism_of[surface.building] >= 0)
    prism = prism_of[surface.building[touched]]
    corner = surface.vertex_m[surface.triangle[touched]]
    is_roof = (surface.face[touched] & 3) >= FaceKind.ROOF
    pieces, source, walls, prism_of_wall = _clip_all(
        corner, prism, is_roof, prisms.normal, prisms.limit, prisms.bottom_m
    )
    low_roof = np.concatenate(
        [
            prisms.outline,
            np.broadcast_to(prisms.bottom_m[:, None, None], (*prisms.outline.shape[:2], 1)),
        ],
        axis=2,
    )
    low_roofs = low_roof[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    prism_of_low_roof = np.repeat(np.arange(len(prisms.building)), 2)
    new = np.concatenate([walls, low_roofs])
    building_of_new = prisms.building[np.concatenate([prism_of_wall, prism_of_low_roof])]

    is_whole = np.ones(len(surface.triangle), bool)
    is_whole[touched] = False
    source = touched[source]
    corners = np.concatenate([pieces, new]).reshape(-1, 3)
    triangle = np.arange(len(corners), dtype=np.int32).reshape(-1, 3) + np.int32(len(surface.vertex_m))

    def column(values: np.ndarray, of_new: np.ndarray) -> np.ndarray:
        """A column of the surface: of whole triangles, of pieces, of new triangles."""
        return np.concatenate([values[is_whole], values[source], of_new])

    return surface._replace(
        vertex_m=np.concatenate([surface.vertex_m, corners]),
        triangle=np.concatenate([surface.triangle[is_whole], triangle]),
        building=column(surface.building, building_of_new.astype(np.int32)),
        face=column(surface.face, encode_clutter(np.full(len(new), ClutterKind.LOWER_PART, np.int32))),
        reflectance=column(surface.reflectance, np.full(len(new), CLUTTER_REFLECTANCE, np.float32)),
        loss=column(surface.loss, np.zeros(len(new), np.float32)),
    )


@entry
def _clip_all(
    corner: np.ndarray,
    prism: np.ndarray,
    is_roof: np.ndarray,
    normal: np.ndarray,
    limits: np.ndarray,
    bottom_m: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cut triangles corner (t, 3, 3), each by one prism.

    Returns the pieces outside the prisms and the triangle that each is a piece of; and, where a prism cuts a
    roof, walls from the cut down to the prism's bottom, and the prism of each.
    """
    room = len(corner) * 5 * _MAX_CORNERS
    pieces, source = np.empty((room, 3, 3)), np.empty(room, np.int64)
    walls, prism_of_wall = np.empty((room, 3, 3)), np.empty(room, np.int64)
    num_pieces, num_walls = 0, 0
    polygon, inner = np.empty((_MAX_CORNERS, 3)), np.empty((_MAX_CORNERS, 3))
    outer = np.empty((_MAX_CORNERS, 3))
    for t in range(len(corner)):
        c = prism[t]
        polygon[:3] = corner[t]
        count = 3
        for plane in range(5):
            if plane < 4:
                nx, ny, nz = normal[c, plane, 0], normal[c, plane, 1], 0.0
                limit = limits[c, plane]
            else:
                nx, ny, nz, limit = 0.0, 0.0, -1.0, -bottom_m[c]
            num_outer = _clip_half(polygon, count, -nx, -ny, -nz, -limit, outer)
            for i in range(1, num_outer - 1):
                pieces[num_pieces, 0], pieces[num_pieces, 1] = outer[0], outer[i]
                pieces[num_pieces, 2], source[num_pieces] = outer[i + 1], t
                num_pieces += 1
            count = _clip_half(polygon, count, nx, ny, nz, limit, inner)
            polygon[:count] = inner[:count]
        for i in range(count if is_roof[t] else 0):
            p, q = polygon[i], polygon[(i + 1) % count]
            for side in range(4):
                nx, ny, limit = normal[c, side, 0], normal[c, side, 1], limits[c, side]
                if abs(nx * p[0] + ny * p[1] - limit) < 1e-6 and abs(nx * q[0] + ny * q[1] - limit) < 1e-6:
                    for first in range(2):
                        wall = walls[num_walls]
                        wall[0], wall[1] = p, q
                        wall[2, 0], wall[2, 1] = (q[0], q[1]) if first == 0 else (p[0], p[1])
                        wall[2, 2] = bottom_m[c]
                        if first == 1:
                            wall[1, 2] = bottom_m[c]
                        prism_of_wall[num_walls] = c
                        num_walls += 1
    return pieces[:num_pieces], source[:num_pieces], walls[:num_walls], prism_of_wall[:num_walls]


@entry
def _clip_half(
    polygon: np.ndarray, count: int, nx: float, ny: float, nz: float, limit: float, out: np.ndarray
) -> int:
    """Write the part of a convex polygon with ``n . p <= limit`` into ``out``; returns its number of corners."""
    n = 0
    for i in range(count):
        p, q = polygon[i], polygon[(i + 1) % count]
        a = nx * p[0] + ny * p[1] + nz * p[2] - limit
        b = nx * q[0] + ny * q[1] + nz * q[2] - limit
        if a <= 0:
            out[n] = p
            n += 1
        if (a < 0 and b > 0) or (a > 0 and b < 0):
            out[n] = p + a / (a - b) * (q - p)
            n += 1
    return n if n >= 3 else 0
