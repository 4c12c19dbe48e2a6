"""Open ground within a footprint without which a building would be in pieces: its faces are no roofs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from p2wss.mesh import Mesh
from p2wss.skeleton.types import FaceKind

# a level face higher above the ground than this is a roof, whatever points are over it
_MAX_HEIGHT_M = 2.0


@dataclass(frozen=True)
class OpenGround:
    """What the points show of open ground within a footprint.

    point_m: (m, 3), the points to which the roof is fitted. num_ground: how many of them, the last ones, are of class
    ground. A face is open ground if it is level, at most 2 m above the ground, and has more of these points over it
    than others.
    """

    point_m: np.ndarray
    num_ground: int

    def marked(self, mesh: Mesh) -> Mesh:
        """The mesh with the kind ``FLOOR`` for open ground. At least one face remains a roof."""
        if not self.num_ground:
            return mesh
        kind = mesh.kind
        is_low = (kind == FaceKind.FLAT) & (mesh.corner_m[:, :, 2].max(axis=1) <= _MAX_HEIGHT_M)
        is_floor = np.zeros(len(kind), bool)
        for number in np.unique(mesh.label[is_low]).tolist():
            face = is_low & (mesh.label == number)
            within = np.zeros(len(self.point_m), bool)
            for corner in mesh.corner_m[face, :, :2]:
                within |= _are_within(corner, self.point_m[:, :2])
            is_floor |= face & self._is_mostly_ground(within)
        is_roof = ((kind == FaceKind.ROOF) | (kind == FaceKind.FLAT)) & ~is_floor
        kind = np.where(is_floor, np.uint8(FaceKind.FLOOR), kind)
        return replace(mesh, kind=kind) if is_roof.any() else mesh

    def _is_mostly_ground(self, within: np.ndarray) -> bool:
        num_ground = int(within[len(within) - self.num_ground :].sum())
        return num_ground > int(within.sum()) - num_ground


def _are_within(corner: np.ndarray, xy_m: np.ndarray) -> np.ndarray:
    """Which points (m, 2) are in a counter-clockwise triangle (3, 2), bool (m,)."""
    within = np.ones(len(xy_m), bool)
    for start, end in zip(corner, np.roll(corner, -1, axis=0), strict=True):
        along, off = end - start, xy_m - start
        within &= along[0] * off[:, 1] >= along[1] * off[:, 0]
    return within
