"""Roofs that are exactly planes, without short edges: planes move by millimetres, and walls stay as they are."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from p2wss.mesh.meeting import planes_around, turned_over, with_meeting_planes
from p2wss.mesh.mesh import Mesh
from p2wss.mesh.rules import crosses_itself
from p2wss.mesh.shell_kernels import can_merge, thin_triangles
from p2wss.mesh.topology import NEXT, first_of_faces
from p2wss.mesh.triangulation import triangulated_in_space
from p2wss.skeleton.types import FaceKind, distinct, writable

# planes that a corner of theirs stays further from than this, or leaves by more than the second figure, stay
_PLANAR_M, _MAX_MOVE_M = 2e-4, 0.06
# ends of an edge that are nearer than this become one
SHORT_EDGE_M = 0.05
# ends that are nearer to each other may be one vertex in a file
_MERGED_M = 2e-3
# a triangle of less height than this has no normal that survives the rounding of a file
_NO_HEIGHT_M = 1e-3
# with a triangle whose height is a smaller share of its longest side, faces are divided anew
_NARROW = 0.02
_GROUND, _WALL = int(FaceKind.GROUND), int(FaceKind.WALL)


def with_exact_faces(mesh: Mesh, short_m: float = SHORT_EDGE_M, walls_stay: bool = True) -> Mesh:
    """The mesh with planar walls and roofs, as far as that is possible, and without those edges shorter than
    ``short_m`` that can go, the shortest first.

    An edge goes if the planes at both its ends, or above floors those that are left without it, can meet in one point,
    and the mesh stays closed. Walls on floors may shift for that unless ``walls_stay``. With slivers, the faces are
    divided anew.
    """
    is_shorter, tried = True, set[object]()
    # after others went, and with faces divided anew, planes may meet, and an edge may go, that could not before
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
    # as faces are planar but for tenths of a millimetre, other diagonals may cross what is beside them
    divided = with_faces_divided(mesh, np.ones(len(mesh.vertex_m), bool))
    return divided if _is_as_valid(divided, mesh, divided, mesh) else mesh


def _with_planes(mesh: Mesh) -> Mesh:
    """The mesh with planar walls and roofs, if it stays valid."""
    flipped = _flipped(mesh)
    result = _met(flipped, np.arange(len(flipped.vertex_m)))
    return result if result and _is_as_valid(result, flipped, result, flipped) else flipped


def _without_short_edges(mesh: Mesh, short_m: float, walls_stay: bool, tried: set[object]) -> Mesh:
    """The mesh after one round. tried: see :func:`_without_shortest`."""
    kept = set[object]()
    while (shorter := _without_shortest(mesh, short_m, walls_stay, kept, tried)) is not None:
        mesh = shorter
    return mesh


def _without_shortest(
    mesh: Mesh, short_m: float, walls_stay: bool, kept: set[object], tried: set[object]
) -> Mesh | None:
    """The mesh without the shortest edge that can go, None if there is none.

    Edges that could not go are not tried again, those with the same planes at their ends in this round (``kept``), and
    those whose planes have the same vertices in any (``tried``); both are added to.
    """
    edge_m = mesh.edge_m.ravel()
    rows = np.flatnonzero(edge_m < short_m)
    if not len(rows):
        return None
    num = int(mesh.label.max(initial=0)) + 1
    triangle = writable(mesh.triangle, np.int64)
    vertex, label = np.divmod(distinct(triangle * num + mesh.label[:, None]), num)
    begin = np.searchsorted(vertex, np.arange(len(mesh.vertex_m) + 1))
    can_move = _that_can_move(mesh, vertex, label)
    rows = rows[np.argsort(edge_m[rows], kind="stable")]
    # each edge once, not for both its triangles
    ends = np.column_stack([triangle.ravel()[rows], triangle.take(NEXT, 1).ravel()[rows]])
    once = np.unique(np.sort(ends) @ [len(mesh.vertex_m), 1], return_index=True)[1]
    for end, gone in ends[np.sort(once)].tolist():
        labels = [label[begin[v] : begin[v + 1]] for v in (end, gone)]
        around = frozenset(each.tobytes() for each in labels)
        if around in kept or not can_merge(triangle, len(mesh.vertex_m), end, gone):
            continue
        is_at, is_end = np.zeros(num, bool), np.zeros(len(mesh.vertex_m), bool)
        is_at[np.concatenate(labels)] = is_end[[end, gone]] = True
        state = around, mesh.vertex_m[vertex[is_at[label]]].tobytes()
        if state not in tried:
            is_near = planes_around(is_end, can_move if walls_stay else can_move | is_at, vertex, label)
            is_end[vertex[is_near[label]]] = True
            # and what is beside them, as floors on which walls stand, which then do not move
            one, two, three = is_end.take(mesh.triangle).T
            is_beside = one & two | two & three | three & one
            result = _without_edge(mesh, is_beside, end, gone, short_m, walls_stay)
            if result is not None:
                return result
        kept.add(around)
        tried.add(state)
    return None


def _that_can_move(mesh: Mesh, vertex: np.ndarray, label: np.ndarray) -> np.ndarray:
    """bool (p,): which planes are no floors, nor walls on them. vertex, label: all pairs of a vertex and a plane."""
    kind, is_on_floor = np.zeros(label.max() + 1, np.uint8), np.zeros(len(mesh.vertex_m), bool)
    kind[mesh.label] = mesh.kind
    is_on_floor[mesh.triangle[mesh.kind == _GROUND]] = True
    stands = np.bincount(label, is_on_floor[vertex]) > 0
    return np.asarray((kind != _GROUND) & ~(stands & (kind == _WALL)))


def _without_edge(
    mesh: Mesh, is_near: np.ndarray, end: int, gone: int, short_m: float, walls_stay: bool
) -> Mesh | None:
    """The mesh in which the ends of an edge are one vertex, None if its planes do not meet there, or if a vertex comes
    to where another one is, as where four walls share an upright edge, or beyond. is_near: bool (t,), the triangles
    that may change, and those of planes that meet theirs: the others are not looked at, but for crossings."""
    number, patch = distinct(mesh.triangle[is_near]), mesh.part(is_near)
    end, gone = np.searchsorted(number, (end, gone)).tolist()
    changed = _without_side(patch, end, gone, short_m, walls_stay)
    if changed is None:
        return None
    num_thin = _is_thin(patch).sum()
    if _is_thin(changed).sum() > num_thin:
        changed = _flipped(changed)
    vertex_m = mesh.vertex_m.copy()
    vertex_m[number] = changed.vertex_m
    parts = (mesh.triangle, number[changed.triangle]), (mesh.kind, changed.kind), (mesh.label, changed.label)
    result = Mesh(vertex_m, *(np.concatenate([old[~is_near], new]).astype(old.dtype) for old, new in parts))
    # of a large mesh, nothing else takes as long
    vars(result)["edge_m"] = np.concatenate([mesh.edge_m[~is_near], changed.edge_m])
    if _is_thin(changed).sum() > num_thin:
        # the other end of a step that went, or a vertex that a wall now passes through
        result = changed = _without_short_edges(result, _NO_HEIGHT_M, walls_stay, set())
        patch, num_thin = mesh, _is_thin(mesh).sum()
    is_thin = _is_thin(changed).sum() > num_thin
    return result if not is_thin and _is_as_valid(result, mesh, changed, patch) else None


def _without_side(mesh: Mesh, end: int, gone: int, short_m: float, walls_stay: bool) -> Mesh | None:
    """The mesh in which the ends of an edge are one vertex, None if its planes do not meet there."""
    each = np.arange(len(mesh.vertex_m))
    each[gone] = end
    vertex, plane = mesh.at
    free = () if walls_stay else {*plane[vertex == end].tolist()} ^ {*plane[vertex == gone].tolist()}
    result = _met(mesh, each, short_m, free, each == end)
    if result is not None:
        result = _merged(result, end, gone)
    elif gone not in mesh.triangle[mesh.kind == _GROUND]:
        merged = _merged(mesh, end, gone)
        result = _met(merged, np.arange(len(each)), short_m, only=np.arange(len(each)) == end)
    return result


def without_straight_vertices(mesh: Mesh) -> Mesh:
    """The mesh without vertices within edges of two faces, if there are any (:func:`with_faces_divided`)."""
    is_corner = mesh.num_planes_at != 2
    return mesh if is_corner.all() else with_faces_divided(mesh, is_corner)


def with_faces_divided(mesh: Mesh, stays: np.ndarray) -> Mesh:
    """The mesh whose faces are divided by constrained Delaunay triangulation, without those vertices within straight
    edges that do not stay, bool (v,); the mesh itself if a face is no valid polygon, or has a vertex within, or if two
    faces in one place, as of a wall without thickness, share a diagonal."""
    first, rings = first_of_faces(mesh.face), [surface.rings for surface in mesh.surfaces]
    if not stays.all():
        rings = [[ring[stays[ring]] for ring in face] for face in rings]
    if min(len(ring) for face in rings for ring in face) < 3:
        return mesh
    triangle, face = triangulated_in_space(mesh.vertex_m, rings, mesh.planes.normal[mesh.number[first]])
    result = Mesh(mesh.vertex_m, triangle.astype(np.int32), mesh.kind[first][face], mesh.label[first][face])
    result = result.part(slice(None))
    # each vertex within an edge was a corner of two triangles more than are left without it
    is_whole = len(triangle) == len(mesh.triangle) - 2 * np.count_nonzero(~stays)
    return result if is_whole and result.is_closed else mesh


def _met(
    mesh: Mesh,
    place: np.ndarray,
    max_move_m: float = 0.0,
    free: Collection[int] = (),
    only: np.ndarray | None = None,
) -> Mesh | None:
    """The mesh whose planes meet at ``place`` (:func:`p2wss.mesh.meeting.with_meeting_planes`), if possible without
    turning walls; None if no change of centimetres does that."""
    for turns in (False, True):
        moved, apart_m = with_meeting_planes(
            mesh, place, free=free, turns=turns, corners_stay=not free, only=only
        )
        if apart_m.max() > _PLANAR_M:
            continue
        if moved is mesh:
            return mesh
        move_m = moved.vertex_m - mesh.vertex_m
        # the walls on floors stay where they are not free
        if not free and move_m[mesh.triangle[mesh.kind == _GROUND]].any():
            continue
        # along a plane a vertex may move further, as where roofs of nearly the same slope meet
        vertex, plane = mesh.at
        off_m = np.abs((move_m[vertex] * mesh.planes.normal[plane]).sum(axis=1)).max()
        is_near = off_m <= max(_MAX_MOVE_M, max_move_m)
        if is_near and turned_over(moved, mesh).sum() <= turned_over(mesh, mesh).sum():
            return moved
    return None


def _is_as_valid(mesh: Mesh, before: Mesh, changed: Mesh, patch: Mesh) -> bool:
    """Whether a mesh has no side without another that had one, no edge that files merge, and does not cross itself, if
    so was the one before. changed, patch: the last triangles of the mesh, and those that they were before, with the
    same numbers of vertices; what is beside them stays."""
    if changed is patch:
        return True
    if not _is_as_closed(changed, patch) or changed.edge_m.min() < min(before.edge_m.min(), _MERGED_M):
        return False
    is_moved = (changed.vertex_m != patch.vertex_m).any(axis=1)
    base = len(is_moved) ** np.arange(3)
    own, old = (np.sort(each.triangle) @ base for each in (changed, patch))
    old.sort()
    is_old = old[np.minimum(np.searchsorted(old, own), len(old) - 1)] == own
    asked = len(mesh.triangle) - len(own) + np.flatnonzero(is_moved[changed.triangle].any(axis=1) | ~is_old)
    if not crosses_itself(mesh.vertex_m, mesh.triangle, asked):
        return True
    return crosses_itself(before.vertex_m, before.triangle)


def _is_as_closed(mesh: Mesh, before: Mesh) -> bool:
    """Whether the same sides as before, in the same places, have no triangle beside them, and not more of them have
    several."""
    (side, num_same), (was_side, was_same) = _open_sides(mesh), _open_sides(before)
    at = side // len(mesh.vertex_m)
    is_same = np.array_equal(side, was_side) and num_same <= was_same
    return is_same and np.array_equal(mesh.vertex_m[at], before.vertex_m[at])


def _open_sides(mesh: Mesh) -> tuple[np.ndarray, int]:
    """(those sides of triangles that have none beside them, int (k,), start times the number of vertices plus end,
    ascending; how often two triangles have the same side)."""
    side = (mesh.triangle.astype(np.int64) * len(mesh.vertex_m) + mesh.triangle.take(NEXT, 1)).ravel()
    return np.sort(side[mesh.twin.ravel() < 0]), len(side) - len(distinct(side))


def _merged(mesh: Mesh, end: int, gone: int) -> Mesh:
    """The mesh after the ends of an edge have become one vertex; the other one has no triangle."""
    stays = ~((mesh.triangle == end).any(axis=1) & (mesh.triangle == gone).any(axis=1))
    triangle = np.where(mesh.triangle == gone, end, mesh.triangle)
    return Mesh(mesh.vertex_m, triangle[stays], mesh.kind[stays], mesh.label[stays])


def _flipped(mesh: Mesh) -> Mesh:
    """The mesh in which those triangles without height whose corner is within the side opposite to it are gone: the
    triangle across the side has that corner, too, and is two."""
    for t in np.flatnonzero(_is_thin(mesh) & (mesh.edge_m.min(axis=1) > _NO_HEIGHT_M)).tolist():
        side = int(mesh.edge_m[t].argmax())
        start, _, corner = np.roll(mesh.triangle[t], -side)
        across, there = divmod(int(mesh.twin[t, side]), 3)
        if across < 0:
            continue
        end, _, far = np.roll(mesh.triangle[across], -there)
        triangle, like = mesh.triangle.copy(), np.arange(len(mesh.triangle))
        triangle[across], triangle[t], like[t] = (end, corner, far), (corner, start, far), across
        result = replace(mesh, triangle=triangle, kind=mesh.kind[like], label=mesh.label[like])
        if _is_thin(result).sum() < _is_thin(mesh).sum() and _is_as_closed(result, mesh):
            return _flipped(result)
    return mesh


def _is_thin(mesh: Mesh) -> np.ndarray:
    """bool (t,): whether a triangle has no height."""
    triangle = writable(mesh.triangle, np.int64)
    return np.asarray(thin_triangles(writable(mesh.vertex_m, np.float64), triangle, _NO_HEIGHT_M))
