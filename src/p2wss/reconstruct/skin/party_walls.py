"""Remove walls of two buildings where they coincide; the remaining parts stay with their buildings."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from math import atan2

import numpy as np
import shapely

from p2wss.reconstruct.skin.solids import Face, area_vector

# areas of the pieces of a wall may add up to this much less or more than the wall
_AREA_M2 = 1e-2
Ring = list[int]


class NotJoined(Exception):
    """The walls of a block do not fit each other: its buildings overlap, or a wall is not upright."""


def without_common(point: np.ndarray, faces: Sequence[Face], walls: Sequence[int]) -> list[Face]:
    """What remains of ``walls``, faces of one upright plane without crossing edges, where it has no building on one of
    its sides.

    The boundary of the result is the sum of the boundaries of ``walls``, so what was closed stays closed. Raises
    :class:`NotJoined` where two walls of one side overlap.
    """
    areas = [area_vector(point, faces[wall].rings) for wall in walls]
    largest = areas[int(np.argmax([np.abs(area).max() for area in areas]))]
    normal = largest[:2] / np.hypot(*largest[:2])
    # seen against the normal, s runs to the right and z upwards
    used = sorted({v for wall in walls for ring in faces[wall].rings for v in ring})
    origin = point[used[0]]
    plane = {
        v: (float((point[v, :2] - origin[:2]) @ (-normal[1], normal[0])), float(point[v, 2])) for v in used
    }
    of_place = {place: v for v, place in plane.items()}
    if len(of_place) < len(plane):
        raise NotJoined("two points at one place of a wall")
    edges = {
        (a, b) if a < b else (b, a)
        for wall in walls
        for ring in faces[wall].rings
        for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)
    }
    lines = shapely.linestrings([(plane[a], plane[b]) for a, b in sorted(edges)])
    cells = shapely.get_parts(shapely.polygonize(lines))
    inside_of = np.full((2, len(cells)), -1)
    middle = shapely.point_on_surface(cells)
    x, y = shapely.get_x(middle), shapely.get_y(middle)
    cell_area = shapely.area(cells)
    for number, (wall, area) in enumerate(zip(walls, areas, strict=True)):
        rings = [[plane[v] for v in ring] for ring in faces[wall].rings]
        polygon = shapely.Polygon(rings[0], rings[1:])
        covered = shapely.contains_xy(polygon, x, y)
        side = 0 if area[:2] @ normal > 0 else 1
        if (inside_of[side, covered] >= 0).any():
            raise NotJoined("two walls of one side overlap")
        if abs(cell_area[covered].sum() - np.linalg.norm(area)) > _AREA_M2:
            raise NotJoined("the pieces of a wall do not make up the wall")
        inside_of[side, covered] = number
    result = []
    for number, wall in enumerate(walls):
        rows, sides = np.nonzero((inside_of == number).T)
        alone = inside_of[1 - sides, rows] < 0
        if alone.all():
            result.append(faces[wall])
            continue
        single = shapely.orient_polygons(cells[rows[alone]])
        index_rings = [
            [of_place[x, y] for x, y in shapely.get_coordinates(ring)[:-1].tolist()]
            for ring in shapely.get_rings(single)
        ]
        for piece in _polygons(_boundary(index_rings, plane), plane):
            if areas[number][:2] @ normal < 0:
                piece = [[ring[0], *ring[:0:-1]] for ring in piece]
            result.append(Face(faces[wall].building, faces[wall].kind, faces[wall].label, piece))
    return result


def _boundary(rings: Sequence[Ring], plane: dict[int, tuple[float, float]]) -> list[Ring]:
    """The rings around the union of cells: edges between two cells cancel out."""
    sides = set(chain.from_iterable(zip(ring, [*ring[1:], ring[0]], strict=True) for ring in rings))
    following: dict[int, list[int]] = {}
    for a, b in sorted(sides):
        if (b, a) not in sides:
            following.setdefault(a, []).append(b)
    result = []
    while following:
        before = min(following)
        here = following[before].pop()
        ring = [before]
        start = before, here
        while True:
            if not following[before]:
                del following[before]
            ring.append(here)
            candidates = following.get(here, [])
            # the first to the right of the way back: the piece that is nearest on the left
            best = _rightmost(plane, before, here, candidates + ([start[1]] if here == start[0] else []))
            if (here, best) == start:
                break
            candidates.remove(best)
            before, here = here, best
        result.append(ring[:-1])
    return result


def _rightmost(
    plane: dict[int, tuple[float, float]], before: int, here: int, candidates: Sequence[int]
) -> int:
    """Of ``candidates`` the one that comes first when turning clockwise at ``here`` from the way back."""
    if len(candidates) == 1:
        return candidates[0]
    back = _direction(plane, here, before)
    return min(candidates, key=lambda v: ((back - _direction(plane, here, v)) % (2 * np.pi)) or 2 * np.pi)


def _direction(plane: dict[int, tuple[float, float]], a: int, b: int) -> float:
    return atan2(plane[b][1] - plane[a][1], plane[b][0] - plane[a][0])


def _polygons(rings: Sequence[Ring], plane: dict[int, tuple[float, float]]) -> list[list[Ring]]:
    """Counter-clockwise rings, each with the clockwise rings within it."""
    shapes = [shapely.Polygon([plane[v] for v in ring]) for ring in rings]
    is_hole = [not shapely.is_ccw(shape.exterior) for shape in shapes]
    result = {k: [ring] for k, ring in enumerate(rings) if not is_hole[k]}
    for k, ring in enumerate(rings):
        if is_hole[k]:
            middle = shapes[k].point_on_surface()
            around = [m for m in result if shapes[m].contains(middle)]
            if not around:
                raise NotJoined("a hole outside its wall")
            result[min(around, key=lambda m: shapes[m].area)].append(ring)
    return list(result.values())
