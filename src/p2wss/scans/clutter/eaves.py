"""Walls set back under the eaves, as they stand where a footprint was drawn at the eaves (BD TOPO).

The triangles of the building change, not its label.
"""

import numpy as np
import shapely

from p2wss.data.polygon_arrays import to_geometries
from p2wss.scans.clutter.buildings import LocalBuildings, between, draw_buildings, edges, left_of
from p2wss.scans.surface import Surface
from p2wss.skeleton.types import FaceKind

_STREAM = 16  # of the random draws; those of clutter objects count from 0
# sine of an angle: edges that meet at a smaller angle are one wall, whose corner moves straight inwards
_MIN_SINE = 0.2
# an edge is free if no other building is nearer to it than this distance, leaving out this share of its length at
# either end
_NEIGHBOUR_M, _END_SHARE = 0.3, 0.1
_ON_WALL_M = 0.02
_MIN_LENGTH_SHARE = 0.3  # of an edge's length that its wall must keep


def set_walls_back(
    surface: Surface, buildings: LocalBuildings, share: float, overhang_m: tuple[float, float]
) -> tuple[Surface, int]:
    """``surface`` with the walls of a share of the buildings moved inwards, and the number of these buildings.

    All walls of a building move by the same distance. A wall against a neighbour stays where it is, and so do all walls
    of a building that is too narrow.
    """
    rows, u = draw_buildings(buildings, _STREAM, share)
    distance = np.zeros(len(buildings.key))
    distance[rows] = between(u[:, 0], *overhang_m)
    start, following = buildings.polygons.xy_m, buildings.polygons.next_vertex
    num_edges = np.diff(buildings.polygons.vertex_offset)
    new_start, is_moved = _offset_corners(buildings, distance)
    moved = np.flatnonzero(is_moved)

    kind, edge = surface.face & 3, (surface.face >> 2) - 1
    walls = np.flatnonzero((kind == FaceKind.WALL) & np.isin(surface.building, moved) & (edge >= 0))
    walls = walls[edge[walls] < num_edges[surface.building[walls]]]
    number = buildings.polygons.vertex_offset[surface.building[walls]] + edge[walls]
    length, along = edges(buildings.polygons)
    corners = surface.vertex_m[surface.triangle[walls]]
    away = corners[..., :2] - start[number][:, None]
    from_line = np.abs((away * left_of(along)[number][:, None]).sum(axis=2)).max(axis=1, initial=0)
    on_line = from_line < _ON_WALL_M
    walls, number, corners, away = walls[on_line], number[on_line], corners[on_line], away[on_line]
    share_along = np.clip((away * along[number][:, None]).sum(axis=2) / length[number][:, None], 0, 1)
    step = new_start[following][number] - new_start[number]
    corners[..., :2] = new_start[number][:, None] + share_along[..., None] * step[:, None]
    triangle = surface.triangle.copy()
    triangle[walls] = np.arange(3 * len(walls)).reshape(-1, 3) + len(surface.vertex_m)
    vertex = np.concatenate([surface.vertex_m, corners.reshape(-1, 3)])
    return surface._replace(vertex_m=vertex, triangle=triangle), len(moved)


def _offset_corners(buildings: LocalBuildings, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Start of every edge after its building's walls have moved inwards by ``distance`` (n,), and which
    buildings have moved, bool (n,)."""
    start, following = buildings.polygons.xy_m, buildings.polygons.next_vertex
    num_edges = np.diff(buildings.polygons.vertex_offset)
    building = np.repeat(np.arange(len(num_edges)), num_edges)
    length, along = edges(buildings.polygons)
    by = np.where(_is_free(buildings, start, start[following], building), distance[building], 0.0)

    before = np.empty(len(start), np.int64)  # the edge that ends where this one starts
    before[following] = np.arange(len(start))
    # the corner moves so that it is ``by`` inside both of its edges
    inwards, inwards_before = left_of(along), left_of(along[before])
    turn = inwards[:, 0] * inwards_before[:, 1] - inwards[:, 1] * inwards_before[:, 0]
    is_straight = np.abs(turn) < _MIN_SINE
    divisor = np.where(is_straight, 1.0, turn)
    shift = np.column_stack(
        [
            (by * inwards_before[:, 1] - by[before] * inwards[:, 1]) / divisor,
            (by[before] * inwards[:, 0] - by * inwards_before[:, 0]) / divisor,
        ]
    )
    new_start = start + np.where(is_straight[:, None], by[:, None] * inwards, shift)
    new_length = ((new_start[following] - new_start) * along).sum(axis=1)
    is_narrow = np.zeros(len(num_edges), bool)
    is_narrow[building[new_length < _MIN_LENGTH_SHARE * length]] = True
    is_moved = (distance > 0) & ~is_narrow
    new_start[~is_moved[building]] = start[~is_moved[building]]
    return new_start, is_moved


def _is_free(
    buildings: LocalBuildings, start: np.ndarray, end: np.ndarray, building: np.ndarray
) -> np.ndarray:
    """Which edges have no other building against them, bool (m,)."""
    lines = shapely.linestrings(
        np.stack(
            [(1 - _END_SHARE) * start + _END_SHARE * end, _END_SHARE * start + (1 - _END_SHARE) * end], axis=1
        )
    )
    edge, other = shapely.STRtree(to_geometries(buildings.polygons)).query(
        lines, predicate="dwithin", distance=_NEIGHBOUR_M
    )
    result = np.ones(len(start), bool)
    result[edge[other != building[edge]]] = False
    return result
