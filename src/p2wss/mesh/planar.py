"""Roofs that are exactly planes, without short edges: planes move by millimetres, and walls stay as they are."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from p2wss.mesh.meeting import turned_over, with_meeting_planes
from p2wss.mesh.mesh import Mesh
from p2wss.mesh.topology import NEXT
from p2wss.mesh.triangulation import triangulated_in_space
from p2wss.skeleton.types import FaceKind

# corners nearer to lines of walls are on them; planes of which a corner stays further than the second figure, or moves
# further than the third, stay as they are
_EXACT_M, _PLANAR_M, _MAX_MOVE_M = 1e-6, 2e-4, 0.06
# nothing within a wall is further than this from its line; lines whose angle has no greater sine squared are parallel
_MAX_BENT_M, _PARALLEL = 5e-3, 1e-3
# ends of an edge that are nearer than this become one
SHORT_EDGE_M = 0.05
# a triangle of less height than this has no normal that survives the rounding of a file
_NO_HEIGHT_M = 1e-3
# with a triangle whose height is a smaller share of its longest side, faces are divided anew
_NARROW = 0.02


def with_exact_faces(mesh: Mesh, short_m: float = SHORT_EDGE_M, walls_stay: bool = True) -> Mesh:
    """The mesh with straight walls (:func:`_with_straight_walls`) and planar roofs, as far as that is possible, and
    without those edges shorter than ``short_m`` that can go, the shortest first.

    An edge goes if the planes at both its ends, or those that are left without it, can meet in one point, and the mesh
    stays closed. Walls on floors may shift for that unless ``walls_stay``. With slivers, the faces are divided
    anew.
    """
    straight = _flipped(_with_straight_walls(mesh))
    each = np.arange(len(mesh.vertex_m))
    result: Mesh | None = _met(straight, each) or straight
    # planes at the ends of edges that could not go: with others there, they may
    kept = set()
    while result is not None:
        mesh, result = result, None
        edge_m = mesh.edge_m.ravel()
        rows = np.flatnonzero(edge_m < short_m)
        for row in rows[np.argsort(edge_m[rows], kind="stable")].tolist():
            end, gone = int(mesh.triangle.flat[row]), int(mesh.triangle[:, NEXT].flat[row])
            around = frozenset(
                np.unique(mesh.label[(mesh.triangle == each).any(axis=1)]).tobytes() for each in (end, gone)
            )
            if around in kept or not _can_merge(mesh, end, gone):
                continue
            each = np.arange(len(mesh.vertex_m))
            each[gone] = end
            vertex, plane = mesh.at
            free = () if walls_stay else {*plane[vertex == end].tolist()} ^ {*plane[vertex == gone].tolist()}
            moved = _met(mesh, each, short_m, free)
            if moved is None:
                merged = _merged(mesh, end, gone)
                result = _met(merged, np.arange(len(merged.vertex_m)), short_m)
            else:
                result = _merged(moved, end, gone)
            if result is not None and _is_thin(result).sum() > _is_thin(mesh).sum():
                # the other end of a step that went, or a vertex that a wall now passes through
                result = with_exact_faces(result, _NO_HEIGHT_M, walls_stay)
                result = None if _is_thin(result).sum() > _is_thin(mesh).sum() else result
            if result is not None and (result.is_closed or not mesh.is_closed):
                break
            # none, or a vertex has come to where another one is, and four walls share an upright edge
            result = None
            kept.add(around)
    is_narrow = 2 * mesh.area_m2 < _NARROW * mesh.edge_m.max(axis=1, initial=0.0) ** 2
    return with_faces_divided(mesh, np.ones(len(mesh.vertex_m), bool)) if is_narrow.any() else mesh


def without_straight_vertices(mesh: Mesh) -> Mesh:
    """The mesh without vertices within edges of two faces, if there are any (:func:`with_faces_divided`)."""
    is_corner = mesh.num_planes_at != 2
    return mesh if is_corner.all() else with_faces_divided(mesh, is_corner)


def with_faces_divided(mesh: Mesh, stays: np.ndarray) -> Mesh:
    """The mesh whose faces are divided by constrained Delaunay triangulation, without those vertices within straight
    edges that do not stay, bool (v,); the mesh itself if a face is no valid polygon, or has a vertex within, or if two
    faces in one place, as of a wall without thickness, share a diagonal."""
    first = np.unique(mesh.face, return_index=True)[1]
    rings = [[ring[stays[ring]] for ring in surface.rings] for surface in mesh.surfaces]
    if min(len(ring) for face in rings for ring in face) < 3:
        return mesh
    triangle, face = triangulated_in_space(mesh.vertex_m, rings, mesh.planes.normal[mesh.number[first]])
    result = Mesh(mesh.vertex_m, triangle.astype(np.int32), mesh.kind[first][face], mesh.label[first][face])
    # each vertex within an edge was a corner of two triangles more than are left without it
    is_whole = len(triangle) == len(mesh.triangle) - 2 * np.count_nonzero(~stays)
    return result.part(slice(None)) if is_whole and result.is_closed else mesh


def _met(mesh: Mesh, place: np.ndarray, max_move_m: float = 0.0, free: Collection[int] = ()) -> Mesh | None:
    """The mesh whose planes meet at ``place`` (:func:`p2wss.mesh.meeting.with_meeting_planes`), if possible without
    turning walls; None if no change of centimetres does that."""
    for turns in (False, True):
        moved, apart_m = with_meeting_planes(mesh, place, free=free, turns=turns)
        if apart_m.max() > _PLANAR_M:
            continue
        if moved is mesh:
            return mesh
        move_m = np.abs(moved.vertex_m - mesh.vertex_m)
        # the walls on floors stay where they are not free
        stays = bool(free) or not move_m[mesh.triangle[mesh.kind == FaceKind.GROUND]].any()
        num_turned = [turned_over(each, mesh).sum() for each in (mesh, moved)]
        if stays and move_m.max() <= max(_MAX_MOVE_M, max_move_m) and num_turned[1] <= num_turned[0]:
            return moved
    return None


def _with_straight_walls(mesh: Mesh) -> Mesh:
    """The mesh whose vertices within a wall are on the line between its ends, or where the lines of their walls meet.

    Those of the outer walls are there already; others are off by fractions of a millimetre, as least squares and shifts
    of planes left them.
    """
    planes = mesh.planes
    column = np.unique(np.round(mesh.vertex_m[:, :2] / _EXACT_M) @ [1, 1j], return_inverse=True)[1]
    num_columns = int(column.max(initial=-1)) + 1
    place_m = np.zeros((num_columns, 2))
    place_m[column] = mesh.vertex_m[:, :2]
    # the columns of each wall, in their order along it
    vertex, plane = mesh.at
    pairs = (plane * num_columns + column[vertex])[planes.is_wall[plane]]
    wall, own = np.divmod(np.unique(pairs), num_columns)
    along = np.column_stack([-planes.normal[wall, 1], planes.normal[wall, 0]])
    order = np.lexsort(((place_m[own] * along).sum(axis=1), wall))
    wall, own = wall[order], own[order]
    start_m = place_m[own[np.searchsorted(wall, wall)]]
    end_m = place_m[own[np.searchsorted(wall, wall, "right") - 1]]
    across = (end_m - start_m)[:, ::-1] * [-1, 1]
    across /= np.maximum(np.hypot(*across.T), _EXACT_M)[:, None]
    off_m = ((start_m - place_m[own]) * across).sum(axis=1)
    is_off = np.zeros(num_columns, bool)
    is_off[own[np.abs(off_m) > _EXACT_M]] = True
    if not is_off.any():
        return mesh
    square, to_line_m = np.zeros((num_columns, 2, 2)), np.zeros((num_columns, 2))
    np.add.at(square, own, across[:, :, None] * across[:, None])
    np.add.at(to_line_m, own, off_m[:, None] * across)
    move_m = (np.linalg.pinv(square, _PARALLEL, hermitian=True) @ to_line_m[..., None])[..., 0]
    is_off &= np.hypot(*move_m.T) <= _MAX_BENT_M
    place_m[is_off] += move_m[is_off]
    return mesh.moved(np.column_stack([place_m[column], mesh.vertex_m[:, 2]]))


def _can_merge(mesh: Mesh, end: int, gone: int) -> bool:
    """Whether the mesh stays a manifold if the two ends of an edge become one vertex."""
    at_end, at_gone = (mesh.triangle == end).any(axis=1), (mesh.triangle == gone).any(axis=1)
    common = np.intersect1d(mesh.triangle[at_end], mesh.triangle[at_gone])
    return (at_end & at_gone).sum() == 2 and len(common) == 4


def _merged(mesh: Mesh, end: int, gone: int) -> Mesh:
    """The mesh after the ends of an edge have become one vertex."""
    has_both = (mesh.triangle == end).any(axis=1) & (mesh.triangle == gone).any(axis=1)
    triangle = np.where(mesh.triangle == gone, end, mesh.triangle)
    return replace(mesh, triangle=triangle).part(~has_both)


def _flipped(mesh: Mesh) -> Mesh:
    """The mesh in which those triangles without height whose corner is within the side opposite to it are gone: the
    triangle across the side has that corner, too, and is two."""
    for t in np.flatnonzero(_is_thin(mesh) & (mesh.edge_m.min(axis=1) > _NO_HEIGHT_M)).tolist():
        side = int(mesh.edge_m[t].argmax())
        start, _, corner = np.roll(mesh.triangle[t], -side)
        across, there = divmod(int(mesh.twin[t, side]), 3)
        end, _, far = np.roll(mesh.triangle[across], -there)
        triangle, like = mesh.triangle.copy(), np.arange(len(mesh.triangle))
        triangle[across], triangle[t], like[t] = (end, corner, far), (corner, start, far), across
        result = replace(mesh, triangle=triangle, kind=mesh.kind[like], label=mesh.label[like])
        if _is_thin(result).sum() < _is_thin(mesh).sum() and result.is_closed:
            return _flipped(result)
    return mesh


def _is_thin(mesh: Mesh) -> np.ndarray:
    """bool (t,): whether a triangle has no height."""
    return np.asarray(2 * mesh.area_m2 < _NO_HEIGHT_M * mesh.edge_m.max(axis=1))
