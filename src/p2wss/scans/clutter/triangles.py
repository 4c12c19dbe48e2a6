"""Triangles of clutter objects: copies of one polyhedron, blocks over rectangles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# a block without its floor: corners 0 to 3 are the bottom, 4 to 7 the top
BLOCK_TRIANGLES = [(4, 5, 6), (4, 6, 7)] + [
    t for i in range(4) for t in ((i, (i + 1) % 4, (i + 1) % 4 + 4), (i, (i + 1) % 4 + 4, i + 4))
]


class ClutterTriangles(NamedTuple):
    """The t triangles of the clutter objects of one kind.

    vertex_m: float64 (t, 3, 3). building: int32 (t,), row of the object's building. number: int32 (t,), of the
    object.
    """

    vertex_m: np.ndarray
    building: np.ndarray
    number: np.ndarray

    @property
    def num_objects(self) -> int:
        """The number of objects that have triangles."""
        return len(np.unique(self.number))


def copies(corner_m: np.ndarray, triangles: list[tuple[int, int, int]], row: np.ndarray) -> ClutterTriangles:
    """Copies of one polyhedron: corner_m (k, v, 3), its triangles, and the building of each copy (k,)."""
    count = len(triangles)
    vertex = corner_m[:, np.array(triangles)].reshape(-1, 3, 3)
    number = np.repeat(np.arange(len(row), dtype=np.int32), count)
    return ClutterTriangles(vertex, np.repeat(row, count).astype(np.int32), number)


def blocks(outline: np.ndarray, low: np.ndarray, high: np.ndarray, row: np.ndarray) -> ClutterTriangles:
    """Blocks over outlines (k, 4, 2) from z ``low`` to z ``high`` (k,), without floors."""
    corner = np.empty((len(outline), 8, 3))
    corner[:, :4, :2] = corner[:, 4:, :2] = outline
    corner[:, :4, 2], corner[:, 4:, 2] = low[:, None], high[:, None]
    return copies(corner, BLOCK_TRIANGLES, row)
