"""What makes a real building differ from the solid of its label: eaves that overhang, parts that are lower.

The triangles of the building itself change, not its label: walls stand back under the eaves, as they do where
a footprint was drawn at the gutters (BD TOPO), and a garage that the footprint includes has its own low roof.
Each building draws from its own key, as in :mod:`clutter`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely

from p2wss.data.polygon_arrays import to_geometries
from p2wss.scans.houses import Houses, across, beside, between, chosen, edges, rectangle
from p2wss.scans.surface import LOWER_PART, Surface, encode_thing
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.types import FaceKind

_OVERHANG = 16  # number of the random stream; things count from 0
_ON_WALL_M = 0.02
_SHORTEST_SHARE = 0.3  # of an edge that must be left when its wall has stood back
_MOST_CORNERS = 16  # of a triangle that five planes have cut


def stand_back(
    surface: Surface, houses: Houses, share: float, overhang_m: tuple[float, float]
) -> tuple[Surface, int]:
    """``surface`` with the walls of a share of the buildings moved inwards, and of how many.

    One distance per building. A wall against a neighbour stays where it is, and so do all walls of a building
    that is too narrow.
    """
    rows, u = chosen(houses, _OVERHANG, share)
    distance = np.zeros(len(houses.key))
    distance[rows] = between(u[:, 0], *overhang_m)
    start, end = edges(houses.polygons)
    num_edges = np.diff(houses.polygons.vertex_offset)
    owner = np.repeat(np.arange(len(num_edges)), num_edges)
    length = np.maximum(np.linalg.norm(end - start, axis=1), 1e-9)
    along = (end - start) / length[:, None]
    by = np.where(_free(houses, start, end, owner), distance[owner], 0.0)

    before = np.empty(len(start), np.int64)  # the edge that ends where this one starts
    before[_following(houses)] = np.arange(len(start))
    # the corner moves so that it is ``by`` inside both of its edges
    inwards, inwards_before = across(along), across(along[before])
    turn = inwards[:, 0] * inwards_before[:, 1] - inwards[:, 1] * inwards_before[:, 0]
    straight = np.abs(turn) < 0.2
    safe = np.where(straight, 1.0, turn)
    corner = np.column_stack(
        [
            (by * inwards_before[:, 1] - by[before] * inwards[:, 1]) / safe,
            (by[before] * inwards[:, 0] - by * inwards_before[:, 0]) / safe,
        ]
    )
    new = start + np.where(straight[:, None], by[:, None] * inwards, corner)
    left = ((new[_following(houses)] - new) * along).sum(axis=1)
    narrow = np.zeros(len(num_edges), bool)
    narrow[owner[left < _SHORTEST_SHARE * length]] = True
    moved = np.flatnonzero((distance > 0) & ~narrow)
    new[~np.isin(owner, moved)] = start[~np.isin(owner, moved)]

    kind, edge = surface.face & 3, (surface.face >> 2) - 1
    walls = np.flatnonzero((kind == FaceKind.WALL) & np.isin(surface.building, moved) & (edge >= 0))
    walls = walls[edge[walls] < num_edges[surface.building[walls]]]
    number = houses.polygons.vertex_offset[surface.building[walls]] + edge[walls]
    corners = surface.vertex_m[surface.triangle[walls]]
    away = corners[..., :2] - start[number][:, None]
    on_line = np.abs((away * across(along)[number][:, None]).sum(axis=2)).max(axis=1, initial=0) < _ON_WALL_M
    walls, number, corners, away = walls[on_line], number[on_line], corners[on_line], away[on_line]
    share_along = np.clip((away * along[number][:, None]).sum(axis=2) / length[number][:, None], 0, 1)
    step = new[_following(houses)][number] - new[number]
    corners[..., :2] = new[number][:, None] + share_along[..., None] * step[:, None]
    triangle = surface.triangle.copy()
    triangle[walls] = np.arange(3 * len(walls)).reshape(-1, 3) + len(surface.vertex_m)
    vertex = np.concatenate([surface.vertex_m, corners.reshape(-1, 3)])
    return surface._replace(vertex_m=vertex, triangle=triangle), len(moved)


def _following(houses: Houses) -> np.ndarray:
    """Number of the edge that starts where each edge ends."""
    polygons = houses.polygons
    following = np.arange(len(polygons.xy_m)) + 1
    filled = np.diff(polygons.ring_offset) > 0
    following[polygons.ring_offset[1:][filled] - 1] = polygons.ring_offset[:-1][filled]
    return following


def _free(houses: Houses, start: np.ndarray, end: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Which edges have no other building against them, bool."""
    lines = shapely.linestrings(np.stack([0.9 * start + 0.1 * end, 0.1 * start + 0.9 * end], axis=1))
    edge, other = shapely.STRtree(to_geometries(houses.polygons)).query(
        lines, predicate="dwithin", distance=0.3
    )
    result = np.ones(len(start), bool)
    result[edge[other != owner[edge]]] = False
    return result


