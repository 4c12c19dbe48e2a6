"""Party walls, cancelled along their lines: only what one of two facing walls has alone is left.

Walls are upright, so a wall is the area between its lower and its upper profile. At every place along the line where a
profile has a corner or crosses another profile, every profile gets a point, and points that are hardly apart are
merged. Between two such places (a strip), profiles are straight and do not cross. Taken from below, each profile begins
or ends a wall on one of the two sides.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import shapely

from p2wss.mesh import Mesh
from p2wss.reconstruction.skin.solids import TOLERANCE_M, Face, area_vectors, opposite_walls
from p2wss.skeleton.groups import groups
from p2wss.skeleton.types import differs, distinct, next_in_ring, numbered

# each round resolves one crossing between any two places
_MAX_ROUNDS = 12
# corners over one place of the plan are merged if they are no further apart in height. Else the upper one could be put
# on a roof's edge that rises from the lower one, and the edge would begin upright
_LEVEL_M = 1e-2
# two edges, or an edge and a corner, meet over one place if they are no further apart in height
_MEET_M = 5e-3


class NotJoined(Exception):
    """The walls of a block do not fit each other: its buildings overlap, or a wall is not upright."""


def without_party_walls(point: np.ndarray, faces: Sequence[Face]) -> tuple[np.ndarray, list[Face]]:
    """(points, faces) of touching solids without the common parts of walls that face each other. A closed surface stays
    closed. The faces given are changed in place.

    Raises :class:`NotJoined` where two walls of one side overlap, or if edges cross too often.
    """
    profiles = _Profiles(point, faces, opposite_walls(point, faces))
    for _ in range(_MAX_ROUNDS):
        profiles.divide()
        if not profiles.cross():
            return profiles.point, _without_straight(profiles.remaining(), len(point))
    raise NotJoined("the edges of walls cross too often")


class _Profiles:
    """The edges of walls that face each other, and where they are along the lines of these walls.

    point: (p, 3). column: int (p,), the first of all points over the same place of the plan. line: the line of each
    wall. along: the direction of each line, from left to right. stop: the columns in which edges end, sorted by line
    and by place on it; at_m: the place of each stop along its line.

    Arrays of all edges that are not upright, sorted by stop and then from below: wall; left, right: the points at the
    ends; low, high: the stops of the ends; is_forward: whether the edge runs to the right around its wall.
    """

    def __init__(self, point: np.ndarray, faces: Sequence[Face], pairs: np.ndarray) -> None:
        self.faces, self.point, self.column = faces, point.copy(), np.arange(len(point))
        self.walls = distinct(pairs).tolist()
        area = area_vectors(point, [faces[wall] for wall in self.walls])[:, :2]
        line = groups(len(faces), pairs)[self.walls]
        _, first, self.line = np.unique(line, return_index=True, return_inverse=True)
        # a line runs to the right along its first wall, seen from outside
        self.is_front = (area * area[first][self.line]).sum(axis=1) > 0
        self.along = area[first] @ [[0, 1], [-1, 0]] / np.linalg.norm(area[first], axis=1)[:, None]
        used = distinct(np.array([v for wall in self.walls for ring in faces[wall].rings for v in ring], int))
        plan = np.asarray(shapely.points(point[used, :2]), object)
        near = shapely.STRtree(plan).query(plan, predicate="dwithin", distance=TOLERANCE_M)
        place = groups(len(used), near.T)
        self.column[used] = used[np.unique(place, return_index=True)[1]][place]
        self.point[used, :2] = point[self.column[used], :2]
        self._order()
        self._insert(np.zeros(0, int), np.zeros(0, int), _LEVEL_M)

    def _order(self) -> None:
        rings = [(k, ring) for k, wall in enumerate(self.walls) for ring in self.faces[wall].rings]
        size = [len(ring) for _, ring in rings]
        wall = np.repeat(np.array([k for k, _ in rings], int), size)
        start = np.array([vertex for _, ring in rings for vertex in ring], int)
        stop, number = numbered(self.column[start] * len(self.along) + self.line[wall])
        column, line = np.divmod(stop, len(self.along))
        at_m = (self.point[column, :2] * self.along[line]).sum(axis=1)
        order = np.lexsort([at_m, line])
        self.used, self.stop, self.at_m = distinct(start), column[order], at_m[order]
        ends = np.stack([start, np.argsort(order)[number]])
        ends = np.stack([ends, ends[:, next_in_ring(np.cumsum([0, *size]))]])
        is_forward = ends[0, 1] < ends[1, 1]
        (left, low), (right, high) = np.where(is_forward, ends, ends[::-1])
        order = np.lexsort([self.point[right, 2], self.point[left, 2], low])
        order = order[(low < high)[order]]
        self.wall, self.is_forward, self.left, self.right, self.low, self.high = (
            each[order] for each in (wall, is_forward, left, right, low, high)
        )

    def divide(self) -> None:
        """Give every edge a point at each stop that it passes, and merge points that are hardly apart."""
        num = self.high - self.low - 1
        edge = np.repeat(np.arange(len(num)), num)
        passed = np.arange(len(edge)) + (self.high - np.cumsum(num))[edge]
        low_m, high_m, here_m = (self.at_m[each] for each in (self.low[edge], self.high[edge], passed))
        new = self._add(edge, (here_m - low_m) / (high_m - low_m), self.stop[passed])
        self._insert(edge, new, _MEET_M)

    def cross(self) -> bool:
        """Whether edges cross. If so, the two edges of the lowest crossing between any two stops get a common point."""
        over, under = np.diff(self.point[self.left, 2]), -np.diff(self.point[self.right, 2])
        found = np.flatnonzero(~differs(self.low)[1:] & (over > 0) & (under > 0))
        found = found[np.unique(self.low[found], return_index=True)[1]]
        column = len(self.point) + np.arange(len(found))
        new = self._add(found, over[found] / (over + under)[found], column)
        self._insert(np.concatenate([found, found + 1]), np.tile(new, 2), _MEET_M)
        return bool(len(found))

    def _add(self, edge: np.ndarray, share: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Add points on edges, and return their numbers. share: of the way from left to right. column: of each."""
        number = np.arange(len(self.point), len(self.point) + len(edge))
        left, right = self.point[self.left[edge]], self.point[self.right[edge]]
        self.point = np.concatenate([self.point, left + share[:, None] * (right - left)])
        self.column = np.concatenate([self.column, column])
        self.point[number, :2] = self.point[column, :2]
        return number

    def _insert(self, edge: np.ndarray, vertex: np.ndarray, apart_m: float) -> None:
        """Insert points into edges, then merge the points of a column that are at most ``apart_m`` above the next lower
        point. edge, vertex: pairs, in which the points of an edge are in the order from left to right."""
        number = np.concatenate([self.used, vertex])
        number = number[np.lexsort([self.point[number, 2], self.column[number]])]
        is_apart = differs(self.column[number])
        is_apart[1:] |= np.diff(self.point[number, 2]) > apart_m
        # the first point replaces all that are merged
        first, same = np.flatnonzero(is_apart), np.arange(len(self.point))
        same[number] = np.repeat(np.minimum.reduceat(number, first), np.diff([*first, len(number)]))
        between: dict[tuple[int, int], dict[int, None]] = {}
        ends = zip(self.left[edge].tolist(), self.right[edge].tolist(), strict=True)
        for side, one in zip(ends, same[vertex].tolist(), strict=True):
            between.setdefault(side, {})[one] = None
        named = same.tolist()
        for face in self.faces:
            _fill(face, lambda a, b: [named[a], *between.get((a, b), ()), *reversed(between.get((b, a), ()))])
        self._order()

    def remaining(self) -> list[Face]:
        """The faces, with what remains of the walls."""
        is_front, is_new = self.is_front[self.wall], differs(self.low)
        is_new |= differs(self.left) | differs(self.right)
        first = np.flatnonzero(is_new)
        strip, left, right = (each[first].tolist() for each in (self.low, self.left, self.right))
        # a wall is above its lower edges
        sign = np.where(self.is_forward == is_front, 1, -1)
        begins = np.add.reduceat(sign * [is_front, ~is_front, self.wall], first, axis=1)
        *inside, owner = np.cumsum(begins, axis=1)
        is_under = np.roll(~differs(np.array(strip)), -1)
        if any(((each < 0) | (each > is_under)).any() for each in inside):
            raise NotJoined("two walls of one side overlap")
        used = self.used[np.lexsort([self.point[self.used, 2], self.column[self.used]])].tolist()
        position, column = {vertex: k for k, vertex in enumerate(used)}, self.column.tolist()

        def side(a: int, b: int) -> list[int]:
            """The points from ``a`` to before ``b``: along an upright side, all points of the column between them."""
            if column[a] != column[b]:
                return [a]
            i, j = position[a], position[b]
            return used[i:j] if i < j else used[i:j:-1]

        triangles: dict[int, list[list[int]]] = {}
        for k in np.flatnonzero(inside[0] != inside[1]).tolist():
            corners = [left[k], right[k], right[k + 1], left[k + 1]]
            cell = [v for a, b in _edges(corners if inside[0][k] else corners[::-1]) for v in side(a, b)]
            triangles.setdefault(int(owner[k]), []).extend([cell[0], a, b] for a, b in pairwise(cell[1:]))
        apart = set(self.walls)
        result = [face for number, face in enumerate(self.faces) if number not in apart and face.rings]
        for face in result:
            _fill(face, side)
        for number, triangle in triangles.items():
            wall, none = self.faces[self.walls[number]], np.zeros(len(triangle), np.uint8)
            for surface in Mesh(self.point, np.array(triangle), none, none).surfaces:
                result.append(replace(wall, rings=[ring.tolist() for ring in surface.rings], triangles=None))
        return result


