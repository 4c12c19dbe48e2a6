"""The closed solid below planes that cover the cells of a footprint: roofs, walls between them and below, a floor.

A vertex lies exactly where the lines around it meet. So faces are planar, walls are upright, and different faces share
a vertex only where their planes meet.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import shapely

from p2wss.fit.planes.arrangement import Arrangement
from p2wss.fit.planes.detection import height_over
from p2wss.fit.planes.lines import as_arrays
from p2wss.fit.planes.solid_kernels import OUTSIDE, SAME_HEIGHT_M, STRAIGHT_M, rings_below, straightened
from p2wss.mesh import Mesh
from p2wss.mesh.topology import is_closed
from p2wss.mesh.triangulation import axes_of, triangulated
from p2wss.skeleton.nearest import nearest
from p2wss.skeleton.types import FaceKind, distinct, numbered, writable

# metres: two planes meet along an edge if both its ends are this near in plan to the line on which the planes meet; no
# vertex moves further than the second figure
_MEET_M, _MAX_MOVE_M = 0.06, 0.15
# how much more exactly edges of the footprint, and lines on which planes meet, determine a vertex than steps do
_FOOTPRINT_WEIGHT, _MEET_WEIGHT, _KEEP_WEIGHT = 100.0, 30.0, 1e-6
_PARALLEL = 0.03
# the least z of the unit normal of a level roof
_LEVEL_NZ = 0.9999


def solid_below(
    cells: Arrangement, label: np.ndarray, plane: np.ndarray, corner_m: np.ndarray
) -> Mesh | None:
    """The solid from height 0 to the planes (k, 3) that cover the cells, ``label`` (c,); None if it is not closed or
    if a plane falls below height 0.

    label: numbers of planes, or :data:`OUTSIDE`. corner_m: (n, 2), corners of the footprint, which stay as they are.
    """
    # where short sides vanish, four walls may come to share an upright edge
    for short_m in (STRAIGHT_M, 0.0):
        borders = _Borders.of(cells, label, corner_m, short_m)
        exact_m, wall = borders.exact_places(cells, plane)
        for place_m, is_whole in product((exact_m, borders.xy_m), (True, False)):
            if (mesh := borders.solid(wall, plane, place_m, is_whole)) is not None:
                return mesh
    return None


def at_pinch(cells: Arrangement, label: np.ndarray, plane: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """The ends of ``sides`` around which roofs are high and low in turn, as far as these sides show. Four walls would
    share an upright edge there, which no solid has."""
    place = cells.side[sides].T.ravel()
    # the ground is the last plane
    number, plane = (
        np.append(label, OUTSIDE)[np.tile(cells.pair[sides].T, 2)],
        np.vstack([plane, np.zeros(3)]),
    )
    at_m = cells.xy_m[place]
    height_m = height_over(plane, number[0], at_m), height_over(plane, number[1], at_m)
    low_m, high_m = np.minimum(*height_m), np.maximum(*height_m)
    # walls begin and end, in the order of the places and from below
    place, change = np.tile(place, 2), np.repeat([1, -1], len(place))
    order = np.lexsort((change, np.append(low_m + SAME_HEIGHT_M, high_m), place))
    return distinct(place[order[np.cumsum(change[order]) > 2]])


@dataclass(frozen=True)
class _Borders:
    """Sides between faces. side: int64 (s, 2), vertices. face: int64 (s, 2), the planes to the left and to the right.
    line: int64 (s,), the line of the arrangement on which each side is. xy_m: (v, 2). is_fixed: bool (v,), whether a
    vertex is a corner of the footprint."""

    side: np.ndarray
    face: np.ndarray
    line: np.ndarray
    xy_m: np.ndarray
    is_fixed: np.ndarray

    @classmethod
    def of(
        cls, cells: Arrangement, label: np.ndarray, corner_m: np.ndarray, short_m: float = STRAIGHT_M
    ) -> _Borders:
        """The borders of the connected cells of one plane, without sides shorter than ``short_m`` and without vertices
        within straight edges."""
        face = np.append(label, OUTSIDE)[cells.pair]
        is_border = face[:, 0] != face[:, 1]
        used, vertex = numbered(cells.side[is_border].ravel())
        xy_m, is_fixed = cells.xy_m[used], np.zeros(len(used), bool)
        off_m, at = (each[:, 0] for each in nearest(xy_m, corner_m))
        is_used = off_m < STRAIGHT_M
        xy_m[at[is_used]], is_fixed[at[is_used]] = corner_m[is_used], True
        face, line = (np.ascontiguousarray(each[is_border], np.int64) for each in (face, cells.line))
        side, face, line = straightened(vertex.reshape(-1, 2), face, line, xy_m, is_fixed, short_m)
        return cls(side, face, line, xy_m, is_fixed)

    def exact_places(self, cells: Arrangement, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(vertices (v, 2) where the lines around them meet, by least squares; wall, int64 (s, 2)).

        wall: the number, from 0, of the wall below the left and the right face of each side. Walls in one plane have
        the same number: they are on the same hand of the same line of the arrangement, or of the line on which the same
        two planes meet. All vertices along a line are fitted to one line, so walls stay planar when vertices within
        them are dropped."""
        xy_m, edge, line, (left, right) = self.xy_m, self.side, self.line, self.face.T
        is_outer, slope, ends_m = right == OUTSIDE, plane[left] - plane[right], xy_m[edge]
        fold = np.hypot(slope[:, 0], slope[:, 1])
        off_m = np.abs((ends_m * slope[:, None, :2]).sum(axis=2) + slope[:, None, 2]).max(axis=1)
        is_meet = ~is_outer & (fold > _PARALLEL) & (off_m < _MEET_M * fold)
        normals, offsets_m = as_arrays(cells.lines)
        is_edge = is_outer & (line < cells.num_edges)
        normal, offset_m = normals[line], offsets_m[line]
        normal[is_meet] = slope[is_meet, :2] / fold[is_meet, None]
        offset_m[is_meet] = -slope[is_meet, 2] / fold[is_meet]
        ahead = ends_m[:, 1] - ends_m[:, 0]
        is_left = ahead[:, 0] * normal[:, 1] > ahead[:, 1] * normal[:, 0]
        # seen from the other face, both the way and where the planes fall apart are turned around
        is_left = np.column_stack([is_left, is_left == is_meet])
        both = len(plane) * self.face + self.face[:, ::-1] + len(normals)
        wall = 2 * np.where(is_meet[:, None], both, line[:, None]) + is_left
        weight = np.where(is_edge, _FOOTPRINT_WEIGHT, np.where(is_meet, _MEET_WEIGHT, 1.0)) ** 2
        # the matrix and the right side of each vertex; a vertex that nothing determines stays
        matrix = (weight[:, None, None] * normal[:, :, None] * normal[:, None]).reshape(-1, 4)
        terms = np.concatenate([matrix, (weight * offset_m)[:, None] * normal], axis=1)
        keep = np.concatenate(
            [np.tile(_KEEP_WEIGHT * np.eye(2).ravel(), (len(xy_m), 1)), _KEEP_WEIGHT * xy_m], axis=1
        )
        vertex = np.concatenate([np.arange(len(xy_m)), *edge.T])
        sums = np.bincount(
            (6 * vertex[:, None] + np.arange(6)).ravel(), np.concatenate([keep, terms, terms]).ravel()
        ).reshape(-1, 6)
        place_m = np.linalg.solve(sums[:, :4].reshape(-1, 2, 2), sums[:, 4:, None])[..., 0]
        step_m = place_m - xy_m
        is_moved = np.hypot(step_m[:, 0], step_m[:, 1]) < _MAX_MOVE_M
        is_moved[self.is_fixed] = False
        # no side turns around
        is_back = np.ones(1, bool)
        while is_back.any():
            result_m = np.where(is_moved[:, None], place_m, xy_m)
            is_back = ((result_m[edge[:, 1]] - result_m[edge[:, 0]]) * ahead).sum(axis=1) < 0.0
            is_moved[edge[is_back]] = False
        return result_m, numbered(wall.ravel())[1].reshape(-1, 2)

    def solid(
        self, wall: np.ndarray, plane: np.ndarray, place_m: np.ndarray, is_whole: bool = True
    ) -> Mesh | None:
        """The closed mesh below planes; None if it is not closed, if a ring has fewer than three corners, or if a plane
        falls below height 0. wall, place_m: see :meth:`exact_places`. is_whole: whether walls in one plane are one
        face, without the vertices within edges."""
        num, ahead = len(plane), place_m[self.side[:, 1]] - place_m[self.side[:, 0]]
        # walls, which are seen from the right of their faces, are numbered after planes and the floor
        away = (np.column_stack([each, -each]).ravel() for each in (ahead[:, 1], -ahead[:, 0]))
        of_wall = np.column_stack([np.bincount(wall.ravel(), each) for each in away])
        normal = np.zeros((num + 1 + len(of_wall), 3))
        normal[:num, :2], normal[num + 1 :, :2] = -plane[:, :2], of_wall
        normal[:num, 2], normal[num, 2] = 1.0, -1.0
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
        kind = np.full(len(normal), FaceKind.WALL, np.uint8)
        kind[:num] = np.where(normal[:num, 2] > _LEVEL_NZ, FaceKind.FLAT, FaceKind.ROOF)
        kind[num] = FaceKind.GROUND
        axes = axes_of(normal)
        plane = writable(plane, np.float64)
        vertex_m, ring, size, face, area = rings_below(
            self.side, self.face, wall + num + 1, place_m, plane, axes, is_whole
        )
        of_ring = np.repeat(np.arange(len(size)), size)
        if is_whole:
            # a vertex of only two faces is within an edge
            num_at = np.bincount(distinct(ring * len(normal) + face[of_ring]) // len(normal))
            is_corner = num_at[ring] != 2
            ring, of_ring = ring[is_corner], of_ring[is_corner]
        if vertex_m[:, 2].min() < 0.0 or np.bincount(of_ring, minlength=len(size)).min() < 3:
            return None
        place = (axes[face[of_ring]] @ (vertex_m[ring] - vertex_m[0])[..., None])[..., 0]
        triangle, number = _triangles(place, ring, of_ring, face, area)
        mesh = Mesh(vertex_m, triangle.astype(np.int32), kind[number], number.astype(np.int32))
        # what is apart may move apart
        return mesh.part(slice(None)).of_faces() if is_closed(vertex_m, mesh.triangle) else None


def _triangles(
    place: np.ndarray, vertex: np.ndarray, ring: np.ndarray, face: np.ndarray, area: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(vertices of triangles (t, 3), the face of each, (t,)) of rings, each a polygon or a hole in another one.

    place: (k, 2), the corners of all rings, in coordinates of the planes of their faces. vertex, ring: (k,), the vertex
    and the ring of each corner. face, area: (r,), the face and the area of each ring; areas of holes are negative.
    """
    around, is_hole = np.arange(len(face)), area < 0
    if is_hole.any():
        outline = np.asarray(shapely.polygons(shapely.linearrings(place, indices=ring)), object)
        for hole in np.flatnonzero(is_hole).tolist():
            own = np.flatnonzero(~is_hole & (face == face[hole]))
            own = own[shapely.contains(outline[own], shapely.point_on_surface(outline[hole]))]
            around[hole] = min(own, key=area.__getitem__, default=0)
    # exteriors are before their holes
    order = np.lexsort((is_hole, around))
    rank, polygon = np.empty(len(order), np.int64), np.cumsum(~is_hole[order]) - 1
    rank[order] = np.arange(len(order))
    at = np.argsort(rank[ring], kind="stable")
    triangle, number = triangulated(place[at], vertex[at], rank[ring[at]], polygon)
    return triangle, face[order][~is_hole[order]][number]
