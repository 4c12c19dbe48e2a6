"""The solids from which a skin is made, as polygons over one list of points; their common floors and touching walls."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from p2wss.mesh import Mesh
from p2wss.skeleton.types import FaceKind, next_in_ring

# points this near to each other are one place; a point this near to a wall's line is on it
TOLERANCE_M = 2e-3
# floors of touching buildings are lowered by at most this to be level with each other
MAX_LOWERING_M = 0.5
_UPRIGHT_NZ = 0.05
_OPPOSITE = -0.999


@dataclass
class Face:
    """A planar polygon of a building.

    building: index of its mesh. rings: indices of points, the exterior first, counter-clockwise seen from outside.
    triangles: int (t, 3), indices of points; None after the rings have changed.
    """

    building: int
    kind: int
    rings: list[list[int]]
    triangles: np.ndarray | None = None


def faces_of(meshes: Sequence[Mesh]) -> tuple[np.ndarray, list[Face]]:
    """(the points of all meshes, float64 (p, 3); all faces). Meshes share no points."""
    faces: list[Face] = []
    first = 0
    for number, mesh in enumerate(meshes):
        order = np.argsort(mesh.face, kind="stable")
        triangle, last = mesh.triangle[order].astype(int) + first, np.cumsum(np.bincount(mesh.face)).tolist()
        for surface, start, end in zip(mesh.surfaces, [0, *last], last, strict=False):
            rings = [(ring + first).tolist() for ring in surface.rings]
            faces.append(Face(number, surface.kind, rings, triangle[start:end]))
        first += len(mesh.vertex_m)
    return np.concatenate([mesh.vertex_m for mesh in meshes]), faces


def on_common_floors(
    solids: Mapping[str, Mesh], pairs: np.ndarray, max_lowering_m: float = MAX_LOWERING_M
) -> dict[str, Mesh]:
    """The solids, by their names, with their floors lowered to the floors of touching solids.

    pairs: int (n, 2), solids that touch. Pairs are joined to sets with a common floor, the smallest height difference
    first, as long as no floor of a set is more than ``max_lowering_m`` above another.
    """
    names, meshes = list(solids), list(solids.values())
    floors = [np.unique(mesh.triangle[mesh.kind == FaceKind.GROUND]) for mesh in meshes]
    floor = [
        float(mesh.vertex_m[ground, 2].min(initial=np.inf))
        for mesh, ground in zip(meshes, floors, strict=True)
    ]
    members = {k: [k] for k in range(len(names))}
    root = list(range(len(names)))
    distinct = {(int(a), int(b)) for a, b in np.sort(pairs, axis=1)}
    for a, b in sorted(
        distinct, key=lambda p: (abs(floor[p[0]] - floor[p[1]]), *sorted((names[p[0]], names[p[1]])))
    ):
        a, b = root[a], root[b]
        together = members[a] + members[b]
        heights = [floor[k] for k in together]
        if a != b and max(heights) - min(heights) <= max_lowering_m:
            members[a] = together
            for k in members.pop(b):
                root[k] = a
    result = {}
    for number, (mesh, ground) in enumerate(zip(meshes, floors, strict=True)):
        vertex_m = mesh.vertex_m.copy()
        vertex_m[ground, 2] = min(floor[k] for k in members[root[number]])
        result[names[number]] = mesh.moved(vertex_m)
    return result


def area_vectors(point: np.ndarray, faces: Sequence[Face]) -> np.ndarray:
    """float64 (f, 3): vectors along the outward normals of faces, as long as their areas are large (Newell)."""
    rings = [ring for face in faces for ring in face.rings]
    ring_offset = np.cumsum([0, *map(len, rings)])
    first = ring_offset[:-1]
    corner = point[[vertex for ring in rings for vertex in ring]]
    corner -= np.repeat(corner[first], np.diff(ring_offset), axis=0)
    face = np.repeat(np.arange(len(faces)), [len(face.rings) for face in faces])
    doubled = np.zeros((len(faces), 3))
    np.add.at(doubled, face, np.add.reduceat(np.cross(corner, corner[next_in_ring(ring_offset)]), first))
    return doubled / 2


def opposite_walls(point: np.ndarray, faces: Sequence[Face]) -> np.ndarray:
    """int (n, 2): pairs of faces, walls of two buildings that face each other along a common stretch of a line."""
    wall = np.array([number for number, face in enumerate(faces) if face.kind == FaceKind.WALL], int)
    if not len(wall):
        return np.zeros((0, 2), int)
    normal = area_vectors(point, [faces[number] for number in wall])
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
    is_upright = np.abs(normal[:, 2]) <= _UPRIGHT_NZ
    wall, normal = wall[is_upright], normal[is_upright, :2]
    normal /= np.hypot(*normal.T)[:, None]
    exterior = [faces[number].rings[0] for number in wall]
    owner, plan = np.repeat(np.arange(len(wall)), [*map(len, exterior)]), point[np.concatenate(exterior), :2]
    along = plan[:, 1] * normal[owner, 0] - plan[:, 0] * normal[owner, 1]
    # the corners at the two ends of each wall
    ends = [
        np.lexsort((each, owner))[np.searchsorted(owner, np.arange(len(wall)))] for each in (along, -along)
    ]
    segment = np.stack([plan[each] for each in ends], axis=1)
    building = np.array([faces[number].building for number in wall], int)
    lines = np.asarray(shapely.linestrings(segment), object)
    a, b = shapely.STRtree(lines).query(lines, predicate="dwithin", distance=TOLERANCE_M)
    candidate = (building[a] < building[b]) & ((normal[a] * normal[b]).sum(axis=1) < _OPPOSITE)
    a, b = a[candidate], b[candidate]
    # the common stretch along the line of the first wall, and the distance of the second at both of its ends
    origin, length = segment[a, 0], np.linalg.norm(segment[a, 1] - segment[a, 0], axis=1)
    along = (segment[a, 1] - origin) / np.maximum(length, 1e-12)[:, None]
    start, end = (((segment[b, k] - origin) * along).sum(axis=1) for k in (0, 1))
    apart, apart_end = (((segment[b, k] - origin) * normal[a]).sum(axis=1) for k in (0, 1))
    low, high = np.maximum(np.minimum(start, end), 0), np.minimum(np.maximum(start, end), length)
    slope = (apart_end - apart) / np.where(end == start, 1, end - start)
    near = [np.abs(apart + (place - start) * slope) <= TOLERANCE_M for place in (low, high)]
    facing = (high - low > 2 * TOLERANCE_M) & near[0] & near[1]
    return np.column_stack([wall[a[facing]], wall[b[facing]]])
