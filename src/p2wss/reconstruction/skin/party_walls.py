"""Remove walls of two buildings where they coincide; the remaining parts stay with their buildings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from p2wss.reconstruction.skin.noding import ring_edges
from p2wss.reconstruction.skin.solids import Face

# areas of the pieces of a wall may add up to this much less or more than the wall
_AREA_M2 = 1e-2


class NotJoined(Exception):
    """The walls of a block do not fit each other: its buildings overlap, or a wall is not upright."""


def without_common(
    point: np.ndarray, faces: Sequence[Face], walls: Sequence[int], areas: np.ndarray
) -> list[Face]:
    """What remains of ``walls``, faces of one upright plane without crossing edges, where it has no building on one of
    its sides. areas: of each (:func:`~p2wss.reconstruction.skin.solids.area_vectors`).

    The boundary of the result is the sum of the boundaries of ``walls``, so what was closed stays closed. Raises
    :class:`NotJoined` where two walls of one side overlap.
    """
    largest = areas[np.abs(areas).max(axis=1).argmax()]
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
    edges = {edge for wall in walls for ring in faces[wall].rings for edge in ring_edges(ring)}
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
        for piece in shapely.get_parts(shapely.coverage_union_all(cells[rows[alone]])):
            # seen from the side of the wall, the exterior is counter-clockwise
            pieces = [
                [of_place[x, y] for x, y in shapely.get_coordinates(ring)[:-1].tolist()]
                for ring in shapely.get_rings(shapely.orient_polygons(piece, exterior_cw=bool(sides[0])))
            ]
            result.append(Face(faces[wall].building, faces[wall].kind, faces[wall].label, pieces))
    return result
