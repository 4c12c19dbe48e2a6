"""Makes the roofs of a mesh exactly planar and removes short edges: planes move by millimetres, and walls stay."""

from dataclasses import replace

import numpy as np

from p2wss.mesh import contraction
from p2wss.mesh.mesh import Mesh
from p2wss.mesh.rules import crosses_itself
from p2wss.mesh.shell_kernels import NO_HEIGHT_M, Triangles, can_merge, planes_at, thin_triangles
from p2wss.mesh.topology import NEXT, first_of_faces
from p2wss.mesh.triangulation import triangulated_in_space

# ends of an edge that are nearer than this become one
SHORT_EDGE_M = 0.05
# faces are divided anew if a triangle has a height that is a smaller share of its longest side
_NARROW = 0.02


def with_exact_faces(mesh: Mesh, short_m: float = SHORT_EDGE_M, walls_stay: bool = True) -> Mesh:
    """The mesh with planar walls and roofs, as far as possible, and without edges shorter than ``short_m`` where they
    can be removed, the shortest first.

    An edge is removed if the planes at both its ends can meet in one point and the mesh stays closed. Above the floor,
    it is enough that the planes that are left without the edge can meet. Walls on floors may shift for that unless
    ``walls_stay``. If there are slivers, the faces are divided anew.
    """
    is_shorter, tried = len(mesh.triangle) > 0, set[object]()
    # once edges are removed or faces are divided anew, planes may meet and edges may be removed that could not before
    while is_shorter:
        mesh = _with_planes(mesh)
        shorter = _without_short_edges(mesh, short_m, walls_stay, tried)
        is_shorter = shorter is not mesh
        mesh = _without_slivers(shorter.part(slice(None)) if is_shorter else mesh)
    return mesh


def _without_slivers(mesh: Mesh) -> Mesh:
    is_narrow = 2 * mesh.area_m2 < _NARROW * mesh.edge_m.max(axis=1, initial=0.0) ** 2
    if not is_narrow.any():
        return mesh
    # as faces are only planar to tenths of a millimetre, other diagonals may cross faces beside them
    divided = with_faces_divided(mesh, np.ones(len(mesh.vertex_m), bool))
    return divided if divided is mesh or _is_as_valid(divided, mesh) else mesh


def _with_planes(mesh: Mesh) -> Mesh:
    """The mesh with planar walls and roofs, if it stays valid."""
    flipped = _flipped(mesh)
    _, moved_m, *_ = contraction.contracted(flipped.arrays, -1, -1, 0.0, True)
    if (moved_m == flipped.vertex_m).all():
        return flipped
    result = flipped.moved(moved_m)
    return result if _is_as_valid(result, flipped) else flipped


def _without_short_edges(mesh: Mesh, short_m: float, walls_stay: bool, tried: set[object]) -> Mesh:
    """The mesh after one round. tried: see :func:`_without_shortest`."""
    kept = set[object]()
    while (shorter := _without_shortest(mesh, short_m, walls_stay, kept, tried)) is not None:
        mesh = shorter
    return mesh


def _without_shortest(
    mesh: Mesh, short_m: float, walls_stay: bool, kept: set[object], tried: set[object]
) -> Mesh | None:
    """The mesh without the shortest edge that can be removed; None if there is none.

    Edges that could not be removed are not tried again: in this round, no edge with the same planes at its ends
    (``kept``); in later rounds, no such edge whose planes still have the same vertices (``tried``). Both sets grow.
    """
    is_short = mesh.edge_m < short_m
    if not is_short.any():
        return None
    vertex_m, triangle, _, label = mesh.arrays
    vertex, plane = planes_at(triangle, label, len(vertex_m))
    begin = np.searchsorted(vertex, np.arange(len(vertex_m) + 1))
    ends = np.stack([triangle, triangle[:, NEXT]], axis=2)[is_short]
    ends = ends[np.argsort(mesh.edge_m[is_short], kind="stable")]
    # each edge once, not for both its triangles
    once = np.unique(np.sort(ends) @ [len(vertex_m), 1], return_index=True)[1]
    for end, gone in ends[np.sort(once)].tolist():
        planes = [plane[begin[v] : begin[v + 1]] for v in (end, gone)]
        around = frozenset(each.tobytes() for each in planes)
        if around in kept or not can_merge(triangle, len(vertex_m), end, gone):
            continue
        is_at = np.zeros(plane.max() + 1, bool)
        is_at[np.concatenate(planes)] = True
        state = around, vertex_m[vertex[is_at[plane]]].tobytes()
        if state not in tried:
            is_beside = contraction.beside_edge(mesh.arrays, vertex, plane, end, gone, walls_stay)
            result = _without_edge(mesh, is_beside, end, gone, short_m, walls_stay)
            if result is not None:
                return result
        kept.add(around)
        tried.add(state)
    return None


