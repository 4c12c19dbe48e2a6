"""What the pulses hit: terrain, and buildings with the optical properties of each triangle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from p2wss.scans.terrain import TerrainGrid

TERRAIN_REFLECTANCE = 0.25


class Surface(NamedTuple):
    """Terrain, and the triangles of the buildings (t), all in the local frame.

    vertex_m: float64 (v, 3). triangle: int32 (t, 3). building, face: int32 (t,), -1 and a :data:`TREE` for
    trees. reflectance: float32 (t,), 0 to 1. loss: float32 (t,), share of echoes that do not come back.
    porous: bool (t,), true where a beam goes on beside the triangle, as between leaves.
    """

    terrain: TerrainGrid
    vertex_m: np.ndarray
    triangle: np.ndarray
    building: np.ndarray
    face: np.ndarray
    reflectance: np.ndarray
    loss: np.ndarray
    porous: np.ndarray

    def z_range_m(self) -> tuple[float, float]:
        """Lowest and highest z of all."""
        z = self.vertex_m[self.triangle, 2]
        low, high = float(z.min(initial=np.inf)), float(z.max(initial=-np.inf))
        return min(self.terrain.min_m, low), max(self.terrain.max_m, high)


# what stands on, at or over a building and is no part of its label; see encode_thing
DORMER, CHIMNEY, RAISED_PART, PARAPET, SKYLIGHT, ANNEX, TREE, SHADE, LOWER_PART = range(9)
THING_KIND = 0


def encode_face(kind: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Face id of building triangles: ``4 * (edge + 1) + kind``; kind as in :class:`skeleton.types.FaceKind`.

    ``kind = face_id & 3`` (1 wall, 2 roof, 3 flat roof) and ``edge = (face_id >> 2) - 1``; terrain is -1.
    """
    return (4 * (edge.astype(np.int32) + 1) + kind.astype(np.int32)).astype(np.int32)


def encode_thing(thing: np.ndarray) -> np.ndarray:
    """Face id of what is no part of the label: ``4 * thing``, so that its kind is 0, neither roof nor wall.

    ``thing = face_id >> 2``: 0 dormer, 1 chimney, 2 raised part, 3 parapet, 4 skylight, 5 annex, 6 tree,
    8 lower part.
    """
    return (4 * np.asarray(thing)).astype(np.int32)


def is_tree(face: np.ndarray) -> np.ndarray:
    """Which face ids are trees, bool (n,)."""
    return face == 4 * TREE