def _fill(face: Face, side: Callable[[int, int], list[int]]) -> None:
    """Replace each side of a face by the points that ``side`` returns for its two ends; the last end is left out."""
    rings = [[v for a, b in _edges(ring) for v in side(a, b)] for ring in face.rings]
    if rings != face.rings:
        face.rings, face.triangles = [ring for ring in map(tidy, rings) if ring], None


def _edges(ring: Sequence[int]) -> list[tuple[int, int]]:
    return list(zip(ring, [*ring[1:], ring[0]], strict=True))


def _without_straight(faces: list[Face], num_given: int) -> list[Face]:
    """The faces without added points, numbers from ``num_given`` on, at which only two edges end: they lie within a
    straight edge."""
    edges = {(min(edge), max(edge)) for face in faces for ring in face.rings for edge in _edges(ring)}
    is_within = np.bincount(np.array([*edges]).ravel()) == 2
    is_within[:num_given] = False
    for face in faces:
        _fill(face, lambda a, b: [] if is_within[a] else [a])
    return faces


def tidy(ring: list[int]) -> list[int]:
    """The ring without repeated points and without spikes; empty if nothing is left.

    >>> tidy([1, 1, 2, 3, 2, 4])
    [1, 2, 4]
    """
    for k, vertex in enumerate(ring):
        for back in (1, 2):
            if ring[k - back] == vertex:
                return tidy([v for i, v in enumerate(ring) if (k - i) % len(ring) >= back])
    return ring
