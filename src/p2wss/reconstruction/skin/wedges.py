"""Convex edges of a skin: the wedges at which a simulator lets rays diffract."""

from dataclasses import dataclass

import numpy as np

from p2wss.mesh.topology import NEXT, unit_normals
from p2wss.reconstruction.skin import Skin
from p2wss.skeleton.angles import bearings

# an edge at which the surface turns by less is no wedge
_MIN_TURN_DEG = 1.0


@dataclass(frozen=True)
class Wedges:
    """Convex edges of one skin.

    end_m: float64 (w, 2, 3), the two ends. opening_angle_deg: (w,), the angle between the two faces inside the
    buildings, below 180. face: int32 (w, 2), the labels of these faces: first the left one, seen from outside when
    looking from the first end to the second.
    """

    end_m: np.ndarray
    opening_angle_deg: np.ndarray
    face: np.ndarray


def wedges(skin: Skin) -> Wedges:
    """The convex edges of the mesh of a skin, with the angles between its triangles."""
    origin = skin.mesh.vertex_m.min(axis=0)
    mesh = skin.mesh.translated(-origin)
    vertex, twin = mesh.vertex_m, mesh.twin.ravel()
    start, end = mesh.triangle.ravel(), mesh.triangle[:, NEXT].ravel()
    # a skin that ends on the terrain has edges without a second triangle there
    once = np.flatnonzero((start < end) & (twin >= 0))
    start, end, left, right = start[once], end[once], once // 3, twin[once] // 3
    normal = unit_normals(mesh.corner_m)
    along = vertex[end] - vertex[start]
    along /= np.linalg.norm(along, axis=1)[:, None]
    sine = (np.cross(normal[left], normal[right]) * along).sum(axis=1)
    cosine = (normal[left] * normal[right]).sum(axis=1)
    # positive where the surface turns away from the outside, as at the corner of a box
    turn_deg = np.degrees(bearings(np.column_stack([cosine, sine])))
    is_wedge = turn_deg > _MIN_TURN_DEG
    return Wedges(
        vertex[np.column_stack([start, end])[is_wedge]] + origin,
        180 - turn_deg[is_wedge],
        mesh.label[np.column_stack([left, right])[is_wedge]].astype(np.int32),
    )
