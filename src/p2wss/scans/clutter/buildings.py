"""The buildings that get clutter, and what every kind of clutter needs: random draws, edges,
rectangles, triangles of copies of one polyhedron."""

from typing import NamedTuple

import numpy as np

from p2wss.scans.randomness import uniforms
from p2wss.skeleton.types import Polygons

_NUM_DRAWS = 64  # uniform draws per building and stream
STREAM_STEP = 2**20  # between the first draws of two streams


class LocalBuildings(NamedTuple):
    """n buildings in the local frame.

    polygons: their footprints, empty for a building without a mesh. eave_z_m, terrain_z_m, base_z_m: float64
    (n,). key: uint64 (n,), of their random draws.
    """

    polygons: Polygons
    eave_z_m: np.ndarray
    terrain_z_m: np.ndarray
    base_z_m: np.ndarray
    key: np.ndarray


def draw_buildings(buildings: LocalBuildings, stream: int, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a random ``share`` of the buildings with a mesh, and uniform draws for each, (n, 64).

    ``stream`` numbers what is drawn, a :class:`surface.ClutterKind` for clutter.
    """
    first_draw = uniforms(buildings.key, stream * STREAM_STEP, 1)[:, 0]
    rows = np.flatnonzero((first_draw < share) & (np.diff(buildings.polygons.polygon_offset) > 0))
    return rows, uniforms(buildings.key[rows], stream * STREAM_STEP + 1, _NUM_DRAWS)


def between(u: np.ndarray, low: float, high: float) -> np.ndarray:
    """Uniform draws from [0, 1) moved to [low, high)."""
    return low + u * (high - low)


def left_of(direction: np.ndarray) -> np.ndarray:
    """Directions (.., 2) turned left by a right angle. For a footprint edge this is the direction inwards."""
    return np.stack([-direction[..., 1], direction[..., 0]], axis=-1)


def rectangles(middle: np.ndarray, along: np.ndarray, half_m: np.ndarray) -> np.ndarray:
    """Corners (k, 4, 2): middle (k, 2), unit direction (k, 2), half length and half width (k, 2)."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    a = signs[None, :, :1] * half_m[:, None, :1] * along[:, None]
    b = signs[None, :, 1:] * half_m[:, None, 1:] * left_of(along)[:, None]
    return middle[:, None] + a + b


def edges(polygons: Polygons) -> tuple[np.ndarray, np.ndarray]:
    """Length (n,) and unit direction (n, 2) of every edge, aligned with the vertices where they start."""
    vector_m = polygons.xy_m[polygons.next_vertex] - polygons.xy_m
    length = np.linalg.norm(vector_m, axis=1)
    return length, vector_m / np.maximum(length, 1e-9)[:, None]


def draw_edges(
    buildings: LocalBuildings, rows: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A random edge of each of ``rows``, with a probability proportional to its length: number, length in metres,
    outward unit normal (k, 2)."""
    length, along = edges(buildings.polygons)
    before = np.concatenate([[0.0], np.cumsum(length)])
    offset = buildings.polygons.vertex_offset
    target = before[offset[rows]] + u * (before[offset[rows + 1]] - before[offset[rows]])
    edge = np.clip(np.searchsorted(before, target, side="right") - 1, offset[rows], offset[rows + 1] - 1)
    return edge, length[edge], -left_of(along[edge])


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
