"""The faces of a labelled triangle mesh as planar polygons with holes, as CityJSON stores them.

Triangles with equal labels that share a side are one face: there is no geometric tolerance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from p2wss.mesh.topology import border_rings, first_of_faces


@dataclass(frozen=True)
class Surface:
    """One planar polygon of a building.

    kind: a ``FaceKind``. label: the label of its triangles, or -1. rings: vertex indices, the exterior first,
    counter-clockwise seen from outside; holes clockwise. face: the number of its face; pieces of one face have the same
    number.
    """

    kind: int
    label: int
    rings: Sequence[np.ndarray]
    face: int = -1


def surfaces_of(
    vertex_m: np.ndarray,
    triangle: np.ndarray,
    kind: np.ndarray,
    label: np.ndarray,
    face: np.ndarray,
    twin: np.ndarray,
) -> list[Surface]:
    """The faces of a closed mesh, in the order of their numbers ``face`` (t,). Arguments: see
    :class:`p2wss.mesh.Mesh`.

    The exterior ring of a face comes first; every ring has the direction of its triangles. A vertex within a straight
    side is kept where a neighbour has a corner. A hole that touches the exterior or another hole in a vertex is a ring
    of its own.
    """
    first = first_of_faces(face)
    rings: list[list[np.ndarray]] = [[] for _ in first]
    for number, ring in border_rings(triangle, face, twin):
        rings[number] += simple_rings(ring)
    return [
        Surface(int(kind[t]), int(label[t]), _exterior_first(vertex_m, rings[number]), number)
        for number, t in enumerate(first)
    ]


def simple_rings(ring: list[int]) -> list[np.ndarray]:
    """A ring, divided into rings that visit no vertex twice."""
    if len({*ring}) == len(ring):
        return [np.array(ring)]
    rings: list[np.ndarray] = []
    path: list[int] = []
    position: dict[int, int] = {}
    for vertex in ring:
        if vertex in position:
            first = position[vertex]
            rings.append(np.array(path[first:]))
            for passed in path[first + 1 :]:
                del position[passed]
            del path[first + 1 :]
        else:
            position[vertex] = len(path)
            path.append(vertex)
    return [*rings, np.array(path)]


def doubled_area(ring_m: np.ndarray) -> np.ndarray:
    """The vector (3,) along the normal of a ring (n, 3), twice as long as its area (Newell's formula)."""
    away_m = ring_m - ring_m[0]
    # numpy's ``roll`` takes five times as long for a few vertices
    (x, y, z), (after_x, after_y, after_z) = away_m.T, away_m[np.arange(1 - len(ring_m), 1)].T
    return np.array([y @ after_z - z @ after_y, z @ after_x - x @ after_z, x @ after_y - y @ after_x])


def _exterior_first(vertex_m: np.ndarray, rings: list[np.ndarray]) -> list[np.ndarray]:
    """The rings of one face; only the exterior turns about the face's normal."""
    if len(rings) == 1:
        return rings
    area = [doubled_area(vertex_m[ring]) for ring in rings]
    turning = np.array(area) @ np.sum(area, axis=0)
    return [rings[i] for i in np.argsort(-turning, kind="stable")]
