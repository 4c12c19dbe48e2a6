"""One closed skin for each block of buildings that touch: party walls vanish where there are buildings on both sides.

Where walls face each other, they cancel out; everything else keeps its points, in float64. So the skin has no gap and
no sliver that the buildings do not have, and every face keeps its building and kind. Where several sheets of surface
meet in a point, each sheet gets its own vertex.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.planar import with_exact_faces
from p2wss.mesh.topology import NEXT, doubled_areas
from p2wss.mesh.triangulation import triangulated_in_space
from p2wss.reconstruction.running.failures import note, surviving
from p2wss.reconstruction.skin.common_roofs import with_common_roofs
from p2wss.reconstruction.skin.party_walls import NotJoined, without_party_walls
from p2wss.reconstruction.skin.solids import (
    MAX_LOWERING_M,
    Face,
    area_vectors,
    faces_of,
    on_common_floors,
    opposite_walls,
)
from p2wss.skeleton.angles import bearings
from p2wss.skeleton.groups import groups

# areas of triangles may add up to this much less or more than their face
_AREA_M2 = 1e-3


@dataclass(frozen=True)
class Skin:
    """A closed surface around one building, or around several that touch.

    building_ids: sorted. mesh: in the coordinates of the buildings' meshes. Every edge has exactly two triangles, every
    vertex one fan of triangles, and every face its own label. building: int32 (t,), the building of each triangle, an
    index into ``building_ids``. failure: if this is a single building that touches others, why they could not be
    joined, else None.
    """

    building_ids: tuple[str, ...]
    mesh: Mesh
    building: np.ndarray
    failure: str | None = None


def skins(solids: Mapping[str, Mesh], max_lowering_m: float = MAX_LOWERING_M) -> list[Skin]:
    """One skin per block, in the order of the first building of each. Every building is part of one.

    solids: closed meshes by the ids of the buildings, with vertical walls and one roof height at every place.
    max_lowering_m: floors of touching buildings are lowered by at most this to be level.

    A skin is always closed: if the walls of a block do not fit each other, each of its buildings gets a skin of its own
    with a ``failure``. The same holds, where errors are met, for a block at which the code fails.
    """
    if not solids:
        return []
    origin = np.floor(np.min([mesh.vertex_m.min(axis=0) for mesh in solids.values()], axis=0))
    local = {name: mesh.translated(-origin) for name, mesh in solids.items()}
    point, faces = faces_of(list(local.values()))
    building_of = np.array([face.building for face in faces])
    touching = building_of[opposite_walls(point, faces)].reshape(-1, 2)
    local = on_common_floors(local, touching, max_lowering_m)
    names, block_of = np.array(list(local), object), groups(len(local), touching)
    blocks = [
        {name: local[name] for name in sorted(names[block_of == block])}
        for block in dict.fromkeys(block_of.tolist())
    ]

    def apart(block: Mapping[str, Mesh], trace: str) -> list[Skin]:
        note(f"skin of the block of {min(block)}", trace, "its buildings stay apart")
        return unjoined({name: mesh.translated(origin) for name, mesh in block.items()})

    return surviving(lambda some: [skin for block in some for skin in _joined(block, origin)], blocks, apart)


def unjoined(solids: Mapping[str, Mesh]) -> list[Skin]:
    """After an internal error: each building's mesh as a skin of its own."""
    return [
        Skin((name,), mesh, np.zeros(len(mesh.triangle), np.int32), "internal error")
        for name, mesh in solids.items()
    ]


def _joined(solids: Mapping[str, Mesh], origin: np.ndarray) -> list[Skin]:
    """One skin around solids that touch; if they cannot be joined, one skin around each, with the failure."""
    failure = None
    if len(solids) > 1:
        try:
            parts = without_party_walls(*faces_of(with_common_roofs(list(solids.values()))))
            return [_skin(list(solids), *parts, origin)]
        except NotJoined as error:
            failure = str(error)
    return [_skin([name], *faces_of([mesh]), origin, failure) for name, mesh in solids.items()]


def _skin(
    building_ids: Sequence[str],
    point: np.ndarray,
    faces: Sequence[Face],
    origin: np.ndarray,
    failure: str | None = None,
) -> Skin:
    exact = with_exact_faces(sheets(triangulated(point, faces)), walls_stay=len(building_ids) == 1)
    building = np.array([face.building for face in faces], np.int32)[exact.label]
    return Skin(tuple(building_ids), exact.translated(origin), building, failure)


def triangulated(point: np.ndarray, faces: Sequence[Face]) -> Mesh:
    """The mesh of faces; the label of a triangle is the index of its face.

    Faces without triangles are triangulated (constrained Delaunay), with every point of the rings as a corner. Raises
    :class:`NotJoined` if a face is no polygon.
    """
    pending = [face for face in faces if face.triangles is None]
    if pending:
        normal = area_vectors(point, pending)
        area_m2 = np.linalg.norm(normal, axis=1)
        normal /= np.maximum(area_m2, 1e-12)[:, None]
        triangle, number = triangulated_in_space(point, [face.rings for face in pending], normal)
        doubled_m2 = (doubled_areas(point[triangle]) * normal[number]).sum(axis=1)
        if np.abs(np.bincount(number, doubled_m2 / 2, len(pending)) - area_m2).max() > _AREA_M2:
            raise NotJoined("a face is no polygon")
        for k, face in enumerate(pending):
            face.triangles = triangle[number == k]
    parts = [np.zeros((0, 3), int) if face.triangles is None else face.triangles for face in faces]
    label = np.repeat(np.arange(len(faces), dtype=np.int32), [len(part) for part in parts])
    kind = np.array([face.kind for face in faces], np.uint8)[label]
    return Mesh(point, np.concatenate(parts).astype(np.int32), kind, label)


