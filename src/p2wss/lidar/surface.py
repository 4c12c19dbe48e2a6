"""What the pulses hit: terrain, and buildings with the optical properties of each triangle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from p2wss.lidar.terrain import TerrainGrid

TERRAIN_REFLECTANCE = 0.25


class Surface(NamedTuple):
    """Terrain, and the triangles of the buildings (t), all in the local frame.

    vertex_m: float64 (v, 3). triangle: int32 (t, 3). building, face: int32 (t,). reflectance: float32 (t,),
    0 to 1. loss: float32 (t,), share of pulses that get no echo.
    """

    terrain: TerrainGrid
    vertex_m: np.ndarray
    triangle: np.ndarray
    building: np.ndarray
    face: np.ndarray
    reflectance: np.ndarray
    loss: np.ndarray

    def z_range_m(self) -> tuple[float, float]:
        """Lowest and highest z of all."""
        z = self.vertex_m[self.triangle, 2]
        low, high = float(z.min(initial=np.inf)), float(z.max(initial=-np.inf))
        return min(self.terrain.min_m, low), max(self.terrain.max_m, high)


def encode_face(kind: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Face id of building triangles: ``4 * (edge + 1) + kind``; kind as in :class:`skeleton.types.FaceKind`.

    ``kind = face_id & 3`` (1 wall, 2 roof, 3 flat roof) and ``edge = (face_id >> 2) - 1``; terrain is -1.
    """
    return (4 * (edge.astype(np.int32) + 1) + kind.astype(np.int32)).astype(np.int32)
