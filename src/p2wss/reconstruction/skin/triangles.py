"""The triangles of a skin's faces; where several sheets of surface meet in a point, each sheet gets its own vertex."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.topology import NEXT, doubled_areas
from p2wss.mesh.triangulation import triangulated_in_space
from p2wss.reconstruction.skin.party_walls import NotJoined
from p2wss.reconstruction.skin.solids import Face, area_vectors
from p2wss.skeleton.angles import bearings
from p2wss.skeleton.groups import groups

# areas of triangles may add up to this much less or more than their face
_AREA_M2 = 1e-3


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
