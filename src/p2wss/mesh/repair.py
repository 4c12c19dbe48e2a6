"""Repair solids that violate a rule of ISO 19107, by moving vertices by millimetres."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.faces import Surface
from p2wss.mesh.polygon_kernels import closest_vertices
from p2wss.mesh.rules import WRITING, Breach, breaches

# files store coordinates as integers of this size: finer than any plane's tolerance, as Roofer does
SCALE_M = 1e-4
# vertices nearer than this are merged or, where no edge joins them, moved apart
_NEAR_M = 2e-3
_MAX_MOVES = 40


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
    """The mesh, in the CRS, and its planar polygons, if its solid is valid; else those of one with vertices merged or
    moved by millimetres that is; None if there is none."""
    for candidate in chain([mesh], _attempts(mesh)):
        surfaces, broken = surfaces_to_write(candidate)
        if not broken:
            return candidate, surfaces
    return None


def _attempts(mesh: Mesh) -> Iterator[Mesh]:
    for keeps_first in (True, False):
        moved = mesh
        for _ in range(_MAX_MOVES):
            pair = _near_pair(moved.vertex_m)
            if pair is None:
                break
            merged = _merged(moved, *(pair if keeps_first else pair[::-1]))
            moved = merged if merged is not None else _apart(moved, *pair)
        if moved is not mesh:
            yield moved


def _near_pair(vertex_m: np.ndarray) -> tuple[int, int] | None:
    first, second = closest_vertices(np.ascontiguousarray(vertex_m), _NEAR_M)
    return (int(first), int(second)) if first >= 0 else None


def _merged(mesh: Mesh, end: int, moved: int) -> Mesh | None:
    """The mesh after vertex ``moved`` has moved along an edge to ``end``; None if no edge joins them, or if it would
    not be manifold."""
    triangle = mesh.triangle
    at_end, at_moved = (triangle == end).any(axis=1), (triangle == moved).any(axis=1)
    gone = at_end & at_moved
    common = np.intersect1d(triangle[at_end], triangle[at_moved])
    if gone.sum() != 2 or len(common) != 4:
        return None
    return replace(mesh, triangle=np.where(triangle == moved, end, triangle)).part(~gone)


def _apart(mesh: Mesh, *pair: int) -> Mesh:
    """The mesh after each of two vertices has moved by ``_NEAR_M`` towards its neighbours."""
    vertex_m = mesh.vertex_m.copy()
    for vertex in pair:
        around = mesh.triangle[(mesh.triangle == vertex).any(axis=1)]
        neighbours = np.setdiff1d(around, [*pair])
        if len(neighbours):
            step = mesh.vertex_m[neighbours].mean(axis=0) - mesh.vertex_m[vertex]
            vertex_m[vertex] += step * min(1.0, _NEAR_M / max(float(np.linalg.norm(step)), 1e-9))
    return mesh.moved(vertex_m)
