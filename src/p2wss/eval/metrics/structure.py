"""Whether the edges of a roof are the true ones: the lengths of false and of missing edges."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from p2wss.mesh import Mesh
from p2wss.mesh.topology import NEXT, unit_normals

# an edge counts as true within this distance of a true edge
NEAR_M = 0.5
SPACING_M = 0.1
# vertices on one cell of this grid are one corner; vertical part of the normal of a wall
_WELD_M, _WALL_NZ = 0.05, 0.05


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