def _without_edge(
    mesh: Mesh, is_near: np.ndarray, end: int, gone: int, short_m: float, walls_stay: bool
) -> Mesh | None:
    """The mesh in which the ends of an edge are one vertex. None if its planes do not meet there, or if a vertex would
    come to the place of another one, as where four walls share an upright edge, or pass it. is_near: bool (t,), the
    triangles that may change, and the triangles of planes that meet theirs; all others are only tested for crossings.
    """
    near = Triangles(mesh.arrays.vertex_m, *(each[is_near] for each in mesh.arrays[1:]))
    is_possible, vertex_m, joined, stays = contraction.contracted(near, end, gone, short_m, walls_stay)
    if not is_possible:
        return None
    changed = Mesh(vertex_m, joined[stays], near.kind[stays], near.label[stays])
    num_thin = thin_triangles(near).sum()
    if thin_triangles(changed.arrays).sum() > num_thin:
        changed = _flipped(changed)
    parts = (mesh.triangle, changed.triangle), (mesh.kind, changed.kind), (mesh.label, changed.label)
    result = Mesh(vertex_m, *(np.concatenate([old[~is_near], new]).astype(old.dtype) for old, new in parts))
    num_same = len(result.triangle) - len(changed.triangle)
    if thin_triangles(changed.arrays).sum() > num_thin:
        # thin triangles at the other end of a step that was removed, or at a vertex that a wall now passes through
        result = _without_short_edges(result, NO_HEIGHT_M, walls_stay, set())
        num_same, is_near = 0, np.ones(len(mesh.triangle), bool)
        if thin_triangles(result.arrays).sum() > thin_triangles(mesh.arrays).sum():
            return None
    return result if _is_as_valid(result, mesh, num_same, is_near) else None


def without_straight_vertices(mesh: Mesh) -> Mesh:
    """The mesh without vertices within edges of two faces, if there are any (:func:`with_faces_divided`)."""
    is_corner = mesh.num_planes_at != 2
    return mesh if is_corner.all() else with_faces_divided(mesh, is_corner)


def with_faces_divided(mesh: Mesh, stays: np.ndarray) -> Mesh:
    """The mesh with its faces divided by constrained Delaunay triangulation, without the vertices that do not stay.

    stays: bool (v,), false only for vertices within straight edges. Returns the mesh itself if a face is no valid
    polygon, if a face has a vertex in its interior, or if two faces in the same place share a diagonal, as in a wall
    without thickness.
    """
    first, rings = first_of_faces(mesh.face), [surface.rings for surface in mesh.surfaces]
    if not stays.all():
        rings = [[ring[stays[ring]] for ring in face] for face in rings]
    if min(len(ring) for face in rings for ring in face) < 3:
        return mesh
    triangle, face = triangulated_in_space(mesh.vertex_m, rings, mesh.planes.normal[mesh.number[first]])
    result = Mesh(mesh.vertex_m, triangle.astype(np.int32), mesh.kind[first][face], mesh.label[first][face])
    result = result.part(slice(None))
    # each removed vertex leaves two triangles less
    is_whole = len(triangle) == len(mesh.triangle) - 2 * np.count_nonzero(~stays)
    return result if is_whole and result.is_closed else mesh


def _is_as_valid(mesh: Mesh, before: Mesh, num_same: int = 0, is_changed: np.ndarray | None = None) -> bool:
    """Whether a change has kept a mesh valid: it is as closed as ``before`` (:func:`p2wss.mesh.contraction.changes`),
    and does not cross itself unless ``before`` did. num_same, is_changed: see :func:`_changes`."""
    is_as_closed, asked = _changes(mesh, before, num_same, is_changed)
    if is_as_closed and crosses_itself(mesh.vertex_m, mesh.triangle, asked):
        return crosses_itself(before.vertex_m, before.triangle)
    return is_as_closed


def _changes(
    mesh: Mesh, before: Mesh, num_same: int = 0, is_changed: np.ndarray | None = None
) -> tuple[bool, np.ndarray]:
    """The result of :func:`p2wss.mesh.contraction.changes` for meshes. num_same: how many triangles, the first, are as
    before. is_changed: bool (t,), the triangles of ``before`` that have changed; by default all."""
    is_changed = np.ones(len(before.triangle), bool) if is_changed is None else is_changed
    return contraction.changes(mesh.arrays, num_same, before.arrays, is_changed)


def _flipped(mesh: Mesh) -> Mesh:
    """The mesh without triangles that have no height and a corner within their longest side, as far as possible. The
    side is replaced: the triangle across it is divided in two at that corner."""
    is_thin = thin_triangles(mesh.arrays)
    pending = np.flatnonzero(is_thin).tolist()
    while pending:
        t = pending.pop(0)
        side = int(mesh.edge_m[t].argmax())
        across, there = divmod(int(mesh.twin[t, side]), 3)
        if mesh.edge_m[t].min() <= NO_HEIGHT_M or across < 0:
            continue
        start, _, corner = np.roll(mesh.triangle[t], -side)
        end, _, far = np.roll(mesh.triangle[across], -there)
        triangle, like = mesh.triangle.copy(), np.arange(len(mesh.triangle))
        triangle[across], triangle[t], like[t] = (end, corner, far), (corner, start, far), across
        result = replace(mesh, triangle=triangle, kind=mesh.kind[like], label=mesh.label[like])
        still_thin = thin_triangles(result.arrays)
        if still_thin.sum() < is_thin.sum() and _changes(result, mesh)[0]:
            mesh, is_thin, pending = result, still_thin, np.flatnonzero(still_thin).tolist()
    return mesh
