"""Solids as files store them. Faces that would break a rule of ISO 19107 in a file are divided into triangles."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.faces import Surface
from p2wss.mesh.rules import WRITING, Breach, breaches
from p2wss.mesh.topology import unique_rows

# files store coordinates as integers of this size: finer than any plane's tolerance
SCALE_M = 1e-5


def stored(vertex_m: np.ndarray, surfaces: Sequence[Surface]) -> tuple[np.ndarray, list[Surface]]:
    """(vertices as a file stores them, int64 (v, 3) in units of ``SCALE_M``; the surfaces of these vertices).

    Vertices at the same place in the file become one, so a ring may become shorter. A ring with fewer than three is
    dropped.
    """
    grid = np.round(np.asarray(vertex_m, float).reshape(-1, 3) / SCALE_M).astype(np.int64)
    place, index = unique_rows(grid)
    result = []
    for surface in surfaces:
        rings = [_without_repeats(index[np.asarray(ring)]) for ring in surface.rings]
        if rings := [ring for ring in rings if len(ring) >= 3]:
            # ``replace`` takes three times as long
            result.append(Surface(surface.kind, surface.label, rings, surface.face))
    return place, result


def _without_repeats(ring: np.ndarray) -> np.ndarray:
    # numpy's ``roll`` takes five times as long for a few vertices
    return ring[ring != ring[np.arange(-1, len(ring) - 1)]]


def surfaces_to_write(
    mesh: Mesh, origin_m: np.ndarray | Sequence[float] = (0.0, 0.0, 0.0)
) -> tuple[list[Surface], list[Breach]]:
    """(the planar polygons of a mesh, the rules that they still break once they are stored).

    origin_m: (3,), the origin of the mesh in the CRS. A face that is not planar, or whose rings break a rule, is
    divided into its triangles.
    """
    vertex_m = mesh.vertex_m + np.asarray(origin_m)
    pairs = _stored_breaches(vertex_m, mesh.surfaces)
    broken = {surface for breach, surface in pairs if surface >= 0 and breach.code > 102}
    if not broken:
        return mesh.surfaces, [breach for breach, _ in pairs]
    divided: list[Surface] = []
    for surface in mesh.surfaces:
        corners = mesh.triangle[mesh.face == surface.face] if surface.face in broken else ()
        divided += [replace(surface, rings=[corner]) for corner in corners] or [surface]
    return divided, [breach for breach, _ in _stored_breaches(vertex_m, divided)]


def _stored_breaches(vertex_m: np.ndarray, surfaces: Sequence[Surface]) -> list[tuple[Breach, int]]:
    """(rule, face) of each rule that surfaces break once they are stored. face: its number, or -1 for a rule of the
    shell."""
    grid, of_grid = stored(vertex_m, surfaces)
    return [
        (breach, of_grid[breach.face].face if breach.face >= 0 else -1)
        for breach in breaches(grid * SCALE_M, of_grid, WRITING)
    ]
