"""The planes of a roof adjusted to its points by least squares, without any more vertices.

The search gives all edges that face the same way one slope, and every eave is level and parallel to a wall of the
footprint. Real roofs are not so exact: footprints are askew, ridges lean, eaves sink. So in the end each plane of the
roof may tilt and shift a little, level ones only shift, and the vertices move to where the planes meet. Before that,
walls between roofs shift to where the points show the step. Faces, edges and outer walls stay as they are.

Where more than three planes meet, they have to go on meeting. To first order, that is a linear condition on their tilts
and shifts, as are the moves of the vertices. So each round solves one linear system, in which large residuals weigh
less (iteratively reweighted least squares).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.mesh import Planes
from p2wss.mesh.surface import topmost
from p2wss.mesh.topology import doubled_areas, is_closed
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.types import FaceKind

# of the first try, and of those after it
_NUM_ROUNDS = (3, *7 * (2,))
# residuals below the first figure have full weight, those above the second one none
_NOISE_M, _OUTLIER_M = 0.03, 0.5
# How heavily the place of a vertex weighs against a point with full weight. Without this, planes that are nearly
# parallel would meet far away. Vertices at which the adjusted mesh is not valid get a multiple of it in the next try.
_VERTEX_WEIGHT, _STIFFENING = 0.1, 5.0
# an adjusted mesh has to gain this in the mean of the residuals
_MIN_GAIN_M = 0.001
# a wall between two roofs moves by one of the first if that gains the second in the mean of the residuals
_WALL_SHIFTS_M, _MIN_WALL_GAIN_M = (0.1, -0.1, 0.25, -0.25), 0.0005
# Time and memory grow with the cube of these: roofs of a mesh, and planes that meet at one vertex, as over a round
# tower. Meshes with more stay as they are. Walls stay where they would take more tests of points against triangles.
_MAX_NUM_ROOFS, _MAX_NUM_MEETING, _MAX_WALL_TESTS = 100, 16, 50_000_000
# no vertex moves by more than the first figure, and no plane turns by more than the second
_MAX_MOVE_M, _MAX_TURN_DEG = 0.6, 8.0
# vertices are in their planes up to this, and to how far they were off them before
_OFF_PLANE_M = 1e-4
# the condition that planes meet, and parameters that nothing determines, by their weights
_MEET_WEIGHT, _KEEP_WEIGHT = 3e5, 3e-5
# a wall whose plane contains an edge of the footprint is an outer wall
_ON_WALL_M = 1e-3
# larger residuals count as this, as in the fit
CAP_M = 1.0
# a triangle that is turned over by no more than this, twice its area in square metres, has no area
_NO_AREA_M2 = 1e-6
# smaller singular values of the normals at a vertex, relative to the largest, count as zero
_RANK = 1e-3


def adjusted(mesh: Mesh, rings: Sequence[np.ndarray], point_m: np.ndarray) -> Mesh:
    """The mesh with planes that are nearer to the points, the mesh itself if that gains little or is not possible.

    rings: of the footprint, whose walls stay. point_m: (m, 3), on the roof. All are in the frame of the mesh.
    """
    point_m = np.ascontiguousarray(point_m, np.float64)
    system = _System.of(mesh, rings, point_m)
    if not 0 < len(system.roofs) <= _MAX_NUM_ROOFS or system.at.shape[1] > _MAX_NUM_MEETING:
        return mesh
    start = system.start()
    if (start.top < 0).all():
        return mesh
    start = system.with_shifted_walls(start)
    shifted = mesh if start.vertex_m is mesh.vertex_m else mesh.moved(start.vertex_m)
    system = replace(system, mesh=shifted)
    max_loss_m = start.loss_m - _MIN_GAIN_M * len(point_m)
    vertex_weight = np.full(len(system.moving), _VERTEX_WEIGHT)
    state = start
    for num_rounds in _NUM_ROUNDS:
        for _ in range(num_rounds):
            state = system.improved(state, vertex_weight)
        is_invalid = system.is_invalid(state, start)
        if not is_invalid.any():
            return mesh.moved(state.vertex_m) if state.loss_m <= max_loss_m else shifted
        vertex_weight[is_invalid] *= _STIFFENING
    return shifted


@dataclass(frozen=True)
class _State:
    """One position of the planes. normal: (p, 3). offset_m: (p,). vertex_m: (v, 3). normals: (n, k, 3), of the planes
    at the vertices that may move, and their pseudo-inverses (n, 3, k). top: (m,), the number of the topmost triangle of
    a roof over or below each point, -1 for none. above_m: (m,), how high the points are above it, infinite without one.
    loss_m: the sum of the residuals."""

    normal: np.ndarray
    offset_m: np.ndarray
    vertex_m: np.ndarray
    normals: np.ndarray
    inverse: np.ndarray
    top: np.ndarray
    above_m: np.ndarray
    loss_m: float


@dataclass(frozen=True)
class _System:
    """What all rounds have in common. The unknowns of a roof are the height of its plane at its centre and its slopes
    along x and y.

    point_m: (m, 3). roofs: (r,), the planes that may move. roof_of: (p,), the number of each plane in roofs, -1 for
    others. walls: those that may move. centre_m: (p, 2). is_free: (3 r,), which unknowns there are. moving: (n,), the
    vertices of roofs. at: (n, k), the planes of each of these vertices, -1 beyond the last. pairs: (rows of at, places
    there, roofs), one for each roof at each of them.
    """

    mesh: Mesh
    planes: Planes
    point_m: np.ndarray
    roofs: np.ndarray
    roof_of: np.ndarray
    walls: list[int]
    centre_m: np.ndarray
    is_free: np.ndarray
    moving: np.ndarray
    at: np.ndarray
    pairs: tuple[np.ndarray, np.ndarray, np.ndarray]

    @classmethod
    def of(cls, mesh: Mesh, rings: Sequence[np.ndarray], point_m: np.ndarray) -> _System:
        planes = mesh.planes
        # a plane without area faces nowhere, whatever its kind
        has_kind = (planes.kind == FaceKind.ROOF) | (planes.kind == FaceKind.FLAT)
        roofs = np.flatnonzero(has_kind & planes.is_roof)
        walls = np.flatnonzero(is_free(planes, rings) & planes.is_wall).tolist()
        roof_of = np.full(len(planes.normal), -1)
        roof_of[roofs] = np.arange(len(roofs))
        middle_m = mesh.corner_m.mean(axis=1)
        count = np.bincount(planes.number)
        centre_m = np.column_stack([np.bincount(planes.number, middle_m[:, k]) / count for k in range(2)])
        has_unknown = np.ones((len(roofs), 3), bool)
        has_unknown[planes.kind[roofs] == FaceKind.FLAT, 1:] = False
        moving = np.unique(mesh.triangle[roof_of[planes.number] >= 0])
        at = planes.table(moving.tolist())
        rows, places = np.nonzero((at >= 0) & (roof_of[at] >= 0))
        pairs = rows, places, roof_of[at[rows, places]]
        unknown = has_unknown.ravel()
        return cls(mesh, planes, point_m, roofs, roof_of, walls, centre_m, unknown, moving, at, pairs)

    @cached_property
    def _roof_triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """(triangles (t, 3) of the roofs that may move, their planes (t,))."""
        is_roof = self.roof_of[self.planes.number] >= 0
        return self.mesh.triangle[is_roof], self.planes.number[is_roof]

    def start(self) -> _State:
        """The mesh as it is."""
        normals = self._normals(self.planes.normal)
        inverse = _pseudo_inverse(normals)
        return self._state(self.planes.normal, self.planes.offset_m, self.mesh.vertex_m, normals, inverse)

    def _state(
        self,
        normal: np.ndarray,
        offset_m: np.ndarray,
        vertex_m: np.ndarray,
        normals: np.ndarray,
        inverse: np.ndarray,
    ) -> _State:
        triangle, plane = self._roof_triangles
        top, roof_z = topmost(vertex_m[triangle], self.point_m)
        above_m = self.point_m[:, 2] - roof_z
        loss_m = float(np.minimum(np.abs(above_m) * normal[plane, 2][top], CAP_M).sum())
        return _State(normal, offset_m, vertex_m, normals, inverse, top, above_m, loss_m)

    def with_shifted_walls(self, state: _State) -> _State:
        """The state after each wall between roofs has moved to where the points show the step, if that gains enough and
        no roof has to follow."""
        start = state
        if len(self.walls) * len(self.mesh.triangle) * len(self.point_m) > _MAX_WALL_TESTS:
            return state
        for wall in self.walls:
            rows, places = np.nonzero(self.at == wall)
            # the moves of its vertices for a metre, and by how much these would miss the other planes there
            move_m = state.inverse[rows, :, places]
            miss_m = (state.normals[rows] @ move_m[..., None])[..., 0]
            miss_m[np.arange(len(rows)), places] -= 1.0
            if np.abs(miss_m).max(initial=0.0) > _OFF_PLANE_M:
                continue
            best = state
            for shift_m in _WALL_SHIFTS_M:
                offset_m, vertex_m = state.offset_m.copy(), state.vertex_m.copy()
                offset_m[wall] += shift_m
                vertex_m[self.moving[rows]] += shift_m * move_m
                trial = self._state(state.normal, offset_m, vertex_m, state.normals, state.inverse)
                is_better = trial.loss_m < best.loss_m - _MIN_WALL_GAIN_M * len(self.point_m)
                if is_better and not self.is_invalid(trial, start).any():
                    best = trial
            state = best
        return state

    def improved(self, state: _State, vertex_weight: np.ndarray) -> _State:
        """The state after one round. vertex_weight: (n,), of the vertices that may move."""
        num = len(self.roofs)
        matrix, right_side = self._point_equations(state)
        for rows, distance_m, weight in self._vertex_equations(state, vertex_weight):
            weighted = rows.T * weight
            matrix += weighted @ rows
            right_side += weighted @ distance_m
        matrix.flat[:: 3 * num + 1] += _KEEP_WEIGHT / _NOISE_M
        step, free = np.zeros(3 * num), np.flatnonzero(self.is_free)
        step[free] = np.linalg.solve(matrix[free[:, None], free], right_side[free])
        rise_m, turn = step[::3], step.reshape(num, 3)[:, 1:]
        normal, offset_m, centre_m = state.normal.copy(), state.offset_m.copy(), self.centre_m[self.roofs]
        up = normal[self.roofs]
        height_m = (offset_m[self.roofs] - (up[:, :2] * centre_m).sum(axis=1)) / up[:, 2] + rise_m
        up = np.column_stack([up[:, :2] / up[:, 2:] - turn, np.ones(num)])
        up /= np.linalg.norm(up, axis=1)[:, None]
        normal[self.roofs] = up
        offset_m[self.roofs] = (up[:, :2] * centre_m).sum(axis=1) + up[:, 2] * height_m
        vertex_m, normals = state.vertex_m.copy(), self._normals(normal)
        inverse = _pseudo_inverse(normals)
        gap_m = self._gap_m(normals, offset_m, vertex_m)
        vertex_m[self.moving] += (inverse @ gap_m[..., None])[..., 0]
        return self._state(normal, offset_m, vertex_m, normals, inverse)

    def is_invalid(self, state: _State, start: _State) -> np.ndarray:
        """bool (n,): the vertices that may move at which the mesh is not one any more, or not close to what it was at
        the start; all of them if it is not closed."""
        triangle, number = self.mesh.triangle, self.planes.number
        is_invalid = np.linalg.norm(state.vertex_m - start.vertex_m, axis=1) > _MAX_MOVE_M
        turn_cos = (state.normal * start.normal).sum(axis=1)
        is_wrong = turned_over(state.vertex_m, triangle, state.normal[number])
        is_wrong |= turn_cos[number] < np.cos(np.radians(_MAX_TURN_DEG))
        is_invalid[triangle[is_wrong]] = True
        is_invalid[triangle[self._off_plane_m(state) > self._off_plane_m(start) + _OFF_PLANE_M]] = True
        if not is_invalid.any() and is_closed(state.vertex_m, triangle):
            return np.zeros(len(self.moving), bool)
        return is_invalid[self.moving] | ~is_invalid[self.moving].any()

    def _off_plane_m(self, state: _State) -> np.ndarray:
        """float64 (t, 3), how far the vertices are off the planes of their triangles."""
        number = self.planes.number
        height_m = (state.vertex_m[self.mesh.triangle] * state.normal[number, None]).sum(axis=2)
        return np.abs(height_m - state.offset_m[number, None])

    def _point_equations(self, state: _State) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (3 r, 3 r) and right side (3 r,) of the weighted least squares over the points."""
        num = len(self.roofs)
        plane = self._roof_triangles[1]
        roof = self.roof_of[plane]
        sums = _sums_of_points(
            self.point_m, state.above_m, state.top, roof, state.normal[plane, 2], self.centre_m[plane], num
        )
        matrix, roofs = np.zeros((num, 3, num, 3)), np.arange(num)
        matrix[roofs, :, roofs, :] = sums[:, :, :3]
        return matrix.reshape(3 * num, 3 * num), sums[:, :, 3].ravel()

    def _vertex_equations(
        self, state: _State, vertex_weight: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray | float]]:
        """(rows (k, 3 r), right sides (k,), weights (k,)) of the equations by which vertices stay at their first places
        and by which planes meet at vertices with more than three."""
        (rows, places, roofs), (num_vertices, num_at) = self.pairs, self.at.shape
        plane, vertices = self.roofs[roofs], self.moving[rows]
        # how far a plane moves along its normal at a vertex, for a unit of each unknown
        lever = np.column_stack([np.ones(len(plane)), state.vertex_m[vertices, :2] - self.centre_m[plane]])
        lever *= state.normal[plane, 2, None]
        by_roof = np.zeros((num_vertices, num_at, len(self.roofs), 3))
        by_roof[rows, places, roofs] = lever
        shift = by_roof.reshape(num_vertices, num_at, -1)
        back_m = (self.mesh.vertex_m - state.vertex_m)[self.moving].ravel()
        result: list[tuple[np.ndarray, np.ndarray, np.ndarray | float]] = [
            ((state.inverse @ shift).reshape(len(back_m), -1), back_m, np.repeat(vertex_weight, 3) / _NOISE_M)
        ]
        many = np.flatnonzero((self.at >= 0).sum(axis=1) > 3)
        if len(many):
            # the part of the shifts that no move of the vertex explains
            rest = np.eye(num_at) - state.normals[many] @ state.inverse[many]
            gap_m = self._gap_m(state.normals, state.offset_m, state.vertex_m)[many]
            unexplained = (rest @ shift[many]).reshape(-1, shift.shape[2])
            result.append((unexplained, -(rest @ gap_m[..., None]).ravel(), _MEET_WEIGHT / _NOISE_M))
        return result

    def _normals(self, normal: np.ndarray) -> np.ndarray:
        """(n, k, 3), those of the planes at the vertices that may move; 0 beyond the last."""
        return np.where((self.at >= 0)[..., None], normal[self.at], 0.0)

    def _gap_m(self, normals: np.ndarray, offset_m: np.ndarray, vertex_m: np.ndarray) -> np.ndarray:
        """(n, k), how far the planes are from the vertices that may move; 0 beyond the last."""
        height_m = (normals * vertex_m[self.moving, None]).sum(axis=2)
        return np.where(self.at >= 0, offset_m[self.at] - height_m, 0.0)


