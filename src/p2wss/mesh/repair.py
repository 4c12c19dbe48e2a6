"""Repair solids that violate a rule of ISO 19107, by merging vertices within millimetres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.faces import Surface
from p2wss.mesh.rules import WRITING, Breach, breaches
from p2wss.mesh.topology import NEXT

# files store coordinates as integers of this size: finer than any plane's tolerance, as Roofer does
SCALE_M = 1e-4
# ends of an edge that are nearer than this are merged
_NEAR_M = 2e-3
_MAX_MERGERS = 40


def stored(vertex_m: np.ndarray, surfaces: Sequence[Surface]) -> tuple[np.ndarray, list[Surface]]:
    """(vertices as a file stores them, int64 (v, 3) in units of ``SCALE_M``; the surfaces of these vertices).

    Vertices that are at one place in the file are one, so a ring may become shorter; it is dropped below three.
    """
    grid = np.round(np.asarray(vertex_m, float).reshape(-1, 3) / SCALE_M).astype(np.int64)
    place, index = np.unique(grid, axis=0, return_inverse=True)
    index = index.reshape(-1)
    result = []
    for surface in surfaces:
        rings = [_without_repeats(index[np.asarray(ring)]) for ring in surface.rings]
        rings = [ring for ring in rings if len(ring) >= 3]
        if rings:
            result.append(replace(surface, rings=rings))
    return place, result


def _without_repeats(ring: np.ndarray) -> np.ndarray:
    return ring[ring != np.roll(ring, 1)]


def surfaces_to_write(mesh: Mesh) -> tuple[list[Surface], list[Breach]]:
    """(the planar polygons of a mesh, the rules that they still break once they are stored).

    mesh: in the CRS. A face that is not planar, or whose rings break a rule, is divided into its triangles.
    """
    pairs = _stored_breaches(mesh.vertex_m, mesh.surfaces)
    broken = {surface for breach, surface in pairs if surface >= 0 and breach.code > 102}
    if not broken:
        return mesh.surfaces, [breach for breach, _ in pairs]
    divided: list[Surface] = []
    for surface in mesh.surfaces:
        if surface.face in broken:
            corners = mesh.triangle[mesh.face == surface.face]
            divided += [replace(surface, rings=[corner]) for corner in corners]
        else:
            divided.append(surface)
    return divided, [breach for breach, _ in _stored_breaches(mesh.vertex_m, divided)]


def _stored_breaches(vertex_m: np.ndarray, surfaces: Sequence[Surface]) -> list[tuple[Breach, int]]:
    """The rules that surfaces break once they are stored, each with the number of the face or -1."""
    grid, of_grid = stored(vertex_m, surfaces)
    return [
        (breach, of_grid[breach.face].face if breach.face >= 0 else -1)
        for breach in breaches(grid * SCALE_M, of_grid, WRITING)
    ]


def repaired(mesh: Mesh) -> tuple[Mesh, list[Surface]] | None:
    """The mesh, in the CRS, and its planar polygons, if its solid is valid; else those of the mesh without its shortest
    edges; None if that is not valid either."""
    surfaces, broken = surfaces_to_write(mesh)
    if broken:
        mesh = _without_shortest_edges(mesh)
        surfaces, broken = surfaces_to_write(mesh)
    return None if broken else (mesh, surfaces)


def _without_shortest_edges(mesh: Mesh) -> Mesh:
    """The mesh with the ends of edges up to ``_NEAR_M`` merged, as far as it stays manifold."""
    for _ in range(_MAX_MERGERS):
        shortest = int(mesh.edge_m.argmin())
        if mesh.edge_m.flat[shortest] > _NEAR_M:
            break
        ends = mesh.triangle.flat[shortest], mesh.triangle[:, NEXT].flat[shortest]
        merged = _merged(mesh, min(ends), max(ends))
        if merged is None:
            break
        mesh = merged
    return mesh


def _merged(mesh: Mesh, end: int, moved: int) -> Mesh | None:
    """The mesh after vertex ``moved`` has moved along an edge to ``end``; None if it would not be manifold."""
    triangle = mesh.triangle
    at_end, at_moved = (triangle == end).any(axis=1), (triangle == moved).any(axis=1)
    gone = at_end & at_moved
    common = np.intersect1d(triangle[at_end], triangle[at_moved])
    if gone.sum() != 2 or len(common) != 4:
        return None
    return replace(mesh, triangle=np.where(triangle == moved, end, triangle)).part(~gone)
