"""The planes of a roof that is known, and the lines between them: candidates where points are few."""

from __future__ import annotations

import numpy as np

from p2wss.fit.planes.lines import Line
from p2wss.mesh import Mesh
from p2wss.mesh.topology import NEXT

# metres: lines reach beyond their ends, so that they meet
_REACH_M = 0.01
# places on a triangle, as shares of its corners
_SHARES = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6


def known_planes(mesh: Mesh) -> np.ndarray:
    """The planes (k, 3) of the roofs of a mesh."""
    corner = np.zeros(len(mesh.planes.normal), int)
    corner[mesh.number] = mesh.triangle[:, 0]
    is_roof = _is_roof(mesh)
    normal, place_m = mesh.planes.normal[is_roof], mesh.vertex_m[corner[is_roof]]
    slope = -normal[:, :2] / normal[:, 2:]
    return np.column_stack([slope, place_m[:, 2] - (slope * place_m[:, :2]).sum(axis=1)])


def known_places(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """(places (m, 2) on the roofs of a mesh, the plane of :func:`known_planes` at each)."""
    is_roof = _is_roof(mesh)
    on_roof = is_roof[mesh.number]
    place_m = _SHARES @ mesh.corner_m[on_roof, :, :2]
    number = np.cumsum(is_roof)[mesh.number[on_roof]] - 1
    return place_m.reshape(-1, 2), np.repeat(number, len(_SHARES))


def _is_roof(mesh: Mesh) -> np.ndarray:
    return np.asarray((mesh.planes.normal[:, 2] > 0) & ~mesh.planes.is_wall)


def known_lines(mesh: Mesh) -> list[Line]:
    """The lines along which the roofs of a closed mesh meet."""
    other, is_roof = mesh.twin // 3, mesh.doubled_m2[:, 2] > 0
    is_edge = is_roof[:, None] & is_roof[other] & (mesh.number[:, None] < mesh.number[other])
    side = np.stack([mesh.triangle, mesh.triangle[:, NEXT]], axis=2)[is_edge]
    return [Line.through(*end_m).along(end_m, _REACH_M) for end_m in mesh.vertex_m[side, :2]]