def is_free(planes: Planes, rings: Sequence[np.ndarray]) -> np.ndarray:
    """bool (p,): whether a plane is neither the floor nor an outer wall, over an edge of the footprint ``rings``."""
    start = np.concatenate(list(rings))
    end = np.concatenate([points for ring in rings for points in (ring[1:], ring[:1])])
    gap_m = np.maximum(*(np.abs(ends @ planes.normal[:, :2].T - planes.offset_m) for ends in (start, end)))
    is_outer = planes.is_wall & (gap_m.min(axis=0) < _ON_WALL_M)
    return ~is_outer & (planes.kind != FaceKind.GROUND)


def turned_over(vertex_m: np.ndarray, triangle: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """bool (t,): which triangles (t, 3) face away from the normals (t, 3) of their planes."""
    return (doubled_areas(vertex_m[triangle]) * normal).sum(axis=1) < -_NO_AREA_M2


def _pseudo_inverse(matrix: np.ndarray) -> np.ndarray:
    """(n, 3, k), the pseudo-inverses of matrices (n, k, 3)."""
    # numpy's own function takes twice as long for so few columns
    transposed = matrix.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(transposed @ matrix)
    is_zero = values <= _RANK**2 * values[:, -1:]
    inverse = np.where(is_zero, 0.0, 1 / np.where(is_zero, 1.0, values))
    return (vectors * inverse[:, None]) @ vectors.transpose(0, 2, 1) @ transposed


@entry
def _sums_of_points(point_m, above_m, top, roof, slant, centre_m, num_roofs):
    """float64 (num_roofs, 3, 4): matrix and right side of the weighted least squares over the points (m, 3) of each
    roof. above_m, top: (m,), as in a state. roof, slant, centre_m: of each triangle, the number of its roof, z of its
    normal, and the centre (2,) of its plane."""
    result, lever = np.zeros((num_roofs, 3, 4)), np.ones(3)
    for k in range(len(point_m)):
        t = top[k]
        if t < 0 or abs(above_m[k]) * slant[t] > _OUTLIER_M:
            continue
        weight = slant[t] * slant[t] / max(abs(above_m[k]) * slant[t], _NOISE_M)
        for axis in range(2):
            lever[1 + axis] = point_m[k, axis] - centre_m[t, axis]
        sums = result[roof[t]]
        for i in range(3):
            for j in range(3):
                sums[i, j] += weight * lever[i] * lever[j]
            sums[i, 3] += weight * lever[i] * above_m[k]
    return result
