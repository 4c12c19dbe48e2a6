"""Planes of a mesh moved by as little as possible, so that those at a place meet in one point."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from p2wss.mesh.mesh import Mesh
from p2wss.skeleton.groups import groups
from p2wss.skeleton.types import FaceKind

# what moves by less than this stays, to the bit
_EXACT_M = 1e-6
# how much more the heights that a slope of a level roof makes count than others; roofs narrower than the second share
# of their length have no slope across
_STIFF, _THIN = 100.0, 1e-12
# planes that meet in a line this nearly leave their point where it is along the line
_RANK = 1e-2
# changes of planes that move no vertex by more than the square root of this share of themselves are not made
_NO_CHANGE = 1e-10
_NUM_ROUNDS = 4
# so many planes and places that depend on each other are solved for together
_TOGETHER = 200
# a triangle is turned over if twice its area along its former normal is less than minus this
_NO_AREA_M2 = 1e-6


class _Equations(NamedTuple):
    """Of p planes: row (p, 3), base (p, 3) and scale (p, 3, 3).

    Those points are on a plane whose distance from its base point has no product with the row. For roofs, the row is
    the slopes and -1, for others the normal. A change of a plane, times the scale, is one of the slopes and the offset;
    so scaled, it is as long as that of its vertices' heights.
    """

    row: np.ndarray
    base: np.ndarray
    scale: np.ndarray


def with_meeting_planes(
    mesh: Mesh,
    place: np.ndarray,
    more: Collection[tuple[int, int]] = (),
    free: Collection[int] = (),
) -> tuple[Mesh, np.ndarray]:
    """(the mesh after the smallest change of its planes for which those at each place meet in one point, how far the
    planes of each vertex are from it, (v,), where they cannot).

    place: int (v,): vertices of one number become one point. more: (vertex, plane of ``mesh.planes``), further planes
    through the places of vertices. Roofs may tilt, walls between roofs shift; floors and the walls on them stay, but
    for those planes that are ``free`` to shift, too. Conditions are linear in the changes of the planes while vertices
    stay; as they follow their planes, the least squares are solved a few times.
    """
    planes = mesh.planes
    num = len(planes.kind)
    corner = np.column_stack(np.divmod(np.unique(mesh.triangle * num + planes.number[:, None]), num))
    equations = _equations(mesh, corner, free)
    _, place = np.unique(place, return_inverse=True)
    pairs = np.concatenate([corner, np.array(list(more), int).reshape(-1, 2)])
    at, plane = np.divmod(np.unique(place[pairs[:, 0]] * num + pairs[:, 1]), num)
    # any vertex of a place tells where its planes are, as they are linear
    first = np.unique(place, return_index=True)[1]
    vertex_m = mesh.vertex_m[first]
    count = np.bincount(at)
    slot = np.arange(len(at)) - (np.cumsum(count) - count)[at]
    size = len(first), count.max()
    is_there = np.zeros(size, bool)
    is_there[at, slot] = True
    of_slot = np.zeros(size, int)
    of_slot[at, slot] = plane
    moves = np.asarray(equations.scale.any(axis=(1, 2)))
    change = np.zeros((num, 3))
    normal, off_m, _ = _at_places(equations, change, vertex_m, of_slot, is_there)
    is_off = np.abs(off_m).max(axis=1) >= _EXACT_M
    if is_off.any():
        # places where planes depend on each other, as more meet than a point needs
        rank = np.einsum("nij,nji->n", normal, np.linalg.pinv(normal, _RANK))
        is_linked = is_there & moves[of_slot] & (is_off | (count - rank > 0.5))[:, None]
        at, slot = np.nonzero(is_linked)
        part = groups(num + len(first), np.column_stack([of_slot[at, slot], num + at]))
        parts, size_of = np.unique(part, return_counts=True)
        is_wrong = np.isin(parts, part[num:][is_off])
        together = np.where(is_wrong, np.cumsum(size_of * is_wrong) // _TOGETHER, -1)[part]
        for number in np.unique(together[together >= 0]):
            is_own = moves & (together[:num] == number)
            is_here = (is_own[of_slot] & is_there).any(axis=1) | (together[num:] == number)
            places = vertex_m[is_here], of_slot[is_here], is_there[is_here]
            vertex_m[is_here] = _met(equations, change, is_own, *places)
        off_m = _at_places(equations, change, vertex_m, of_slot, is_there)[1]
    apart_m = np.abs(off_m).max(axis=1)
    moved_m = vertex_m[place]
    stays = np.abs(moved_m - mesh.vertex_m) < _EXACT_M
    moved = mesh if stays.all() else mesh.moved(np.where(stays, mesh.vertex_m, moved_m))
    return moved, apart_m[place]


def _met(
    equations: _Equations,
    change: np.ndarray,
    moves: np.ndarray,
    vertex_m: np.ndarray,
    of_slot: np.ndarray,
    is_there: np.ndarray,
) -> np.ndarray:
    """Where the planes at places meet, (n, 3), after the least changes of those that move, which are put in place."""
    # planes that stay have no lever here, so the number of their unknowns does not matter; 0 is that of none
    num, unknown = moves.sum() + 1, np.cumsum(moves)[of_slot]
    for _ in range(_NUM_ROUNDS):
        normal, off_m, lever = _at_places(equations, change, vertex_m, of_slot, is_there)
        if np.abs(off_m).max() < _EXACT_M:
            break
        # what is left of the distances of planes from a point wherever it is
        apart = np.eye(normal.shape[1]) - normal @ np.linalg.pinv(normal, _RANK)
        lever = lever * moves[of_slot][..., None]
        square, right = np.zeros((num, num, 3, 3)), np.zeros((num, 3))
        blocks = apart[..., None, None] * lever[:, :, None, :, None] * lever[:, None, :, None, :]
        np.add.at(square, (unknown[:, :, None], unknown[:, None]), blocks)
        np.add.at(right, unknown, (apart @ off_m[..., None]) * lever)
        matrix = square.transpose(0, 2, 1, 3).reshape(3 * num, 3 * num) + _NO_CHANGE * np.eye(3 * num)
        change[moves] -= np.linalg.solve(matrix, right.ravel()).reshape(num, 3)[1:]
        normal, off_m, _ = _at_places(equations, change, vertex_m, of_slot, is_there)
        vertex_m = vertex_m - (np.linalg.pinv(normal, _RANK) @ off_m[..., None])[..., 0]
    return vertex_m


def turned_over(mesh: Mesh, before: Mesh) -> np.ndarray:
    """bool (t,): which triangles of a mesh face the other way than the planes that they had before."""
    normal = before.planes.normal[before.planes.number]
    return np.asarray((mesh.doubled_m2 * normal).sum(axis=1) < -_NO_AREA_M2)


def _equations(mesh: Mesh, corner: np.ndarray, free: Collection[int]) -> _Equations:
    """The equations of the planes of a mesh. corner: (n, 2), vertices and their planes. free: planes that may shift
    though they are walls on floors."""
    planes = mesh.planes
    vertex, plane = corner.T
    size = np.bincount(plane)
    base = np.column_stack([np.bincount(plane, mesh.vertex_m[vertex, k]) / size for k in range(3)])
    from_base = mesh.vertex_m[vertex] - base[plane]
    lever = np.column_stack([from_base[:, :2], np.ones(len(vertex))])
    square, to_height = np.zeros((len(size), 3, 3)), np.zeros((len(size), 3, 1))
    np.add.at(square, plane, lever[:, :, None] * lever[:, None])
    np.add.at(to_height, plane, (lever * from_base[:, 2:])[..., None])
    row = planes.normal.copy()
    is_roof = (planes.kind != FaceKind.WALL) & (planes.kind != FaceKind.GROUND)
    stiff = np.ones((len(size), 3))
    stiff[planes.kind == FaceKind.FLAT, :2] = _STIFF
    length, axes = np.linalg.eigh(square * stiff[:, None] * stiff[..., None])
    # the least squares of all planes; numpy's own inverses take several times as long for a few of three rows
    inverse = np.where(length > _THIN * length[:, 2:], 1 / np.maximum(length, 1e-300), 0.0)
    fitted = axes @ (inverse[..., None] * (axes.transpose(0, 2, 1) @ (stiff[..., None] * to_height)))
    row[is_roof] = np.column_stack([(stiff * fitted[..., 0])[:, :2], np.full(len(size), -1)])[is_roof]
    scale = axes / np.sqrt(np.maximum(length, _EXACT_M))[:, None]
    # walls shift only, unless they stand on a floor
    on_floor, stays = np.zeros(len(mesh.vertex_m), bool), np.zeros(len(size), bool)
    on_floor[vertex[planes.kind[plane] == FaceKind.GROUND]] = True
    stays[plane[on_floor[vertex]]] = True
    stays[list(free)] = False
    stays[planes.kind == FaceKind.GROUND] = True
    scale[~is_roof] = 0
    scale[~is_roof, 2, 2] = np.where(stays, 0, 1 / np.sqrt(size))[~is_roof]
    return _Equations(row, base, scale)


def _at_places(
    equations: _Equations,
    change: np.ndarray,
    vertex_m: np.ndarray,
    of_slot: np.ndarray,
    is_there: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(rows (n, k, 3) of the planes at places, how far each plane is from its place, and how much further by a change
    of the plane (n, k, 3))."""
    row, base, scale = equations
    tilt = (scale @ change[..., None])[..., 0]
    from_base = vertex_m[:, None] - base[of_slot]
    lever = np.concatenate([from_base[..., :2], np.ones((*of_slot.shape, 1))], axis=2)
    normal = row + np.column_stack([tilt[:, :2], np.zeros(len(tilt))])
    off_m = (normal[of_slot] * from_base).sum(axis=2) + tilt[of_slot, 2]
    mask = is_there[..., None]
    return normal[of_slot] * mask, off_m * is_there, (lever[:, :, None] @ scale[of_slot])[:, :, 0] * mask
