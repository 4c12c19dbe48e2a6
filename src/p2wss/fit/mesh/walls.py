"""Outer walls that stand exactly on the edges of the footprint, which neighbours share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.topology import unique_rows
from p2wss.skeleton.types import FaceKind

# a vertex further from an edge of the footprint, or a wall turned further from it, is not on that edge
REACH_M, _MAX_SINE = 0.04, 0.02
# what is nearer than this is there
_NEAR_M = 1e-6


def with_exact_walls(mesh: Mesh, rings: Sequence[np.ndarray], reach_m: float = REACH_M) -> Mesh:
    """The mesh after the vertices of its outer walls have moved onto their edges of the footprint.

    Rotations and unions leave them off by rounding errors, and the merging of slivers by up to some centimetres. rings:
    of the footprint, exterior counter-clockwise, courtyards clockwise. Vertices further off than ``reach_m`` stay;
    those over a corner of the footprint are at it to the bit. A vertex that moves by more than rounding errors goes up
    or down to the planes of the roofs that meet there.
    """
    vertex_m, triangle, kind = mesh.vertex_m, mesh.triangle, mesh.kind
    start = np.concatenate(list(rings))
    along = np.concatenate([np.roll(ring, -1, axis=0) for ring in rings]) - start
    length = np.hypot(along[:, 0], along[:, 1])
    outward = np.column_stack([along[:, 1], -along[:, 0]]) / length[:, None]
    result = np.array(vertex_m, float)

    # distance of each vertex to each edge, and the corners that vertices are at
    to_vertex = vertex_m[:, None, :2] - start
    share = np.clip((to_vertex * along).sum(axis=2) / length**2, 0, 1)
    distance_m = np.hypot(*np.moveaxis(to_vertex - share[..., None] * along, 2, 0))
    from_corner_m = np.hypot(to_vertex[..., 0], to_vertex[..., 1])
    nearest = from_corner_m.argmin(axis=1)
    at_corner = np.flatnonzero(from_corner_m.min(axis=1) <= _NEAR_M)
    result[at_corner, :2] = start[nearest[at_corner]]

    # a face is on an edge if it is turned that way and one of its vertices is there
    face = unique_rows(np.column_stack([kind, mesh.label]))[1]
    normal, middle_m = _face_planes(mesh, face)
    is_wall = np.zeros(len(normal), bool)
    is_wall[face[kind == FaceKind.WALL]] = True
    on_edge = np.zeros((len(normal), len(start)), bool)
    np.logical_or.at(on_edge, np.repeat(face, 3), distance_m[triangle.ravel()] <= _NEAR_M)
    on_edge &= is_wall[:, None] & (normal[:, :2] @ outward.T >= np.sqrt(1 - _MAX_SINE**2))

    is_outer = np.asarray(on_edge.any(axis=1))[face]
    pairs = unique_rows(np.column_stack([triangle[is_outer].ravel(), np.repeat(face[is_outer], 3)]))[0]
    reach = np.where(on_edge[pairs[:, 1]], distance_m[pairs[:, 0]], np.inf)
    edge, gap_m = reach.argmin(axis=1), reach.min(axis=1)
    is_off = (gap_m > _NEAR_M) & (gap_m <= reach_m)
    for vertex in np.unique(pairs[is_off, 0]).tolist():
        lines = edge[(pairs[:, 0] == vertex) & (gap_m <= reach_m)]
        place = _meeting_point(vertex_m[vertex, :2], lines, start, outward)
        if np.hypot(*(place - vertex_m[vertex, :2])) > 2 * reach_m:
            continue
        corner = int(np.hypot(*(start - place).T).argmin())
        result[vertex, :2] = start[corner] if np.hypot(*(start[corner] - place)) <= _NEAR_M else place
        roofs = np.unique(face[(triangle == vertex).any(axis=1)])
        roofs = roofs[~is_wall[roofs] & (normal[roofs, 2] > 0.05)]
        if len(roofs):
            slope = normal[roofs, :2] / normal[roofs, 2:]
            shift = result[vertex, :2] - middle_m[roofs, :2]
            result[vertex, 2] = (middle_m[roofs, 2] - (shift * slope).sum(axis=1)).mean()
    # what was computed of a mesh that stays is kept
    return mesh if (result == vertex_m).all() else mesh.moved(result)


def _face_planes(mesh: Mesh, face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(unit normal, middle) of each face, (f, 3). face: (t,), that of each triangle."""
    cross = mesh.doubled_m2
    size = np.linalg.norm(cross, axis=1)
    normal, middle_m = np.zeros((face.max() + 1, 3)), np.zeros((face.max() + 1, 3))
    np.add.at(normal, face, cross)
    np.add.at(middle_m, face, size[:, None] * mesh.corner_m.mean(axis=1))
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
    return normal, middle_m / np.maximum(np.bincount(face, size), 1e-12)[:, None]


def _meeting_point(
    xy_m: np.ndarray, edges: np.ndarray, start_m: np.ndarray, outward: np.ndarray
) -> np.ndarray:
    """The place nearest to ``xy_m`` on the line of an edge, or where the lines of two edges meet."""
    first = edges[0]
    cross = outward[first, 0] * outward[edges, 1] - outward[first, 1] * outward[edges, 0]
    second = edges[np.abs(cross).argmax()]
    if np.abs(cross).max() <= _MAX_SINE:
        return xy_m + ((start_m[first] - xy_m) @ outward[first]) * outward[first]
    lines = outward[[first, second]]
    return np.linalg.solve(lines, (lines * start_m[[first, second]]).sum(axis=1))
