"""Outer walls that stand exactly on the edges of the footprint, which neighbours share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2wss.fit.directions import edge_ends
from p2wss.mesh import Mesh
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
    vertex_m, planes = mesh.vertex_m, mesh.planes
    start, end = np.moveaxis(edge_ends(rings), 1, 0)
    along = end - start
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
    at, plane = mesh.at
    on_edge = np.zeros((len(planes.kind), len(start)), bool)
    np.logical_or.at(on_edge, plane, distance_m[at] <= _NEAR_M)
    on_edge &= (planes.kind == FaceKind.WALL)[:, None]
    on_edge &= planes.normal[:, :2] @ outward.T >= np.sqrt(1 - _MAX_SINE**2)
    reach = np.where(on_edge[plane], distance_m[at], np.inf)
    edge, gap_m = reach.argmin(axis=1), reach.min(axis=1)
    is_off = (gap_m > _NEAR_M) & (gap_m <= reach_m)
    for vertex in np.unique(at[is_off]).tolist():
        lines = edge[(at == vertex) & (gap_m <= reach_m)]
        place = _meeting_point(vertex_m[vertex, :2], lines, start, outward)
        if np.hypot(*(place - vertex_m[vertex, :2])) > 2 * reach_m:
            continue
        corner = int(np.hypot(*(start - place).T).argmin())
        result[vertex, :2] = start[corner] if np.hypot(*(start[corner] - place)) <= _NEAR_M else place
        roofs = plane[
            (at == vertex) & (planes.kind[plane] != FaceKind.WALL) & (planes.normal[plane, 2] > 0.05)
        ]
        if len(roofs):
            slope = planes.normal[roofs, :2] / planes.normal[roofs, 2:]
            middle_m = np.array([_middle_m(mesh, number) for number in roofs])
            shift = result[vertex, :2] - middle_m[:, :2]
            result[vertex, 2] = (middle_m[:, 2] - (shift * slope).sum(axis=1)).mean()
    # what was computed of a mesh that stays is kept
    return mesh if (result == vertex_m).all() else mesh.moved(result)


def _middle_m(mesh: Mesh, number: int) -> np.ndarray:
    """The middle (3,) of a plane's triangles."""
    own = mesh.number == number
    return np.average(mesh.corner_m[own].mean(axis=1), axis=0, weights=mesh.area_m2[own])


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
