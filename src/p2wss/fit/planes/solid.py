"""The closed solid below planes that cover the cells of a footprint: roofs, walls between them and below, a floor.

Everything is exact: a vertex lies where the lines around it meet, so faces are planar and walls upright, and vertices
of different faces are one only where the planes meet.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import shapely

from p2wss.fit.planes.arrangement import GRID_M, Arrangement
from p2wss.fit.planes.detection import height_over
from p2wss.fit.planes.lines import as_arrays
from p2wss.mesh import Mesh
from p2wss.mesh.faces import simple_rings
from p2wss.mesh.planar import without_straight_vertices
from p2wss.mesh.topology import is_closed
from p2wss.mesh.triangulation import triangulated
from p2wss.skeleton.types import FaceKind, cross, distinct, next_in_ring, numbered

# the number of the face outside the footprint, and of cells without a building
OUTSIDE = -1
# metres: a vertex this near to the straight line between its neighbours is dropped
_STRAIGHT_M = 4 * GRID_M
# metres: heights nearer to each other are one
_SAME_HEIGHT_M = 4e-3
# metres: planes meet along an edge whose ends are so near in plan to the line where they do; no vertex moves further
_MEET_M, _MAX_MOVE_M = 0.06, 0.15
# how much more exactly edges of the footprint, and lines on which planes meet, determine a vertex than steps do
_FOOTPRINT_WEIGHT, _MEET_WEIGHT, _KEEP_WEIGHT = 100.0, 30.0, 1e-6
_PARALLEL = 0.03
# of the normal of a level roof, the least z
_LEVEL_NZ = 0.9999


def solid_below(
    cells: Arrangement, label: np.ndarray, plane: np.ndarray, corner_m: np.ndarray
) -> Mesh | None:
    """The solid from height 0 to the planes (k, 3) that cover the cells, ``label`` (c,); None if it is not closed or
    if a plane falls below height 0.

    label: numbers of planes, or :data:`OUTSIDE`. corner_m: (n, 2), corners of the footprint, which stay as they are.
    """
    borders = _Borders.of(cells, label, corner_m)
    exact_m, wall = borders.exact_places(cells, plane)
    meshes = (_Network(borders.face, wall, plane, place_m).mesh() for place_m in (exact_m, borders.xy_m))
    return next((mesh for mesh in meshes if mesh is not None), None)


def at_pinch(cells: Arrangement, label: np.ndarray, plane: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """The ends of some sides around which, as these show, roofs are high and low in turn: four walls would share an
    upright edge, which no solid has."""
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
    order = np.lexsort((change, np.append(low_m + _SAME_HEIGHT_M, high_m), place))
    return distinct(place[order[np.cumsum(change[order]) > 2]])


@dataclass
class _Borders:
    """Half-edges between faces. face: by (start, end), the plane to the left. line: of the arrangement, on which they
    are. xy_m: (v, 2). fixed: corners."""

    face: dict[tuple[int, int], int]
    line: dict[tuple[int, int], int]
    xy_m: np.ndarray
    fixed: set[int]

    @classmethod
    def of(cls, cells: Arrangement, label: np.ndarray, corner_m: np.ndarray) -> _Borders:
        """The borders of the connected cells of one plane, without vertices within straight edges."""
        numbers = np.append(label, OUTSIDE)[cells.pair]
        is_border = numbers[:, 0] != numbers[:, 1]
        used, side = numbered(cells.side[is_border].ravel())
        face, line = dict[tuple[int, int], int](), dict[tuple[int, int], int]()
        sides = (each.tolist() for each in (side.reshape(-1, 2), numbers[is_border], cells.line[is_border]))
        for (start, end), (left, right), number in zip(*sides, strict=True):
            for edge, beside in (((start, end), left), ((end, start), right)):
                if beside != OUTSIDE:
                    face[edge], line[edge] = beside, number
        xy_m = cells.xy_m[used]
        offset_m = np.abs(xy_m[:, None] - corner_m[None]).max(axis=2)
        nearest, is_used = offset_m.argmin(axis=0), offset_m.min(axis=0) < _STRAIGHT_M
        xy_m[nearest[is_used]] = corner_m[is_used]
        result = cls(face, line, xy_m, set(nearest[is_used].tolist()))
        result._drop_short_sides()
        result._drop_straight_vertices()
        return result

    def _beside(self) -> defaultdict[int, set[int]]:
        """By vertex, those at the other ends of its sides."""
        beside = defaultdict[int, set[int]](set)
        for start, end in self.face:
            beside[start].add(end)
            beside[end].add(start)
        return beside

    def _drop_short_sides(self) -> None:
        """Makes one of the ends of short sides, where no two faces are then on one side of another; a face of no width
        vanishes. Corners stay."""
        edges = np.array([*self.face])
        step_m = self.xy_m[edges[:, 1]] - self.xy_m[edges[:, 0]]
        short = edges[np.hypot(*step_m.T) < _STRAIGHT_M].tolist()
        beside, face, line = self._beside() if short else {}, self.face, self.line
        for edge in map(tuple, short):
            end, gone = edge if edge[1] not in self.fixed else edge[::-1]
            if edge not in face or gone in self.fixed:
                continue
            others = sorted(beside[gone] - {end})
            moved = {(end, each): (gone, each) for each in others} | {
                (each, end): (each, gone) for each in others
            }
            sides = {
                new: [(face[each], line[each]) for each in (new, old) if each in face]
                for new, old in moved.items()
            }
            rest = {
                new: [one for one in both if one[0] not in {two[0] for two in sides[new[::-1]]}]
                for new, both in sides.items()
            }
            if all(len(both) < 2 for both in rest.values()):
                for each in (edge, edge[::-1], *moved, *moved.values()):
                    face.pop(each, None), line.pop(each, None)
                for new, both in rest.items():
                    if both:
                        ((face[new], line[new]),) = both
                beside.pop(gone)
                beside[end].discard(gone)
                for each in others:
                    beside[each].discard(gone)
                    is_beside = (end, each) in face or (each, end) in face
                    for one, other in ((end, each), (each, end)):
                        (beside[one].add if is_beside else beside[one].discard)(other)

    def _drop_straight_vertices(self) -> None:
        beside = self._beside()
        # complex numbers, which Python takes faster than numpy takes arrays of two
        pending, xy = sorted(beside, reverse=True), (self.xy_m @ [1, 1j]).tolist()
        while pending:
            vertex = pending.pop()
            if vertex in self.fixed or len(beside[vertex]) != 2:
                continue
            one, other = sorted(beside[vertex])
            chord, to_vertex = xy[other] - xy[one], xy[vertex] - xy[one]
            off_m = abs((chord.conjugate() * to_vertex).imag) / max(abs(chord), GRID_M)
            if other in beside[one] or off_m > _STRAIGHT_M:
                continue
            for start, end in ((one, other), (other, one)):
                if (start, vertex) in self.face:
                    self.face[start, end] = self.face.pop((start, vertex))
                    del self.face[vertex, end]
                    lines = self.line.pop((start, vertex)), self.line.pop((vertex, end))
                    # that of the longer piece
                    self.line[start, end] = lines[abs(xy[vertex] - xy[start]) < abs(xy[end] - xy[vertex])]
            del beside[vertex]
            for end, far in ((one, other), (other, one)):
                beside[end] = beside[end] - {vertex} | {far}
                pending.append(end)

    def exact_places(
        self, cells: Arrangement, plane: np.ndarray
    ) -> tuple[np.ndarray, dict[tuple[int, int], tuple[int, ...]]]:
        """(vertices (v, 2) where the lines around them meet, by least squares; by half-edge, what walls in one plane
        have in common: a line, or the two planes that meet there, and a side of it). All vertices along a line get the
        same one, so that walls stay planes when vertices within them are dropped."""
        xy_m, face = self.xy_m, self.face
        edges = [edge for edge in face if edge[0] < edge[1] or edge[::-1] not in face]
        edge = np.array(edges)
        left, right = np.array([(face[each], face.get(each[::-1], OUTSIDE)) for each in edges]).T
        is_outer, slope, ends_m = right == OUTSIDE, plane[left] - plane[right], xy_m[edge]
        fold = np.hypot(slope[:, 0], slope[:, 1])
        off_m = np.abs((ends_m * slope[:, None, :2]).sum(axis=2) + slope[:, None, 2]).max(axis=1)
        is_meet = ~is_outer & (fold > _PARALLEL) & (off_m < _MEET_M * fold)
        normals, offsets_m = as_arrays(cells.lines)
        line = np.array([self.line[each] for each in edges])
        is_edge = is_outer & (line < cells.num_edges)
        normal, offset_m = normals[line], offsets_m[line]
        normal[is_meet] = slope[is_meet, :2] / fold[is_meet, None]
        offset_m[is_meet] = -slope[is_meet, 2] / fold[is_meet]
        ahead = ends_m[:, 1] - ends_m[:, 0]
        is_left = ahead[:, 0] * normal[:, 1] > ahead[:, 1] * normal[:, 0]
        wall = dict[tuple[int, int], tuple[int, ...]]()
        for each, meets, number, left in zip(
            edges, is_meet.tolist(), line.tolist(), is_left.tolist(), strict=True
        ):
            for way, side in ((each, left), (each[::-1], not left)):
                if way in face:
                    wall[way] = (*((face[way], face[way[::-1]]) if meets else (number,)), side)
        weight = np.where(is_edge, _FOOTPRINT_WEIGHT, np.where(is_meet, _MEET_WEIGHT, 1.0)) ** 2
        # of each vertex a matrix and the right side; those that nothing determines stay
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
        is_moved[list(self.fixed)] = False
        # no side turns around
        is_back = np.ones(1, bool)
        while is_back.any():
            result_m = np.where(is_moved[:, None], place_m, xy_m)
            is_back = ((result_m[edge[:, 1]] - result_m[edge[:, 0]]) * ahead).sum(axis=1) < 0.0
            is_moved[edge[is_back]] = False
        return result_m, wall


class _Network:
    """Borders with the places and heights of their vertices. face: as in :class:`_Borders`. wall, place_m: see
    :meth:`_Borders.exact_places`."""

    def __init__(
        self,
        face: dict[tuple[int, int], int],
        wall: dict[tuple[int, int], tuple[int, ...]],
        plane: np.ndarray,
        place_m: np.ndarray,
    ) -> None:
        self._face, self._wall, self._xy_m = dict(face), dict(wall), place_m.tolist()
        self._plane, self._coefficients = plane, plane.tolist()
        self._divide_at_crossings()
        self._vertices: list[tuple[float, float, float]] = []
        self._number: dict[tuple[int, int], int] = {}
        self._lift()

    def _height(self, number: int, xy_m: Sequence[float]) -> float:
        (a, b, c), (x, y) = self._coefficients[number], xy_m
        return float(a * x + b * y + c)

    def _divide_at_crossings(self) -> None:
        """Divides the edges along which two roofs change places as the higher one."""
        for edge in [edge for edge in self._face if edge[0] < edge[1] and edge[::-1] in self._face]:
            left, right = self._face[edge], self._face[edge[::-1]]
            rise = [self._height(left, self._xy_m[v]) - self._height(right, self._xy_m[v]) for v in edge]
            if rise[0] * rise[1] < 0 and min(map(abs, rise)) > _SAME_HEIGHT_M:
                share = rise[0] / (rise[0] - rise[1])
                middle = len(self._xy_m)
                ends = zip(*(self._xy_m[v] for v in edge), strict=True)
                self._xy_m.append([one + share * (other - one) for one, other in ends])
                for start, end in (edge, edge[::-1]):
                    self._face[start, middle] = self._face[middle, end] = self._face.pop((start, end))
                    self._wall[start, middle] = self._wall[middle, end] = self._wall.pop((start, end))

    def _lift(self) -> None:
        """Numbers the vertices of the mesh: those of each column of vertices above one place, from below."""
        faces_at = defaultdict(set)
        for (start, end), number in self._face.items():
            faces_at[start].add(number)
            faces_at[end].add(number)
        for place, numbers in faces_at.items():
            xy_m = self._xy_m[place]
            levels = [[(0.0, OUTSIDE)]]
            for height, number in sorted((self._height(number, xy_m), number) for number in numbers):
                if len(levels) > 1 and height - levels[-1][0][0] < _SAME_HEIGHT_M:
                    levels[-1].append((height, number))
                else:
                    levels.append([(height, number)])
            for level in levels:
                for _, number in level:
                    self._number[place, number] = len(self._vertices)
                self._vertices.append((*xy_m, sum(height for height, _ in level) / len(level)))

    def mesh(self) -> Mesh | None:
        """The closed mesh, None if there is none."""
        border = {edge: OUTSIDE for edge in self._face if edge[::-1] not in self._face}
        vertex_m = np.array(self._vertices)
        level, number = self._triangles([*self._rings(self._face), *self._rings(border)])
        walls, wall = self._walls()
        triangle = np.concatenate([level, walls]).astype(np.int32)
        if vertex_m[:, 2].min() < 0.0 or not is_closed(vertex_m, triangle):
            return None
        is_level = 1 / np.sqrt(1 + (self._plane[:, :2] ** 2).sum(axis=1)) > _LEVEL_NZ
        # the last one is that of the floor
        kinds = np.append(np.where(is_level, FaceKind.FLAT, FaceKind.ROOF), FaceKind.GROUND)
        kind = np.append(kinds[number], np.full(len(walls), FaceKind.WALL)).astype(np.uint8)
        mesh = Mesh(vertex_m, triangle, kind, np.append(number, len(kinds) + wall).astype(np.int32))
        # what is apart may move apart
        return without_straight_vertices(mesh.part(slice(None))).of_faces()

    def _rings(self, face: dict[tuple[int, int], int]) -> Iterator[tuple[int, list[int]]]:
        """(plane, places) of closed walks that have the face to their left."""
        following = defaultdict(list)
        for (start, end), number in face.items():
            following[start, number].append(end)
        pending = dict.fromkeys(sorted(face))
        while pending:
            start, end = next(iter(pending))
            number, ring = face[start, end], []
            while (start, end) in pending:
                del pending[start, end]
                ring.append(start)
                onward = [each for each in following[end, number] if (end, each) in pending]
                if not onward:
                    break
                # where a face touches itself, the way goes on around the same part of it
                turn = partial(self._turn, start, end)
                start, end = end, min(onward, key=turn) if len(onward) > 1 else onward[0]
            yield from ((number, each.tolist()) for each in simple_rings(ring))

    def _turn(self, before: int, place: int, after: int) -> float:
        """The angle from the way back to the way on, clockwise."""
        x, y = self._xy_m[place]
        back, on = (math.atan2(v - y, u - x) for u, v in (self._xy_m[before], self._xy_m[after]))
        turn = back - on
        return (turn - 1e-12) % (2 * math.pi)

    def _triangles(self, rings: Sequence[tuple[int, list[int]]]) -> tuple[np.ndarray, np.ndarray]:
        """(vertices (t, 3) of the triangles of all connected faces, seen from outside: of roofs, then of floors; the
        plane of each, (t,))."""
        numbers, places = zip(*rings, strict=True)
        xy_m, number = np.array(self._xy_m), np.repeat(np.arange(len(places)), [*map(len, places)])
        corner_m = xy_m[np.concatenate(places)]
        after_m = corner_m[next_in_ring(np.cumsum([0, *map(len, places)]))]
        is_hole, face_of_ring = np.bincount(number, cross(corner_m, after_m)) <= 0, np.arange(len(places))
        for hole in np.flatnonzero(is_hole).tolist():
            exterior = np.asarray(shapely.linearrings(corner_m, indices=number), object)
            polygon = np.asarray(shapely.polygons(exterior), object)
            around = ~is_hole & (np.array(numbers) == numbers[hole])
            around &= shapely.contains(polygon, shapely.point_on_surface(polygon[hole]))
            face_of_ring[hole] = np.where(around, shapely.area(polygon), np.inf).argmin()
        order = np.lexsort((is_hole, face_of_ring)).tolist()
        vertex = [self._number[place, numbers[i]] for i in order for place in places[i]]
        ring = np.repeat(np.arange(len(order)), [len(places[i]) for i in order])
        number_of_face = np.cumsum(~is_hole[order]) - 1
        corner_m = xy_m[np.concatenate([places[i] for i in order])]
        triangle, face = triangulated(corner_m, np.array(vertex), ring, number_of_face)
        number = np.array(numbers)[~is_hole][face]
        triangle[number == OUTSIDE] = triangle[number == OUTSIDE, ::-1]
        return triangle, number

    def _walls(self) -> tuple[np.ndarray, np.ndarray]:
        """(vertices (t, 3) of the triangles of all walls; the wall of each, (t,))."""
        result, wall, walls = [], [], dict[tuple[int, ...], int]()
        for (start, end), number in self._face.items():
            other = self._face.get((end, start), OUTSIDE)
            sides = []
            for place in (start, end):
                low, high = self._number[place, other], self._number[place, number]
                sides.append(list(range(low, high + 1)) or [low])
            left, right = sides
            i = j = 0
            # the wall is below the face to the left of the edge; the two columns are climbed in turn
            while i < len(left) - 1 or j < len(right) - 1:
                goes_right = (j + 1) * (len(left) - 1) <= (i + 1) * (len(right) - 1) and j < len(right) - 1
                if goes_right or i == len(left) - 1:
                    result.append([left[i], right[j], right[j + 1]])
                    j += 1
                else:
                    result.append([left[i], right[j], left[i + 1]])
                    i += 1
                wall.append(walls.setdefault(self._wall[start, end], len(walls)))
        return np.array(result), np.array(wall)
