"""Short edges of a closed mesh, removed by small shifts of its roofs and inner walls.

Roofs that are fitted one by one end nearly, but not exactly, at the same places: eaves a few centimetres apart leave a
step between them, a cut beside a corner a narrow wall. An edge vanishes if the planes at both its ends meet in one
point. That is a linear condition on the shifts of the planes, so the smallest shifts that satisfy all conditions follow
from least squares. Slopes stay as they are, as do outer walls and the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from p2wss.fit.mesh.simplification import is_sound, simplified
from p2wss.mesh import Mesh
from p2wss.mesh.mesh import Planes
from p2wss.mesh.surface import topmost
from p2wss.mesh.topology import NEXT, doubled_areas, is_closed
from p2wss.skeleton.types import FaceKind

# no plane shifts by more than the first figure, and no vertex moves by more than the second
_MAX_SHIFT_M, _MAX_MOVE_M = 0.2, 0.6
# how heavily a square metre of a plane weighs without points, as a share of the points per square metre
_AREA_WEIGHT = 0.1
# a wall whose plane contains an edge of the footprint is an outer wall
_ON_WALL_M = 1e-3
# larger residuals count as this, as in the fit
CAP_M = 1.0
# a triangle that is turned over by no more than this, twice its area in square metres, has no area
_NO_AREA_M2 = 1e-6
# vertices nearer to each other are one
_SAME_PLACE_M = 1e-3
_RANK, _INCONSISTENT_M = 1e-6, 1e-6


def without_short_edges(
    mesh: Mesh, rings: Sequence[np.ndarray], point_m: np.ndarray, price_m: float, short_edge_m: float = 0.2
) -> Mesh:
    """The mesh without those edges shorter than ``short_edge_m`` whose removal adds little to the residuals of the
    points; the mesh itself if there are none. Edges are removed one after the other, the shortest first. Where the mesh
    without all of them would no longer be sound, the last ones stay.

    rings: of the footprint. point_m: (m, 3), on the roof. price_m: what an edge may add to the sum of the residuals.
    All are in the frame of the mesh.
    """
    edges = _short_edges(mesh, short_edge_m)
    if not edges:
        return mesh
    planes = mesh.planes
    shifts = _Shifts(planes, _is_free(planes, rings))
    residuals = _Residuals.of(mesh, point_m)
    if not len(residuals.plane):
        return mesh
    weight = residuals.weights(planes)
    cluster_of, num_removed = np.arange(len(mesh.vertex_m)), 0
    results: list[tuple[np.ndarray, np.ndarray]] = []
    for start, end in edges:
        if cluster_of[start] == cluster_of[end]:
            continue
        trial = np.where(cluster_of == cluster_of[end], cluster_of[start], cluster_of)
        clusters = _clusters(trial)
        shift_m = shifts.smallest(mesh.vertex_m, clusters, weight)
        if shift_m is None or np.abs(shift_m).max() > _MAX_SHIFT_M:
            continue
        if residuals.growth_m(planes, shift_m) > price_m * (num_removed + 1):
            continue
        moved_m = shifts.moved(mesh.vertex_m, clusters, shift_m)
        if np.linalg.norm(moved_m - mesh.vertex_m, axis=1).max() > _MAX_MOVE_M:
            continue
        triangle = _merged_triangles(mesh, moved_m, trial)
        if triangle is not None:
            cluster_of, num_removed = trial, num_removed + 1
            results.append((moved_m, triangle))
    was_sound = bool(results) and is_sound(mesh)
    for result in reversed(results):
        simple = simplified(*result)
        if simple is not None and simple.is_closed and (is_sound(simple) or not was_sound):
            return simple
    return mesh


def _clusters(cluster_of: np.ndarray) -> list[list[int]]:
    """The vertices of each cluster, from the number of the cluster of each vertex."""
    members: dict[int, list[int]] = {}
    for vertex, number in enumerate(cluster_of.tolist()):
        members.setdefault(number, []).append(vertex)
    return list(members.values())


def _short_edges(mesh: Mesh, short_edge_m: float) -> list[tuple[int, int]]:
    """(start, end) of the short edges between two planes, the shortest first."""
    start, end = mesh.triangle, mesh.triangle[:, NEXT]
    is_short = (mesh.edge_m < short_edge_m) & (start < end)
    if not is_short.any():
        return []
    is_short &= mesh.label[mesh.twin // 3] != mesh.label[:, None]
    order = np.argsort(mesh.edge_m[is_short], kind="stable")
    return list(zip(start[is_short][order].tolist(), end[is_short][order].tolist(), strict=True))


@dataclass(frozen=True)
class _Shifts:
    """Shifts of the planes of a mesh. is_free: (p,), which may shift. known: the conditions of clusters that were asked
    for."""

    planes: Planes
    is_free: np.ndarray
    known: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    def _meeting(self, vertex_m: np.ndarray, cluster: list[int]) -> tuple[list[int], np.ndarray, np.ndarray]:
        """(planes, normals (k, 3), distances (k,) of the planes from the first vertex) at a cluster of vertices."""
        planes = sorted(set().union(*(self.planes.at[v] for v in cluster)))
        on_plane = [next(v for v in cluster if plane in self.planes.at[v]) for plane in planes]
        normal = self.planes.normal[planes]
        return planes, normal, (normal * (vertex_m[on_plane] - vertex_m[cluster[0]])).sum(axis=1)

    def _conditions(self, vertex_m: np.ndarray, cluster: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """(rows (c, p), right sides (c,)): the linear conditions on the shifts for which the planes of a cluster meet
        in one point. Their offsets are then orthogonal to all dependences between their normals."""
        key = tuple(cluster)
        if key not in self.known:
            planes, normal, distance_m = self._meeting(vertex_m, cluster)
            vectors, size, _ = np.linalg.svd(normal)
            dependence = vectors[:, (size > _RANK).sum() :].T
            rows = np.zeros((len(dependence), len(self.planes.normal)))
            rows[:, planes] = dependence
            self.known[key] = rows, -dependence @ distance_m
        return self.known[key]

    def smallest(
        self, vertex_m: np.ndarray, clusters: list[list[int]], weight: np.ndarray
    ) -> np.ndarray | None:
        """The shifts (p,) along the normals with the smallest weighted sum of squares for which the planes of each
        cluster meet in one point; None if there are none."""
        found = [
            self._conditions(vertex_m, cluster)
            for cluster in clusters
            if len(cluster) > 1 or len(self.planes.at[cluster[0]]) > 3
        ]
        result = np.zeros(len(self.planes.normal))
        conditions = np.vstack([rows for rows, _ in found])
        right_side = np.concatenate([right for _, right in found])
        scale = 1.0 / np.sqrt(weight[self.is_free])
        result[self.is_free] = (
            scale * np.linalg.lstsq(conditions[:, self.is_free] * scale, right_side, 1e-8)[0]
        )
        is_consistent = np.abs(conditions @ result - right_side).max(initial=0.0) < _INCONSISTENT_M
        return result if is_consistent else None

    def moved(self, vertex_m: np.ndarray, clusters: list[list[int]], shift_m: np.ndarray) -> np.ndarray:
        """The vertices (v, 3) after the shifts: those of a cluster where its planes meet."""
        result = vertex_m.copy()
        shifted = set(np.flatnonzero(shift_m).tolist())
        single = []
        for cluster in clusters:
            if len(cluster) > 1:
                planes, normal, distance_m = self._meeting(vertex_m, cluster)
                place = np.linalg.lstsq(normal, distance_m + shift_m[planes], _RANK)[0]
                result[cluster] = vertex_m[cluster[0]] + place
            elif not shifted.isdisjoint(self.planes.at[cluster[0]]):
                single += cluster
        if single:
            at = self.planes.table(single)
            normals = np.where(at[..., None] >= 0, self.planes.normal[at], 0.0)
            distance_m = np.where(at >= 0, shift_m[at], 0.0)
            result[single] += (np.linalg.pinv(normals, _RANK) @ distance_m[..., None])[..., 0]
        return result


@dataclass(frozen=True)
class _Residuals:
    """The points that lie over a roof. plane: (m,), that of the topmost roof. residual_m: (m,), along its normal.
    points_per_m2: in plan."""

    plane: np.ndarray
    residual_m: np.ndarray
    points_per_m2: float

    @classmethod
    def of(cls, mesh: Mesh, point_m: np.ndarray) -> _Residuals:
        planes = mesh.planes
        is_up = planes.is_roof[planes.number]
        corner_m = np.ascontiguousarray(mesh.corner_m[is_up])
        triangle, roof_z = topmost(corner_m, np.ascontiguousarray(point_m, np.float64))
        is_over = triangle >= 0
        plane = planes.number[is_up][triangle[is_over]]
        residual_m = (roof_z - point_m[:, 2])[is_over] * planes.normal[plane, 2]
        return cls(
            plane,
            residual_m,
            len(plane) / float((planes.area_m2 * planes.normal[:, 2])[planes.is_roof].sum()),
        )

    def weights(self, planes: Planes) -> np.ndarray:
        """(p,): the number of points on each plane, and a little for its area."""
        count = np.bincount(self.plane, minlength=len(planes.normal))
        return count + _AREA_WEIGHT * self.points_per_m2 * planes.area_m2

    def growth_m(self, planes: Planes, shift_m: np.ndarray) -> float:
        """How much the sum of the residuals grows if planes shift. Beside a wall that moves, the roof is missing, or
        too much, over a strip."""
        before = np.minimum(np.abs(self.residual_m), CAP_M)
        after = np.minimum(np.abs(self.residual_m + shift_m[self.plane]), CAP_M)
        strip_m3 = float((planes.area_m2 * np.abs(shift_m))[planes.is_wall].sum())
        return float((after - before).sum()) + self.points_per_m2 * strip_m3


def _merged_triangles(mesh: Mesh, moved_m: np.ndarray, cluster_of: np.ndarray) -> np.ndarray | None:
    """The triangles (t, 3) after the vertices of each cluster, and others that moved to one place, have become one;
    None if a triangle turns over, or if the mesh is not closed."""
    first, index = np.unique(cluster_of, return_index=True, return_inverse=True)[1:]
    place_m = moved_m[first]
    near = np.linalg.norm(place_m[:, None] - place_m[None], axis=2) < _SAME_PLACE_M
    triangle = first[near.argmax(axis=1)][index][mesh.triangle]
    has_area = (triangle != triangle[:, NEXT]).all(axis=1)
    triangle = triangle[has_area]
    if _turned_over(moved_m, triangle, mesh.planes.normal[mesh.planes.number[has_area]]).any():
        return None
    return triangle if is_closed(moved_m, triangle) else None


def _is_free(planes: Planes, rings: Sequence[np.ndarray]) -> np.ndarray:
    """bool (p,): whether a plane is neither the floor nor an outer wall, over an edge of the footprint ``rings``."""
    start = np.concatenate(list(rings))
    end = np.concatenate([points for ring in rings for points in (ring[1:], ring[:1])])
    gap_m = np.maximum(*(np.abs(ends @ planes.normal[:, :2].T - planes.offset_m) for ends in (start, end)))
    is_outer = planes.is_wall & (gap_m.min(axis=0) < _ON_WALL_M)
    return ~is_outer & (planes.kind != FaceKind.GROUND)


def _turned_over(vertex_m: np.ndarray, triangle: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """bool (t,): which triangles (t, 3) face away from the normals (t, 3) of their planes."""
    return (doubled_areas(vertex_m[triangle]) * normal).sum(axis=1) < -_NO_AREA_M2
