"""Roofs that are exactly planes, without short edges: planes move by millimetres, and walls stay as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from p2wss.mesh.mesh import Mesh
from p2wss.mesh.topology import NEXT
from p2wss.skeleton.types import FaceKind

# corners nearer to all planes of their roofs are there; roofs that cannot be planes to the second figure stay as they
# are, as do those of which a corner would move further than the third
_EXACT_M, _PLANAR_M, _MAX_MOVE_M = 1e-6, 2e-4, 0.06
# nothing within a wall is further than this from its line; lines whose angle has no greater sine squared are parallel
_MAX_BENT_M, _PARALLEL = 5e-3, 1e-3
# ends of an edge that are nearer than this become one
SHORT_EDGE_M = 0.05
# a triangle of less height than this has no normal that survives the rounding of a file; one is turned over if twice
# its area is less than minus the second figure
_NO_HEIGHT_M, _NO_AREA_M2 = 1e-3, 1e-6
# how much more the heights that a slope of a level roof makes count than others; roofs narrower than the second share
# of their length have no slope across
_STIFF, _THIN = 100.0, 1e-12
# what is determined by less than this share of what determines best is not changed, if it need not be
_RANKS = (1e-2, 1e-3, 1e-6)


def with_exact_faces(mesh: Mesh, short_m: float = SHORT_EDGE_M) -> Mesh:
    """The mesh with straight walls (:func:`_with_straight_walls`) and planar roofs, as far as that is possible
    (:meth:`_Roofs.as_planes`), and without those edges shorter than ``short_m`` that can go, the shortest first.

    An edge goes if one of its ends can move to the other one along the walls that meet in it, the mesh stays a
    manifold, and its roofs can be planes again.
    """
    straight = _with_straight_walls(mesh)
    roofs = _Roofs(mesh)
    result: Mesh | None = roofs.as_planes(straight) or roofs.as_planes(mesh) or straight
    failed: set[bytes] = set()
    while result is not None:
        mesh, result = result, None
        edge_m = mesh.edge_m.ravel()
        rows = np.flatnonzero(edge_m < short_m)
        roofs = _Roofs(mesh) if len(rows) else roofs
        ends = np.column_stack([mesh.triangle.flat[rows], mesh.triangle[:, NEXT].flat[rows]])
        place = [each.tobytes() for each in mesh.vertex_m[ends, :2]]
        # those that could not go before others went are tried again at last
        for k in np.lexsort((edge_m[rows], np.array([each in failed for each in place]))).tolist():
            end, moved = ends[k].tolist()
            shorter = _merged(mesh, end, moved) if _can_move(mesh, end, moved) else None
            result = None if shorter is None else roofs.as_planes(shorter)
            if result is not None and _num_thin(result) > _num_thin(mesh):
                # the other end of a step that went
                result = with_exact_faces(result, _NO_HEIGHT_M)
                result = None if _num_thin(result) > _num_thin(mesh) else result
            if result is not None:
                break
            failed.add(place[k])
    return mesh


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
    number, corner = planes.number[:, None] * num_columns, column[mesh.triangle]
    wall, own = np.divmod(np.unique((number + corner)[planes.is_wall[planes.number]]), num_columns)
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


def _can_move(mesh: Mesh, end: int, moved: int) -> bool:
    """Whether all walls stay upright and in their planes if a vertex moves to another one."""
    planes = mesh.planes
    walls = [{plane for plane in planes.at[vertex] if planes.is_wall[plane]} for vertex in (moved, end)]
    return walls[0] <= walls[1] or bool((mesh.vertex_m[end, :2] == mesh.vertex_m[moved, :2]).all())


def _merged(mesh: Mesh, end: int, moved: int) -> Mesh | None:
    """The mesh after vertex ``moved`` has moved along an edge to ``end``; None if it would not be manifold."""
    triangle = mesh.triangle
    at_end, at_moved = (triangle == end).any(axis=1), (triangle == moved).any(axis=1)
    gone = at_end & at_moved
    common = np.intersect1d(triangle[at_end], triangle[at_moved])
    if gone.sum() != 2 or len(common) != 4:
        return None
    return replace(mesh, triangle=np.where(triangle == moved, end, triangle)).part(~gone)


def _num_thin(mesh: Mesh) -> int:
    """How many triangles have no height."""
    return int((2 * mesh.area_m2 < _NO_HEIGHT_M * mesh.edge_m.max(axis=1)).sum())


def _faults(mesh: Mesh) -> tuple[int, float]:
    """How many triangles are turned over, and how far corners of roofs are from their planes."""
    planes = mesh.planes
    normal = planes.normal[planes.number]
    is_turned = (mesh.doubled_m2 * normal).sum(axis=1) < -_NO_AREA_M2
    along_m = (mesh.corner_m * normal[:, None]).sum(axis=2)
    size = np.maximum(np.bincount(planes.number), 1)
    off_m = np.abs(along_m - (np.bincount(planes.number, along_m.mean(axis=1)) / size)[planes.number, None])
    return int(is_turned.sum()), float(off_m[planes.is_roof[planes.number]].max(initial=0.0))


def _corners(mesh: Mesh) -> np.ndarray:
    """int (2, n): the vertices of roofs, and the labels of these."""
    is_roof = (mesh.kind != FaceKind.WALL) & (mesh.kind != FaceKind.GROUND)
    vertex, size = mesh.triangle[is_roof].astype(np.int64), int(mesh.label.max(initial=0)) + 1
    return np.stack(np.divmod(np.unique(vertex * size + mesh.label[is_roof, None]), size))


def _places(from_middle_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(x, y and 1, heights) of points (n, 3)."""
    return np.column_stack([from_middle_m[:, :2], np.ones(len(from_middle_m))]), from_middle_m[:, 2]


