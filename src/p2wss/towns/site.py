"""The site of every synthetic town: four tiles of a kilometre, and the ground under them."""

import numpy as np
import shapely

CRS = "EPSG:2154"
X_MIN, Y_MIN, X_MAX, Y_MAX = 652_000, 6_860_000, 654_000, 6_862_000
CENTRE = np.array([653_000.0, 6_861_000.0])  # the church square, at the corner of the four tiles
LIDAR_X_MIN, LIDAR_Y_MAX = 653_000, 6_861_000  # north-west corner of the LiDAR tile: 0653_6861
LIDAR_TILE = shapely.box(LIDAR_X_MIN, LIDAR_Y_MAX - 1000, LIDAR_X_MIN + 1000, LIDAR_Y_MAX)
# classes of LAS
UNCLASSIFIED_CLASS, GROUND_CLASS, VEGETATION_CLASS, BUILDING_CLASS = 1, 2, 5, 6
LIDAR_RADIUS_M = 370  # the LiDAR tile is built up to here only, to keep its file small


def ground_z_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A hill in the north-west, a valley in the south-east, some waves: 38 to 98 m."""
    u, v = (x - CENTRE[0]) / 1000, (y - CENTRE[1]) / 1000
    hill = 34 * np.exp(-((u + 0.75) ** 2 + (v - 0.6) ** 2) / 0.35)
    valley = -14 * np.exp(-((u - v - 1.1) ** 2) / 0.2)
    waves = 2.2 * np.sin(9 * u + 4 * v) + 1.1 * np.sin(17 * v - 6 * u)
    return 58 + hill + valley + waves + 5 * v


def in_lidar_tile(geometry: shapely.Geometry) -> bool:
    """Whether the geometry lies in the tile for which ``benchmarks/drawn_towns`` draws LiDAR."""
    return bool(LIDAR_TILE.contains(geometry))