def sheets(mesh: Mesh) -> Mesh:
    """A closed surface in which every edge has two triangles and every point is surrounded by one fan of triangles.

    Where two bodies meet only in an edge or a point, each gets its own vertices there, at the same place. If they are
    joined at both ends of such an edge, the edge is divided in its middle. Raises :class:`NotJoined` if the surface is
    not closed.
    """
    point, triangle, repeated = _fans(mesh.vertex_m, mesh.triangle.astype(np.int64))
    if len(repeated):
        for edge in repeated.tolist():
            mesh = _with_middle(mesh, *edge)
        point, triangle, repeated = _fans(mesh.vertex_m, mesh.triangle.astype(np.int64))
    if len(repeated):
        raise NotJoined("an edge with more than two faces")
    return replace(mesh, vertex_m=point, triangle=triangle.astype(np.int32))


def _with_middle(mesh: Mesh, start: int, end: int) -> Mesh:
    """The mesh with the edge between two vertices divided in its middle."""
    triangle, new = mesh.triangle, len(mesh.vertex_m)
    has_edge = (triangle == start).any(axis=1) & (triangle == end).any(axis=1)
    halves = [np.where((triangle == each) & has_edge[:, None], new, triangle) for each in (start, end)]
    kind, label = (np.concatenate([each, each[has_edge]]) for each in (mesh.kind, mesh.label))
    middle_m = mesh.vertex_m[[start, end]].mean(axis=0, keepdims=True)
    return Mesh(
        np.concatenate([mesh.vertex_m, middle_m]),
        np.concatenate([halves[0], halves[1][has_edge]]),
        kind,
        label,
    )


def _fans(point: np.ndarray, triangle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points, one for each fan of triangles; triangles; edges (n, 2) by given points, which more than two of the new
    triangles share)."""
    start, end = triangle.ravel(), triangle[:, NEXT].ravel()
    size = len(point)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort([start > end, low * size + high])
    key = (low * size + high)[order]
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    forward = (start < end)[order]
    balance = np.add.reduceat(np.where(forward, 1, -1), first)
    if (balance != 0).any():
        raise NotJoined("an edge without a second face")
    twin = np.empty(len(start), int)
    simple = first[count == 2]
    twin[order[simple]], twin[order[simple + 1]] = order[simple + 1], order[simple]
    for begin, number in zip(first[count > 2].tolist(), count[count > 2].tolist(), strict=True):
        halves = order[begin : begin + number]
        _pair_around(point, triangle, halves, twin)
    # a corner is named like the half-edge that starts in it
    following = np.arange(len(start)).reshape(-1, 3)[:, NEXT].ravel()
    links = np.column_stack([np.arange(len(start)), following[twin]])
    fan = groups(len(start), links)
    fans, corner, renumbered = np.unique(fan, return_index=True, return_inverse=True)
    # fans in the order of their points, so that the result does not depend on how they were found
    position = np.argsort(start[corner], kind="stable")
    rank = np.empty(len(fans), int)
    rank[position] = np.arange(len(fans))
    result = rank[renumbered].reshape(-1, 3)
    sides = np.column_stack([result.ravel(), result[:, NEXT].ravel()])
    _, side, count = np.unique(sides, axis=0, return_index=True, return_counts=True)
    side = side[count > 1]
    repeated = np.unique(np.column_stack([low[side], high[side]]), axis=0)
    return point[start[corner[position]]], result, repeated


def _pair_around(point: np.ndarray, triangle: np.ndarray, halves: np.ndarray, twin: np.ndarray) -> None:
    """Store the twins of the half-edges of one edge with four or more triangles in ``twin``: two triangles that bound
    the same piece of solid are twins there."""
    t, k = np.divmod(halves, 3)
    start, end = triangle[t, k], triangle[t, (k + 1) % 3]
    forward = start < end
    a, b = point[min(start[0], end[0])], point[max(start[0], end[0])]
    axis = (b - a) / np.linalg.norm(b - a)
    across = point[triangle[t, (k + 2) % 3]] - a
    across -= (across @ axis)[:, None] * axis
    u = across[0] / np.linalg.norm(across[0])
    angle = bearings(across @ np.column_stack([u, np.cross(axis, u)]))
    # counter-clockwise about the axis, solid lies between a triangle on the way back and the next on the way forth
    around = np.lexsort([forward, angle])
    turn = forward[around]
    if (turn == np.roll(turn, 1)).any():
        raise NotJoined("solids overlap at an edge")
    if turn[0]:
        around = np.roll(around, -1)
    for back, forth in around.reshape(-1, 2):
        twin[halves[back]], twin[halves[forth]] = halves[forth], halves[back]
