"""How the edges of a roof differ from the true ones: what false edges are, and corners. Used by structure.py."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from p2wss.eval.metrics import NEAR_M, SPACING_M, RoofEdges, far_samples, roof_edges
from p2wss.mesh import Mesh
from p2wss.mesh.surface import topmost
from p2wss.mesh.topology import NEXT, unit_normals

# an exact roof has at most this share of false edges, and of missing ones
EXACT = 0.02
# distance beside an edge at which its step is measured; limit of z of the normals of walls
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


def kinds(mesh: Mesh, edges: RoofEdges) -> np.ndarray:
    """The kind of each edge, from ``EDGE_KINDS``: a fold between two roofs, or an edge at a wall. The height of the
    wall there tells whether it is an outer wall or a step."""
    own, other = edges.side // 3, mesh.twin.ravel()[edges.side] // 3
    normal = unit_normals(mesh.corner_m)
    vertex = np.stack([mesh.triangle, mesh.triangle[:, NEXT]], axis=-1).reshape(-1, 2)[edges.side]
    kind = np.full(len(own), OUTER, dtype=object)
    fold = normal[other, 2] > _WALL_NZ
    turn_deg = np.degrees(np.arccos(np.clip((normal[own] * normal[other]).sum(axis=1), -1, 1)))
    kind[fold] = np.where(turn_deg[fold] > 15, FOLD, LOW_FOLD)
    step_m = _step_m(mesh, vertex, normal[other])
    inner = ~fold & np.isfinite(step_m)
    kind[inner] = np.select([step_m[inner] > 1, step_m[inner] > 0.3], [HIGH_STEP, STEP], LOW_STEP)
    return kind


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
    """How the edges of a roof differ from the true ones. Lengths in metres. Numbers of corners: found within 0.5 m,
    built, true. false_by_kind_m: by ``EDGE_KINDS``."""

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


def structure(mesh: Mesh, true_mesh: Mesh) -> Structure:
    """Compare the edges of a roof with the true ones."""
    found, true = roof_edges(mesh), roof_edges(true_mesh)
    is_false, is_missing = far_samples(found, true)
    distance_m = np.linalg.norm(true.corner_m[:, None] - found.corner_m, axis=2)
    # corners more than 5 m apart are no better a pair than any others
    row, column = linear_sum_assignment(np.minimum(distance_m, 5.0))
    num_found = int((distance_m[row, column] < NEAR_M).sum())
    kind = kinds(mesh, found)[found.sample_m[1]]
    return Structure(
        float(is_false.sum() * SPACING_M),
        len(is_false) * SPACING_M,
        float(is_missing.sum() * SPACING_M),
        len(is_missing) * SPACING_M,
        (num_found, len(found.corner_m), len(true.corner_m)),
        {name: float((is_false & (kind == name)).sum() * SPACING_M) for name in EDGE_KINDS},
    )
