"""What the pulses hit: the terrain, and triangles with optical properties. The face ids of the points."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS, VEGETATION_CLASS
from p2wss.scans.terrain import TerrainGrid

TERRAIN_REFLECTANCE, CLUTTER_REFLECTANCE, TREE_REFLECTANCE = 0.25, 0.3, 0.4
CLUTTER_KIND = 0  # of a face id: neither wall nor roof


class ClutterKind(IntEnum):
    """What stands on, at or over a building and is no part of its label. The face ids of its points
    are ``4 * kind``, so that ``face_id & 3`` is 0: they count neither as roof nor as wall.

    The numbers are in the files of scans, and random draws depend on them.
    """

    DORMER = 0
    CHIMNEY = 1
    ANNEX = 5
    TREE = 6


class Surface(NamedTuple):
    """The terrain and t triangles of buildings and clutter, all in the local frame.

    vertex_m: float64 (v, 3). triangle: int32 (t, 3). building: int32 (t,), -1 for trees. face: int32 (t,),
    see :func:`encode_face` and :class:`ClutterKind`. reflectance: float32 (t,), 0 to 1. loss: float32 (t,),
    share of the returns that the sensor does not detect.
    """

    terrain: TerrainGrid
    vertex_m: np.ndarray
    triangle: np.ndarray
    building: np.ndarray
    face: np.ndarray
    reflectance: np.ndarray
    loss: np.ndarray

    def z_range_m(self) -> tuple[float, float]:
        """The lowest and the highest z of the terrain and the triangles."""
        z = self.vertex_m[self.triangle, 2]
        low, high = float(z.min(initial=np.inf)), float(z.max(initial=-np.inf))
        return min(self.terrain.min_m, low), max(self.terrain.max_m, high)


def encode_face(kind: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Face ids of building triangles: ``4 * (edge + 1) + kind``; kind as in :class:`skeleton.types.FaceKind`.

    ``kind = face_id & 3`` (1 wall, 2 roof, 3 flat roof) and ``edge = (face_id >> 2) - 1``; terrain is -1.
    """
    return (4 * (edge.astype(np.int32) + 1) + kind.astype(np.int32)).astype(np.int32)


def is_tree(face: np.ndarray) -> np.ndarray:
    """bool (n,): which face ids belong to trees."""
    return face == 4 * ClutterKind.TREE


def las_classes(face: np.ndarray) -> np.ndarray:
    """LAS class of points by their face ids, uint8 (n,): 2 ground, 5 vegetation, 6 building.

    Clutter on and beside buildings has the building's class.
    """
    result = np.full(len(face), BUILDING_CLASS, np.uint8)
    result[face < 0] = GROUND_CLASS
    result[is_tree(face)] = VEGETATION_CLASS
    return result
