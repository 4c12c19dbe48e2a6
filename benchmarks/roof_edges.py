"""Whether the edges of a roof are the true ones: false and missing length, corners, and what false edges are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from p2wss.mesh import Mesh
from p2wss.mesh.surface import topmost
from p2wss.mesh.topology import NEXT, unit_normals

# an edge is a true one, and a corner is found, within this distance
NEAR_M = 0.5
_SPACING_M = 0.1
# vertices on one cell of this grid are one corner
_WELD_M = 0.05
# an exact roof has at most this share of false edges, and of missing ones
EXACT = 0.02
# how far beside an edge its step is measured, and the normals of a wall
_BESIDE_M, _WALL_NZ = 0.02, 0.05
# what an edge is
OUTER, HIGH_STEP, STEP, LOW_STEP, FOLD, LOW_FOLD = (
    "outer wall",
    "step above 1 m",
    "step of .3 to 1 m",
    "step below .3 m",
    "fold above 15 deg",
    "fold below 15 deg",
)
EDGE_KINDS = (HIGH_STEP, STEP, LOW_STEP, FOLD, LOW_FOLD, OUTER)


@dataclass(frozen=True)
class RoofEdges:
    """The edges around the roof faces of a mesh. corner_m: (c, 3). edge: int (e, 2), corners. kind: of each edge, from
    ``EDGE_KINDS``."""

    corner_m: np.ndarray
    edge: np.ndarray
    kind: np.ndarray

    @property
    def sample_m(self) -> tuple[np.ndarray, np.ndarray]:
        """(places (s, 3) every 0.1 m along the edges, the edge of each)."""
        start, end = self.corner_m[self.edge[:, 0]], self.corner_m[self.edge[:, 1]]
        num = np.maximum(np.linalg.norm(end - start, axis=1) / _SPACING_M, 1).astype(int)
        of_edge = np.repeat(np.arange(len(num)), num)
        share = (np.arange(num.sum()) - np.repeat(np.cumsum(num) - num, num) + 0.5) / num[of_edge]
        return start[of_edge] + (end - start)[of_edge] * share[:, None], of_edge


def roof_edges(mesh: Mesh) -> RoofEdges:
    """The sides that roof faces do not share with a triangle of their own plane; corners within 5 cm are one.

    An edge is a fold between two roofs, or borders on a wall, which is an outer wall or a step by its height there.
    """
    own, other = np.repeat(np.arange(len(mesh.triangle)), 3), mesh.twin.ravel() // 3
    normal = unit_normals(mesh.corner_m)
    is_roof = normal[:, 2] > _WALL_NZ
    sides = is_roof[own] & (mesh.label[own] != mesh.label[other])
    own, other = own[sides], other[sides]
    vertex = np.stack([mesh.triangle, mesh.triangle[:, NEXT]], axis=-1).reshape(-1, 2)[sides]
    kind = np.full(len(own), OUTER, dtype=object)
    fold = is_roof[other]
    turn_deg = np.degrees(np.arccos(np.clip((normal[own] * normal[other]).sum(axis=1), -1, 1)))
    kind[fold] = np.where(turn_deg[fold] > 15, FOLD, LOW_FOLD)
    step_m = _step_m(mesh, vertex, normal[other])
    inner = ~fold & np.isfinite(step_m)
    kind[inner] = np.select([step_m[inner] > 1, step_m[inner] > 0.3], [HIGH_STEP, STEP], LOW_STEP)
    cell, corner = np.unique(np.round(mesh.vertex_m / _WELD_M).astype(int), axis=0, return_inverse=True)
    corner = corner.ravel()
    edge = np.sort(corner[vertex], axis=1)
    edge, first = np.unique(edge[edge[:, 0] != edge[:, 1]], axis=0, return_index=True)
    kind = kind[corner[vertex[:, 0]] != corner[vertex[:, 1]]][first]
    used, edge = np.unique(edge, return_inverse=True)
    on_roof = np.unique(mesh.triangle[is_roof])
    num = np.maximum(np.bincount(corner[on_roof], minlength=len(cell)), 1)
    corner_m = np.column_stack(
        [np.bincount(corner[on_roof], mesh.vertex_m[on_roof, k], len(cell)) / num for k in range(3)]
    )
    return RoofEdges(corner_m[used], edge.reshape(-1, 2), kind)


def _step_m(mesh: Mesh, vertex: np.ndarray, across: np.ndarray) -> np.ndarray:
    """The difference in height on both sides of edges (e, 2) along the normals (e, 3) of walls; infinite where one side
    is beyond the mesh."""
    middle = mesh.vertex_m[vertex].mean(axis=1)
    beside = np.zeros_like(middle)
    beside[:, :2] = _BESIDE_M * across[:, :2]
    corner_m = np.ascontiguousarray(mesh.corner_m)
    one, two = (topmost(corner_m, middle + sign * beside)[1] for sign in (-1.0, 1.0))
    beyond = np.isinf(one) | np.isinf(two)
    return np.where(beyond, np.inf, np.abs(np.where(beyond, 0.0, one) - np.where(beyond, 0.0, two)))


@dataclass(frozen=True)
class Structure:
    """How the edges of a roof differ from the true ones. Lengths in metres; corners: found within 0.5 m, built, true.
    false_by_kind_m: by ``EDGE_KINDS``."""

    false_m: float
    edges_m: float
    missing_m: float
    true_m: float
    corners: tuple[int, int, int]
    false_by_kind_m: dict[str, float]

    @property
    def is_exact(self) -> bool:
        """Whether false and missing edges are both below 2 %."""
        return self.false_m < EXACT * self.edges_m and self.missing_m < EXACT * self.true_m


def structure(found: RoofEdges, true: RoofEdges) -> Structure:
    """Compare edges. False: further than 0.5 m in space from any true edge; missing: true edges that far from all."""
    sample_m, of_edge = found.sample_m
    true_m, _ = true.sample_m
    is_false = cKDTree(true_m).query(sample_m)[0] > NEAR_M if len(sample_m) else np.zeros(0, bool)
    num_missing = (cKDTree(sample_m).query(true_m)[0] > NEAR_M).sum() if len(sample_m) else len(true_m)
    distance_m = np.linalg.norm(true.corner_m[:, None] - found.corner_m, axis=2)
    # beyond 5 m, no corner is a pair for any other
    row, column = linear_sum_assignment(np.minimum(distance_m, 5.0))
    num_found = int((distance_m[row, column] < NEAR_M).sum())
    kind = found.kind[of_edge]
    return Structure(
        float(is_false.sum() * _SPACING_M),
        len(sample_m) * _SPACING_M,
        float(num_missing * _SPACING_M),
        len(true_m) * _SPACING_M,
        (num_found, len(found.corner_m), len(true.corner_m)),
        {name: float((is_false & (kind == name)).sum() * _SPACING_M) for name in EDGE_KINDS},
    )
