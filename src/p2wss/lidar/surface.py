"""What the pulses hit: terrain and buildings as one triangle mesh, with the optical properties of each
triangle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

TERRAIN_REFLECTANCE = 0.25


class Surface(NamedTuple):
    """Terrain triangles first, then those of the buildings.

    vertex_m: float64 (v, 3) in the local frame. triangle: int32 (t, 3). num_terrain: the first triangles are
    terrain. The other arrays have one entry per building triangle (t - num_terrain,): building and face
    int32, reflectance float32 (0 to 1), loss float32 (share of pulses that get no echo).
    """

    vertex_m: np.ndarray
    triangle: np.ndarray
    num_terrain: int
    building: np.ndarray
    face: np.ndarray
    reflectance: np.ndarray
    loss: np.ndarray


def join(
    terrain: tuple[np.ndarray, np.ndarray],
    vertex_m: np.ndarray,
    triangle: np.ndarray,
    building: np.ndarray,
    face: np.ndarray,
    reflectance: np.ndarray,
    loss: np.ndarray,
) -> Surface:
    """One surface of terrain (vertices, triangles) and buildings, all in the local frame."""
    return Surface(
        vertex_m=np.concatenate([terrain[0], vertex_m]),
        triangle=np.concatenate([terrain[1], triangle + len(terrain[0])]).astype(np.int32),
        num_terrain=len(terrain[1]),
        building=building.astype(np.int32),
        face=face.astype(np.int32),
        reflectance=reflectance.astype(np.float32),
        loss=loss.astype(np.float32),
    )


def encode_face(kind: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Face id of building triangles: ``4 * (edge + 1) + kind``; kind as in :class:`skeleton.types.FaceKind`.

    ``kind = face_id & 3`` (1 wall, 2 roof, 3 flat roof) and ``edge = (face_id >> 2) - 1``; terrain is -1.
    """
    return (4 * (edge.astype(np.int32) + 1) + kind.astype(np.int32)).astype(np.int32)
