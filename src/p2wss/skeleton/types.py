"""Ragged arrays that go into and come out of the kernel: many polygons, many meshes, one array each."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

FloatArray = np.ndarray
IntArray = np.ndarray


def writable(array: FloatArray | IntArray, dtype: type) -> FloatArray | IntArray:
    """The array, or a copy if it has another dtype, is not contiguous or is read-only. numba would compile everything
    once more for each of these."""
    array = np.asarray(array, dtype)
    return array if array.flags.carray else array.copy()


def cross(one: FloatArray, other: FloatArray) -> FloatArray:
    """The cross products of vectors in the plane, which are along the last axis."""
    return np.asarray(one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0])


def distinct(value: np.ndarray) -> np.ndarray:
    """The distinct values (d,), ascending. numpy's ``unique`` takes four times as long.

    >>> distinct(np.array([[3, 1], [1, 2]])).tolist()
    [1, 2, 3]
    """
    ordered = np.sort(value, axis=None)
    return np.asarray(ordered[differs(ordered)])


def numbered(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(the distinct values (d,) of ``value`` (n,), ascending; the number of each value among them, int64 (n,)). numpy's
    ``unique`` takes twice as long."""
    order = np.argsort(value, kind="stable")
    ordered, number = value[order], np.empty(len(value), np.int64)
    is_new = differs(ordered)
    number[order] = np.cumsum(is_new) - 1
    return ordered[is_new], number


def differs(ordered: np.ndarray) -> np.ndarray:
    """bool (n,): which values differ from the value before; the first one counts as different."""
    result = np.ones(len(ordered), bool)
    np.not_equal(ordered[1:], ordered[:-1], out=result[1:])
    return result


def next_in_ring(ring_offset: IntArray) -> IntArray:
    """For each vertex the index of the next vertex of its ring; no ring is empty."""
    following = np.arange(1, ring_offset[-1] + 1)
    following[ring_offset[1:] - 1] = ring_offset[:-1]
    return following


class FaceKind(IntEnum):
    """What a triangle belongs to. WALL and ROOF carry the edge of the footprint that they grow from.

    The kernel only makes the first four. FLOOR is a level face over open ground within a footprint. A fit to points
    makes it where the building would be in pieces without it.
    """

    GROUND = 0
    WALL = 1
    ROOF = 2
    FLAT = 3  # a horizontal piece: a cap, a cut at the maximum height, or what 0 degree edges have swept
    FLOOR = 4


@dataclass(frozen=True)
class Polygons:
    """``num_polygons`` polygons with courtyards. No ring repeats its first vertex.

    xy_m: float64 (num_vertices, 2). Exterior rings are counter-clockwise, courtyards clockwise, once cleaned.
    ring_offset: int64 (num_rings + 1,): ring r owns vertices ``ring_offset[r]:ring_offset[r + 1]``.
    polygon_offset: int64 (num_polygons + 1,): polygon p owns rings
        ``polygon_offset[p]:polygon_offset[p + 1]``, its exterior first.

    Edge i of a ring runs from its vertex i to its vertex i + 1 (the last one back to the first); an array of
    one value per edge is aligned with ``xy_m``.
    """

    xy_m: FloatArray
    ring_offset: IntArray
    polygon_offset: IntArray

    def __len__(self) -> int:
        return len(self.polygon_offset) - 1

    @property
    def vertex_offset(self) -> IntArray:
        """int64 (num_polygons + 1,): polygon p owns vertices ``vertex_offset[p]:vertex_offset[p + 1]``."""
        return self.ring_offset[self.polygon_offset]

    @property
    def next_vertex(self) -> IntArray:
        """int64 (num_vertices,): the vertex at which the edge from each vertex ends."""
        return next_in_ring(self.ring_offset)

    def rings(self, polygon: int) -> list[FloatArray]:
        """The rings of one polygon, each float64 (n, 2), exterior first."""
        first, last = self.polygon_offset[polygon], self.polygon_offset[polygon + 1]
        return [self.xy_m[self.ring_offset[r] : self.ring_offset[r + 1]] for r in range(first, last)]

    @classmethod
    def from_rings(cls, polygons: list[list[FloatArray]]) -> Polygons:
        """From a list of polygons, each a list of rings, each (n, 2)."""
        rings = [np.asarray(ring, float).reshape(-1, 2) for polygon in polygons for ring in polygon]
        return cls(
            xy_m=np.concatenate(rings) if rings else np.zeros((0, 2)),
            ring_offset=np.cumsum([0, *map(len, rings)], dtype=np.int64),
            polygon_offset=np.cumsum([0, *map(len, polygons)], dtype=np.int64),
        )


@dataclass(frozen=True)
class Meshes:
    """One closed triangle mesh per polygon; a rejected polygon has no triangles and a status other than 0.

    The labels ``kind`` and ``edge`` say which face a triangle was cut from: triangles of equal labels that share a side
    are one planar face.

    vertex_m: float64 (num_vertices, 3). triangle: int32 (num_triangles, 3), indices local to the mesh,
    counter-clockwise seen from outside. kind: uint8 (num_triangles,), a :class:`FaceKind`. edge: int32
    (num_triangles,), the edge of the polygon (counted over all its rings) or -1.
    vertex_offset, triangle_offset: int64 (num_meshes + 1,). status: int32 (num_meshes,), a ``Status``.
    num_caps: int32 (num_meshes,), number of caps, horizontal pieces of the roof. num_ambiguous: int32 (num_meshes,),
    how often two collinear neighbours on the wavefront had different speeds. The definition leaves this case open, and
    a millimetre in the footprint may then change the roof.
    """

    vertex_m: FloatArray
    triangle: IntArray
    kind: IntArray
    edge: IntArray
    vertex_offset: IntArray
    triangle_offset: IntArray
    status: IntArray
    num_caps: IntArray
    num_ambiguous: IntArray

    def __len__(self) -> int:
        return len(self.status)

    def mesh(self, index: int) -> tuple[FloatArray, IntArray, IntArray, IntArray]:
        """(vertices (v, 3), triangles (t, 3), kind (t,), edge (t,)) of one mesh."""
        v = slice(self.vertex_offset[index], self.vertex_offset[index + 1])
        t = slice(self.triangle_offset[index], self.triangle_offset[index + 1])
        return self.vertex_m[v], self.triangle[t], self.kind[t], self.edge[t]
