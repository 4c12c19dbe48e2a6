"""Metrics, on arrays: false and missing edges of roofs, heights of points above a mesh, facts of a mesh by itself, and
the Chamfer distance between two point sets, the CD of Table 2 (section 5.3 of the paper)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from p2wss.mesh import Mesh
from p2wss.mesh.rules import shell_code
from p2wss.mesh.surface import topmost
from p2wss.mesh.topology import NEXT, unit_normals

# the rule of ISO 19107 that a manifold of several bodies breaks
_SEVERAL_PARTS = 305
# an edge counts as true within this distance of a true edge
NEAR_M = 0.5
SPACING_M = 0.1
# vertices on one cell of this grid are one corner; vertical part of the normal of a wall
_WELD_M, _WALL_NZ = 0.05, 0.05


class MeshFacts(NamedTuple):
    """watertight: every edge has two triangles. manifold: moreover, the two triangles run along the edge in opposite
    directions, and the triangles at each vertex form one fan."""

    watertight: bool
    manifold: bool


@dataclass(frozen=True)
class RoofEdges:
    """The edges around the roof faces of a mesh. corner_m: (c, 3). edge: int (e, 2), corners. side: int (e,), a side of
    a triangle on each edge; triangle t has the sides 3 t to 3 t + 2."""

    corner_m: np.ndarray
    edge: np.ndarray
    side: np.ndarray

    @property
    def sample_m(self) -> tuple[np.ndarray, np.ndarray]:
        """(places (s, 3) every 0.1 m along the edges, the edge of each)."""
        start, end = self.corner_m[self.edge[:, 0]], self.corner_m[self.edge[:, 1]]
        num = np.maximum(np.linalg.norm(end - start, axis=1) / SPACING_M, 1).astype(int)
        of_edge = np.repeat(np.arange(len(num)), num)
        share = (np.arange(num.sum()) - np.repeat(np.cumsum(num) - num, num) + 0.5) / num[of_edge]
        return start[of_edge] + (end - start)[of_edge] * share[:, None], of_edge


def roof_edges(mesh: Mesh) -> RoofEdges:
    """The sides that roof faces do not share with a triangle of their own plane; corners within 5 cm are one."""
    own, other = np.repeat(np.arange(len(mesh.triangle)), 3), mesh.twin.ravel() // 3
    is_roof = unit_normals(mesh.corner_m)[:, 2] > _WALL_NZ
    side = np.flatnonzero(is_roof[own] & (mesh.label[own] != mesh.label[other]))
    vertex = np.stack([mesh.triangle, mesh.triangle[:, NEXT]], axis=-1).reshape(-1, 2)[side]
    cell, corner = np.unique(np.round(mesh.vertex_m / _WELD_M).astype(int), axis=0, return_inverse=True)
    corner = corner.ravel()
    edge = np.sort(corner[vertex], axis=1)
    is_long = edge[:, 0] != edge[:, 1]
    edge, first = np.unique(edge[is_long], axis=0, return_index=True)
    used, edge = np.unique(edge, return_inverse=True)
    on_roof = np.unique(mesh.triangle[is_roof])
    num = np.maximum(np.bincount(corner[on_roof], minlength=len(cell)), 1)
    corner_m = np.column_stack(
        [np.bincount(corner[on_roof], mesh.vertex_m[on_roof, k], len(cell)) / num for k in range(3)]
    )
    return RoofEdges(corner_m[used], edge.reshape(-1, 2), side[is_long][first])


def far_samples(found: RoofEdges, true: RoofEdges) -> tuple[np.ndarray, np.ndarray]:
    """Two masks, (s,) and (t,): the samples of the found edges more than 0.5 m from all true samples (false edges), and
    the samples of the true edges more than 0.5 m from all found samples (missing edges). Distances are in space."""
    found_m, true_m = found.sample_m[0], true.sample_m[0]
    return _are_far(found_m, true_m), _are_far(true_m, found_m)


def _are_far(one_m: np.ndarray, other_m: np.ndarray) -> np.ndarray:
    if not len(other_m):
        return np.ones(len(one_m), bool)
    return np.asarray(cKDTree(other_m).query(one_m)[0] > NEAR_M)


def false_and_missing_share(found: Mesh, true: Mesh) -> tuple[float, float]:
    """(share of the found roof edges, by length, that are more than 0.5 m from any true edge; share of the true edges
    that are more than 0.5 m from any found edge)."""
    is_false, is_missing = far_samples(roof_edges(found), roof_edges(true))
    return float(is_false.mean()), float(is_missing.mean())


def height_rmse_m(point_m: np.ndarray, corner_m: np.ndarray) -> float:
    """Root mean square of the heights of points (n, 3) above the topmost triangle at their place. Points beside the
    mesh are left out; NaN if no other point is left.

    corner_m: of the triangles (t, 3, 3), counter-clockwise seen from outside.

    >>> height_rmse_m(np.array([[1, 1, 4], [1, 1, -3], [9, 9, 0.0]]), np.array([[[0, 0, 1], [4, 0, 1], [0, 4, 1.0]]]))
    3.5355339059327378
    """
    _, surface_z_m = topmost(np.ascontiguousarray(corner_m), np.ascontiguousarray(point_m))
    difference_m = (point_m[:, 2] - surface_z_m)[np.isfinite(surface_z_m)]
    return float(np.sqrt((difference_m**2).mean())) if len(difference_m) else float("nan")


def mesh_facts(vertex_m: np.ndarray, triangle: np.ndarray, weld_m: float = 1e-4) -> MeshFacts:
    """Facts of a mesh, vertices welded on a grid of ``weld_m`` metres. vertex_m (v, 3), triangle (t, 3)."""
    triangle = np.asarray(triangle, int).reshape(-1, 3)
    if not len(triangle):
        return MeshFacts(False, False)
    grid = np.round(np.asarray(vertex_m, float) / weld_m).astype(np.int64)
    _, first, welded = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    triangle = welded.reshape(-1)[triangle]
    a, b, c = triangle.T
    triangle = triangle[(a != b) & (b != c) & (c != a)]
    mesh = trimesh.Trimesh(np.asarray(vertex_m, float)[first], triangle, process=False)
    watertight = bool(mesh.is_watertight)
    return MeshFacts(watertight, watertight and shell_code(triangle) in (0, _SEVERAL_PARTS))


def out_of_plane_m(vertex_m: np.ndarray, triangle: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Largest distance of a face's vertices from their least-squares plane, per face: (num_faces,), metres.

    vertex_m (v, 3), triangle (t, 3), face (t,) from 0 to num_faces - 1.
    """
    vertex_m, triangle = np.asarray(vertex_m, float), np.asarray(triangle, int)
    num_faces = int(face.max()) + 1 if len(face) else 0
    deviation_m = np.zeros(num_faces)
    for f in range(num_faces):
        corner = vertex_m[np.unique(triangle[face == f])]
        corner = corner - corner.mean(axis=0)
        normal = np.linalg.svd(corner, full_matrices=True)[2][-1]
        deviation_m[f] = np.abs(corner @ normal).max()
    return deviation_m


def chamfer_distance_m(point_m: np.ndarray, sample_m: np.ndarray) -> float:
    """Half the sum of the two mean nearest-neighbour distances, metres; NaN if either set is empty.

    point_m (n, 3), sample_m (m, 3). Distances are not squared. The value of two samplings of one surface is
    not zero: it is about 0.5 / sqrt(points per square metre) in each direction.

    >>> chamfer_distance_m(np.array([[0.0, 0, 0]]), np.array([[3.0, 4, 0], [0, 1, 0]]))
    2.0
    """
    if not len(point_m) or not len(sample_m):
        return float("nan")
    forth = cKDTree(sample_m).query(point_m)[0].mean()
    back = cKDTree(point_m).query(sample_m)[0].mean()
    return float((forth + back) / 2)