class _Roofs:
    """The roofs of a mesh, and what a change of their planes costs."""

    def __init__(self, before: Mesh) -> None:
        vertex, label = _corners(before)
        self._labels, roof = np.unique(label, return_inverse=True)
        size = np.bincount(roof)
        self._middle_m = np.column_stack(
            [np.bincount(roof, before.vertex_m[vertex, axis]) / size for axis in range(3)]
        )
        place, height_m = _places(before.vertex_m[vertex] - self._middle_m[roof])
        square, to_height = np.zeros((len(size), 3, 3)), np.zeros((len(size), 3, 1))
        np.add.at(square, roof, place[:, :, None] * place[:, None])
        np.add.at(to_height, roof, (place * height_m[:, None])[..., None])
        self._coefficient = (np.linalg.pinv(square, _THIN, hermitian=True) @ to_height)[..., 0]
        # so scaled, a change of coefficients is as long as that of the heights of the vertices; level roofs stay level
        stiff = np.ones((len(size), 3))
        kind = before.planes.kind[np.searchsorted(np.unique(before.label), self._labels)]
        stiff[kind == FaceKind.FLAT, :2] = _STIFF
        length, axes = np.linalg.eigh(square * stiff[:, None] * stiff[..., None])
        self._scale = axes / np.sqrt(np.maximum(length, _EXACT_M))[:, None]
        self._most_turned, self._most_off_m = _faults(before)

    def as_planes(self, mesh: Mesh) -> Mesh | None:
        """The mesh whose roofs are planes, after the smallest change of their heights that does so; None if no change
        of centimetres makes them so, or at least as planar as those of the mesh before. mesh: with the same labels.

        Vertices keep their place in plan, so walls stay as they are. Where several roofs meet, their planes must have
        one height: that is linear in the coefficients of the planes, whose change follows from least squares.
        """
        vertex, label = _corners(mesh)
        roof = np.searchsorted(self._labels, label)
        place, height_m = _places(mesh.vertex_m[vertex] - self._middle_m[roof])
        fitted_m = (place * self._coefficient[roof]).sum(axis=1)
        if np.abs(fitted_m - height_m).max(initial=0.0) < _EXACT_M:
            return mesh
        scaled = (place[:, None] @ self._scale[roof])[:, 0]
        # each roof at a vertex but the first has its height there
        is_next = np.flatnonzero(np.diff(vertex, prepend=-1) == 0)
        condition = np.zeros((len(is_next), len(self._labels), 3))
        condition[np.arange(len(is_next)), roof[is_next]] = scaled[is_next]
        condition[np.arange(len(is_next)), roof[is_next - 1]] = -scaled[is_next - 1]
        fitted_m += self._middle_m[roof, 2]
        wrong_m = fitted_m[is_next - 1] - fitted_m[is_next]
        of_condition, value, of_change = np.linalg.svd(
            condition.reshape(len(is_next), 3 * len(self._labels)), full_matrices=False
        )
        for rank in _RANKS:
            used = value > rank * value.max(initial=0.0)
            change = (of_condition.T @ wrong_m)[used] / value[used] @ of_change[used]
            vertex_m = mesh.vertex_m.copy()
            vertex_m[vertex, 2] = fitted_m + (scaled * change.reshape(-1, 3)[roof]).sum(axis=1)
            moved = mesh.moved(vertex_m)
            num_turned, off_m = _faults(moved)
            is_far = np.abs(vertex_m - mesh.vertex_m).max() > _MAX_MOVE_M
            if num_turned <= self._most_turned and off_m <= max(self._most_off_m, _PLANAR_M) and not is_far:
                return moved
        return None
