"""The closed solid below planes that cover the cells of a footprint: roofs, walls between them and below, a floor.

Everything is exact: a vertex lies where the lines around it meet, so faces are planar and walls upright, and vertices
of different faces are one only where the planes meet.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from p2wss.fit.planes.arrangement import GRID_M, Arrangement
from p2wss.mesh import Mesh
from p2wss.mesh.faces import simple_rings
from p2wss.mesh.topology import is_closed

# the number of the face outside the footprint
_OUTSIDE = -1
# metres: a vertex this near to the straight line between its neighbours is dropped
_STRAIGHT_M = 4 * GRID_M
# metres: heights nearer to each other are one
_SAME_HEIGHT_M = 4e-3
# metres: planes meet along an edge whose ends are so near in plan to the line where they do; no vertex moves further
_MEET_M, _MAX_MOVE_M = 0.06, 0.15
# how much more exactly edges of the footprint, and lines on which planes meet, determine a vertex than steps do
_FOOTPRINT_WEIGHT, _MEET_WEIGHT = 100.0, 30.0
_PARALLEL = 0.03


def solid_below(
    cells: Arrangement, label: np.ndarray, plane: np.ndarray, corner_m: np.ndarray
) -> Mesh | None:
    """The solid from height 0 to the planes (k, 3) that cover the cells, ``label`` (c,); None if it is not closed.

    corner_m: (n, 2), corners of the footprint, which stay as they are.
    """
    borders = _Borders.of(cells, label, corner_m)
    for is_exact in (True, False):
        network = _Network(borders, plane, cells if is_exact else None)
        mesh = network.mesh()
        if mesh is not None:
            return mesh
    return None


@dataclass
class _Borders:
    """Half-edges between faces. face: by (start, end), the plane to the left. xy_m: (v, 2). fixed: corners."""

    face: dict[tuple[int, int], int]
    xy_m: np.ndarray
    fixed: set[int]

    @classmethod
    def of(cls, cells: Arrangement, label: np.ndarray, corner_m: np.ndarray) -> _Borders:
        """The borders of the connected cells of one plane, without vertices within straight edges."""
        left: dict[tuple[int, int], int] = {}
        for rings, number in zip(cells.rings, label.tolist(), strict=True):
            for ring in rings:
                vertices = ring.tolist()
                left |= dict.fromkeys(zip(vertices, vertices[1:] + vertices[:1], strict=True), number)
        face = {edge: number for edge, number in left.items() if left.get(edge[::-1], _OUTSIDE) != number}
        used = np.array(sorted({vertex for edge in face for vertex in edge}))
        offset_m = np.abs(cells.xy_m[used, None] - corner_m[None]).max(axis=2)
        nearest = offset_m.argmin(axis=0)
        xy_m = cells.xy_m.copy()
        xy_m[used[nearest]] = corner_m
        result = cls(face, xy_m, set(used[nearest].tolist()))
        result._drop_straight_vertices()
        return result

    def _drop_straight_vertices(self) -> None:
        beside = defaultdict(set)
        for start, end in self.face:
            beside[start].add(end)
            beside[end].add(start)
        pending = sorted(beside, reverse=True)
        while pending:
            vertex = pending.pop()
            if vertex in self.fixed or len(beside[vertex]) != 2:
                continue
            one, other = sorted(beside[vertex])
            chord = self.xy_m[other] - self.xy_m[one]
            to_vertex = self.xy_m[vertex] - self.xy_m[one]
            off_m = abs(chord[0] * to_vertex[1] - chord[1] * to_vertex[0]) / max(np.hypot(*chord), GRID_M)
            if other in beside[one] or off_m > _STRAIGHT_M:
                continue
            for start, end in ((one, other), (other, one)):
                if (start, vertex) in self.face:
                    self.face[start, end] = self.face.pop((start, vertex))
                    del self.face[vertex, end]
            del beside[vertex]
            for end, far in ((one, other), (other, one)):
                beside[end] = beside[end] - {vertex} | {far}
                pending.append(end)


class _Network:
    """Borders with the places and heights of their vertices."""

    def __init__(self, borders: _Borders, plane: np.ndarray, exact: Arrangement | None) -> None:
        self._borders = borders
        self._plane = plane
        self._face = dict(borders.face)
        self._xy_m = [*(borders.xy_m if exact is None else self._exact_places(exact))]
        self._divide_at_crossings()
        self._vertices: list[tuple[float, float, float]] = []
        self._number: dict[tuple[int, int], int] = {}
        self._lift()

    def _height(self, number: int, xy_m: np.ndarray) -> float:
        a, b, c = self._plane[number]
        return float(a * xy_m[0] + b * xy_m[1] + c)

    def _exact_places(self, cells: Arrangement) -> np.ndarray:
        """(v, 2): vertices where the lines around them meet, by least squares. All vertices along a line get the same
        one, so that walls stay planes when vertices within them are dropped."""
        xy_m = self._borders.xy_m
        result = xy_m.copy()
        normals, offsets_m = (
            np.array([getattr(line, name) for line in cells.lines]) for name in ("normal", "offset_m")
        )
        beside_m = np.abs(xy_m @ normals.T - offsets_m)
        equations = defaultdict(list)
        for start, end in self._face:
            other = self._face.get((end, start), _OUTSIDE)
            if other != _OUTSIDE and start > end:
                continue
            own_m = np.maximum(beside_m[start], beside_m[end])
            line = int((own_m[: cells.num_edges] if other == _OUTSIDE else own_m).argmin())
            normal, offset_m, weight = normals[line], offsets_m[line], _FOOTPRINT_WEIGHT
            if other != _OUTSIDE:
                slope = self._plane[self._face[start, end]] - self._plane[other]
                fold, weight = np.hypot(*slope[:2]), 1.0
                off_m = np.abs(xy_m[[start, end]] @ slope[:2] + slope[2])
                if fold > _PARALLEL and off_m.max() < _MEET_M * fold:
                    normal, offset_m, weight = slope[:2] / fold, -slope[2] / fold, _MEET_WEIGHT
            for vertex in (start, end):
                equations[vertex].append((weight * normal, weight * offset_m))
        for vertex, lines in equations.items():
            if vertex in self._borders.fixed:
                continue
            matrix = np.array([normal for normal, _ in lines])
            stay = 1e-6 * np.eye(2)
            right = matrix.T @ np.array([offset_m for _, offset_m in lines]) + stay @ xy_m[vertex]
            place = np.linalg.solve(matrix.T @ matrix + stay, right)
            if np.hypot(*(place - xy_m[vertex])) < _MAX_MOVE_M:
                result[vertex] = place
        return result

    def _divide_at_crossings(self) -> None:
        """Divides the edges along which two roofs change places as the higher one."""
        for edge in [edge for edge in self._face if edge[0] < edge[1] and edge[::-1] in self._face]:
            left, right = self._face[edge], self._face[edge[::-1]]
            rise = [self._height(left, self._xy_m[v]) - self._height(right, self._xy_m[v]) for v in edge]
            if rise[0] * rise[1] < 0 and min(map(abs, rise)) > _SAME_HEIGHT_M:
                share = rise[0] / (rise[0] - rise[1])
                middle = len(self._xy_m)
                self._xy_m.append(self._xy_m[edge[0]] + share * (self._xy_m[edge[1]] - self._xy_m[edge[0]]))
                for start, end in (edge, edge[::-1]):
                    number = self._face.pop((start, end))
                    self._face[start, middle] = self._face[middle, end] = number

    def _lift(self) -> None:
        """Numbers the vertices of the mesh: those of each column of vertices above one place, from below."""
        faces_at = defaultdict(set)
        for (start, end), number in self._face.items():
            faces_at[start].add(number)
            faces_at[end].add(number)
        for place, numbers in faces_at.items():
            xy_m = self._xy_m[place]
            levels = [[(0.0, _OUTSIDE)]]
            for height, number in sorted((self._height(number, xy_m), number) for number in numbers):
                if len(levels) > 1 and height - levels[-1][0][0] < _SAME_HEIGHT_M:
                    levels[-1].append((height, number))
                else:
                    levels.append([(height, number)])
            for level in levels:
                for _, number in level:
                    self._number[place, number] = len(self._vertices)
                self._vertices.append((*xy_m, float(np.mean([height for height, _ in level]))))

    def mesh(self) -> Mesh | None:
        """The closed mesh, None if there is none."""
        triangles: list[list[int]] = []
        for number, polygon, places in self._polygons(self._face):
            triangles += self._triangles(number, polygon, places)
        border = {edge: _OUTSIDE for edge in self._face if edge[::-1] not in self._face}
        for number, polygon, places in self._polygons(border):
            triangles += [corners[::-1] for corners in self._triangles(number, polygon, places)]
        triangles += self._walls()
        vertex_m, triangle = np.array(self._vertices), np.array(triangles, np.int32)
        used, index = np.unique(triangle, return_inverse=True)
        vertex_m, triangle = vertex_m[used], index.reshape(-1, 3).astype(np.int32)
        return Mesh.of_triangles(vertex_m, triangle) if is_closed(vertex_m, triangle) else None

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
                turns = [self._turn(start, end, each) for each in onward]
                start, end = end, onward[int(np.argmin(turns))]
            yield from ((number, each.tolist()) for each in simple_rings(ring))

    def _turn(self, before: int, place: int, after: int) -> float:
        """The angle from the way back to the way on, clockwise."""
        back, on = self._xy_m[before] - self._xy_m[place], self._xy_m[after] - self._xy_m[place]
        turn = np.arctan2(back[1], back[0]) - np.arctan2(on[1], on[0])
        return float((turn - 1e-12) % (2 * np.pi))

    def _polygons(self, face: dict[tuple[int, int], int]) -> list[tuple[int, shapely.Polygon, list[int]]]:
        """(plane, polygon, its places) of every connected face."""
        exteriors: list[tuple[int, shapely.Polygon, list[int]]] = []
        holes: list[tuple[int, list[int]]] = []
        for number, ring in self._rings(face):
            polygon = shapely.Polygon([self._xy_m[place] for place in ring])
            if polygon.exterior.is_ccw:
                exteriors.append((number, polygon, ring))
            else:
                holes.append((number, ring))
        inner = defaultdict(list)
        for number, ring in holes:
            within = shapely.Polygon([self._xy_m[place] for place in ring]).representative_point()
            around = [i for i, each in enumerate(exteriors) if each[0] == number and each[1].contains(within)]
            if around:
                inner[min(around, key=lambda i: exteriors[i][1].area)].append(ring)
        return [
            (
                number,
                shapely.Polygon(
                    polygon.exterior, [[self._xy_m[place] for place in hole] for hole in inner[i]]
                ),
                sum(inner[i], ring),
            )
            for i, (number, polygon, ring) in enumerate(exteriors)
        ]

    def _triangles(self, number: int, polygon: shapely.Polygon, places: Sequence[int]) -> list[list[int]]:
        """Vertices of triangles of a polygon of a plane, counter-clockwise seen from above."""
        vertex = {tuple(self._xy_m[place].tolist()): self._number[place, number] for place in places}
        if not polygon.is_valid:
            return []
        triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
        corner = shapely.get_coordinates(shapely.orient_polygons(triangles)).reshape(-1, 4, 2)[:, :3]
        return [[vertex[tuple(place)] for place in each] for each in corner.tolist()]

    def _walls(self) -> list[list[int]]:
        """Vertices of the triangles of all walls."""
        result = []
        for (start, end), number in self._face.items():
            other = self._face.get((end, start), _OUTSIDE)
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
        return result