class _Cuts(NamedTuple):
    """Vertical prisms with four sides: inside are x, y with ``normal . xy <= limit``, above ``top_m``."""

    building: np.ndarray  # (n,)
    normal: np.ndarray  # (n, 4, 2), outwards
    limit: np.ndarray  # (n, 4)
    top_m: np.ndarray  # (n,)


def lower_parts(surface: Surface, houses: Houses, share: float) -> tuple[Surface, int]:
    """``surface`` with a low flat roof over a corner of a share of the buildings, if it fits, and of how
    many.

    What the building has above that roof is cut away; the new roof and the wall behind it are of the thing
    :data:`surface.LOWER_PART`.
    """
    rows, u = chosen(houses, LOWER_PART, share)
    edge, length, outwards = beside(houses, rows, u[:, 0])
    width = np.minimum(between(u[:, 1], 2.5, 5), length)
    depth = between(u[:, 2], 3, 6)
    along = across(outwards)
    from_start = np.where(u[:, 3] < 0.5, 0.5 * width, length - 0.5 * width)
    middle = houses.polygons.xy_m[edge] + from_start[:, None] * along - 0.5 * depth[:, None] * outwards
    outline = rectangle(middle, along, np.stack([width, depth], axis=1) / 2)
    top = houses.ground_z_m[rows] + between(u[:, 4], 2.2, 3.2)
    shapes, boxes = to_geometries(houses.polygons)[rows], shapely.polygons(outline)
    good = (length >= 2.5) & (top < houses.eave_z_m[rows] - 0.5)
    good &= shapely.covers(shapely.buffer(shapes, 0.005), boxes)
    good &= shapely.area(boxes) < 0.5 * shapely.area(shapes)
    # each side is an outer wall from end to end, or none at all
    following = np.roll(outline, -1, axis=1)
    places = np.stack([w * outline + (1 - w) * following for w in (0.05, 0.5, 0.95)], axis=2)
    to_wall: np.ndarray = shapely.distance(shapely.boundary(shapes)[:, None, None], shapely.points(places))
    is_wall = np.all(to_wall < _ON_WALL_M, axis=2)
    is_apart = np.all(to_wall > 2 * _ON_WALL_M, axis=2)
    good &= np.all(is_wall | is_apart, axis=1)

    side = following - outline
    normal = -across(side / np.maximum(np.linalg.norm(side, axis=2), 1e-9)[..., None])
    # a little beyond outer walls, so that these are cut too
    limit = (normal * outline).sum(axis=2) + np.where(is_wall, _ON_WALL_M, 0.0)
    cuts = _Cuts(rows[good], normal[good], limit[good], top[good])
    return _cut(surface, cuts, outline[good]), int(good.sum())


