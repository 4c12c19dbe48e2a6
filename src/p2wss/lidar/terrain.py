"""Terrain as triangles: a raster of heights, two triangles between four neighbouring cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Terrain:
    """A north-up raster of heights.

    height_m: float32 (rows, columns), NaN where there is no data; row 0 is the north.
    x_min_m, y_max_m: outer corner of the north-west cell. cell_m: edge of the square cells.
    """

    height_m: np.ndarray
    x_min_m: float
    y_max_m: float
    cell_m: float

    def at(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Height of the cell that holds each point, NaN outside the raster or where it has no data."""
        rows, columns = self.height_m.shape
        column = np.floor((np.asarray(x_m) - self.x_min_m) / self.cell_m).astype(np.int64)
        row = np.floor((self.y_max_m - np.asarray(y_m)) / self.cell_m).astype(np.int64)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        heights = self.height_m[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        return np.where(inside, heights, np.nan)


def triangulate(terrain: Terrain, origin_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices at the cell centres and two triangles per square of four centres, facing up.

    A triangle with a NaN corner is left out. Returns vertices float64 (rows * columns, 3), relative to
    ``origin_m`` (3,), and triangles int32 (t, 3).
    """
    rows, columns = terrain.height_m.shape
    x = terrain.x_min_m + (np.arange(columns) + 0.5) * terrain.cell_m - origin_m[0]
    y = terrain.y_max_m - (np.arange(rows) + 0.5) * terrain.cell_m - origin_m[1]
    vertices = np.empty((rows * columns, 3))
    vertices[:, 0] = np.tile(x, rows)
    vertices[:, 1] = np.repeat(y, columns)
    vertices[:, 2] = terrain.height_m.ravel()
    vertices[:, 2] -= origin_m[2]

    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    north_west, north_east = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    south_west, south_east = index[1:, :-1].ravel(), index[1:, 1:].ravel()
    triangles = np.empty((2 * len(north_west), 3), np.int32)
    triangles[0::2] = np.stack([north_west, south_west, south_east], axis=1)
    triangles[1::2] = np.stack([north_west, south_east, north_east], axis=1)

    missing = np.isnan(vertices[:, 2])
    if missing.any():
        triangles = triangles[~missing[triangles].any(axis=1)]
        vertices[missing, 2] = 0.0  # no triangle uses them; Embree wants finite numbers
    return vertices, triangles
