"""Convex edges of a skin: the wedges at which a simulator lets rays diffract."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2wss.mesh.topology import NEXT
from p2wss.reconstruct.skin import Skin
from p2wss.skeleton.groups import groups

# faces that turn by less are one surface
_MIN_TURN_DEG = 1.0
# pieces of an edge that are in line to within this angle are one wedge
_IN_LINE_DEG = 0.1


@dataclass(frozen=True)
class Wedges:
    """Convex edges of one skin.

    end_m: float64 (w, 2, 3). opening_angle_deg: (w,), the angle inside the buildings between the two faces, below 180.
    face: int32 (w, 2), labels of the skin's faces, the left one first, seen from outside in the direction from the
    first end to the second.
    """

    end_m: np.ndarray
    opening_angle_deg: np.ndarray
    face: np.ndarray


def wedges(skin: Skin) -> Wedges:
    """The convex edges between faces of a skin; a straight edge between the same two faces is one wedge."""
    origin = skin.mesh.vertex_m.min(axis=0)
    mesh = skin.mesh.translated(-origin)
    vertex, normal, twin = mesh.vertex_m, mesh.planes.normal, mesh.twin.ravel()
    start, end = mesh.triangle.ravel(), mesh.triangle[:, NEXT].ravel()
    left = np.repeat(mesh.planes.number, 3)
    # a skin that ends on the terrain has edges without a second triangle there
    once = (left != left[twin]) & (start < end) & (twin >= 0)
    start, end, left, right = start[once], end[once], left[once], left[twin[once]]
    along = vertex[end] - vertex[start]
    length = np.linalg.norm(along, axis=1)
    along /= np.maximum(length, 1e-12)[:, None]
    sine = (np.cross(normal[left], normal[right]) * along).sum(axis=1)
    cosine = (normal[left] * normal[right]).sum(axis=1)
    # positive where the surface turns away from the outside, as at the corner of a box
    turn_deg = np.degrees(np.arctan2(sine, cosine))
    convex = turn_deg > _MIN_TURN_DEG
    start, end, left, right, along, turn_deg = (
        values[convex] for values in (start, end, left, right, along, turn_deg)
    )
    piece_of = _in_line(start, end, np.column_stack([left, right]), along)
    label = np.unique(mesh.label)
    ends, faces, angles = [], [], []
    for piece in range(int(piece_of.max(initial=-1)) + 1):
        rows = np.flatnonzero(piece_of == piece)
        first = rows[0]
        points = vertex[np.concatenate([start[rows], end[rows]])]
        along_edge = points @ along[first]
        ends.append(points[[along_edge.argmin(), along_edge.argmax()]] + origin)
        faces.append((label[left[first]], label[right[first]]))
        angles.append(180 - turn_deg[first])
    return Wedges(
        np.array(ends).reshape(-1, 2, 3), np.array(angles, float), np.array(faces, np.int32).reshape(-1, 2)
    )


def _in_line(start: np.ndarray, end: np.ndarray, face: np.ndarray, along: np.ndarray) -> np.ndarray:
    """int (n,): equal numbers for edges between the same faces that continue each other."""
    by_end: dict[tuple[int, int, int], list[int]] = {}
    for row, (a, b, pair) in enumerate(
        zip(start.tolist(), end.tolist(), np.sort(face, axis=1).tolist(), strict=True)
    ):
        by_end.setdefault((a, *pair), []).append(row)
        by_end.setdefault((b, *pair), []).append(row)
    pairs = [rows for rows in by_end.values() if len(rows) == 2]
    links = np.array(pairs, int).reshape(-1, 2)
    straight = np.abs((along[links[:, 0]] * along[links[:, 1]]).sum(axis=1)) >= np.cos(
        np.radians(_IN_LINE_DEG)
    )
    return groups(len(start), links[straight])