def _cut(surface: Surface, cuts: _Cuts, outline: np.ndarray) -> Surface:
    cut_of = np.full(int(surface.building.max(initial=-1)) + 2, -1)
    cut_of[cuts.building] = np.arange(len(cuts.building))
    touched = np.flatnonzero(cut_of[surface.building] >= 0)
    number = cut_of[surface.building[touched]]
    corner = surface.vertex_m[surface.triangle[touched]]
    is_roof = (surface.face[touched] & 3) >= FaceKind.ROOF
    pieces, source, walls, wall_cut = _clip_all(corner, number, is_roof, cuts)
    floor = np.concatenate([outline, np.broadcast_to(cuts.top_m[:, None, None], (*outline.shape[:2], 1))], 2)
    floors = floor[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    added = np.concatenate([walls, floors])
    owner = cuts.building[np.concatenate([wall_cut, np.repeat(np.arange(len(outline)), 2)])]

    kept = np.ones(len(surface.triangle), bool)
    kept[touched] = False
    source = touched[source]
    corners = np.concatenate([pieces, added]).reshape(-1, 3)
    triangle = np.arange(len(corners), dtype=np.int32).reshape(-1, 3) + np.int32(len(surface.vertex_m))
    things = len(added)
    face = encode_thing(np.full(things, LOWER_PART))
    return surface._replace(
        vertex_m=np.concatenate([surface.vertex_m, corners]),
        triangle=np.concatenate([surface.triangle[kept], triangle]),
        building=np.concatenate([surface.building[kept], surface.building[source], owner.astype(np.int32)]),
        face=np.concatenate([surface.face[kept], surface.face[source], face]),
        reflectance=np.concatenate(
            [surface.reflectance[kept], surface.reflectance[source], np.full(things, 0.3, np.float32)]
        ),
        loss=np.concatenate([surface.loss[kept], surface.loss[source], np.zeros(things, np.float32)]),
        porous=np.concatenate([surface.porous[kept], surface.porous[source], np.zeros(things, bool)]),
    )


@entry
def _clip_all(
    corner: np.ndarray, number: np.ndarray, is_roof: np.ndarray, cuts: _Cuts
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What the prisms leave of the triangles corner (t, 3, 3), with the triangle that each piece is of; and
    walls from the roofs that they cut down to their floors, with the prism of each."""
    room = len(corner) * 5 * _MOST_CORNERS
    pieces, source = np.empty((room, 3, 3)), np.empty(room, np.int64)
    walls, wall_cut = np.empty((room, 3, 3)), np.empty(room, np.int64)
    num_pieces, num_walls = 0, 0
    polygon, inner = np.empty((_MOST_CORNERS, 3)), np.empty((_MOST_CORNERS, 3))
    outer = np.empty((_MOST_CORNERS, 3))
    for t in range(len(corner)):
        c = number[t]
        polygon[:3] = corner[t]
        count = 3
        for plane in range(5):
            if plane < 4:
                nx, ny, nz = cuts.normal[c, plane, 0], cuts.normal[c, plane, 1], 0.0
                limit = cuts.limit[c, plane]
            else:
                nx, ny, nz, limit = 0.0, 0.0, -1.0, -cuts.top_m[c]
            num_outer = _half(polygon, count, -nx, -ny, -nz, -limit, outer)
            for i in range(1, num_outer - 1):
                pieces[num_pieces, 0], pieces[num_pieces, 1] = outer[0], outer[i]
                pieces[num_pieces, 2], source[num_pieces] = outer[i + 1], t
                num_pieces += 1
            count = _half(polygon, count, nx, ny, nz, limit, inner)
            polygon[:count] = inner[:count]
        for i in range(count if is_roof[t] else 0):
            p, q = polygon[i], polygon[(i + 1) % count]
            for side in range(4):
                nx, ny, limit = cuts.normal[c, side, 0], cuts.normal[c, side, 1], cuts.limit[c, side]
                if abs(nx * p[0] + ny * p[1] - limit) < 1e-6 and abs(nx * q[0] + ny * q[1] - limit) < 1e-6:
                    for first in range(2):
                        wall = walls[num_walls]
                        wall[0], wall[1] = p, q
                        wall[2, 0], wall[2, 1] = (q[0], q[1]) if first == 0 else (p[0], p[1])
                        wall[2, 2] = cuts.top_m[c]
                        if first == 1:
                            wall[1, 2] = cuts.top_m[c]
                        wall_cut[num_walls] = c
                        num_walls += 1
    return pieces[:num_pieces], source[:num_pieces], walls[:num_walls], wall_cut[:num_walls]


@entry
def _half(
    polygon: np.ndarray, count: int, nx: float, ny: float, nz: float, limit: float, out: np.ndarray
) -> int:
    """The part of a convex polygon with ``n . p <= limit`` into ``out``; returns its number of corners."""
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
