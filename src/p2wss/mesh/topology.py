"""How triangles are connected: pairs of half-edges, borders, faces, and parts."""

import numpy as np

from p2wss.skeleton.compiled import entry
from p2wss.skeleton.groups import find_reverses, groups, num_slots
from p2wss.skeleton.types import differs, writable

# the corner of a triangle after each; numpy's ``roll`` takes three times as long for a small mesh
NEXT = np.array([1, 2, 0])
# metres: vertices nearer to each other than this are one in files
_WELD_M = 1e-4


def twins(triangle: np.ndarray) -> np.ndarray:
    """int64 (t, 3): the half-edge that runs the other way along each side of the triangles (t, 3), -1 for none.

    Half-edge 3 t + k is side k of triangle t, from its corner k to the next.
    """
    start, end = triangle.astype(np.int64).ravel(), triangle.take(NEXT, 1).astype(np.int64).ravel()
    return reverses(start, end).reshape(-1, 3)


def reverses(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """int64 (n,): for each half-edge from ``start`` to ``end``, int64 (n,), the half-edge that runs the other way, -1
    for none."""
    return np.asarray(_reverses(writable(start, np.int64), writable(end, np.int64)))


@entry
def _reverses(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    slot, result = np.empty(num_slots(len(start)), np.int64), np.empty(len(start), np.int64)
    find_reverses(start, end, slot, result)
    return result


def doubled_areas(corner_m: np.ndarray) -> np.ndarray:
    """(t, 3), normals as long as twice the area of the triangles (t, 3, 3)."""
    return crossed(corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0])


def crossed(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The cross products (n, 3) of vectors in space; numpy's own function takes three times as long for a few."""
    return np.asarray((one * other.take(NEXT, 1) - one.take(NEXT, 1) * other).take(NEXT, 1))


def unit_normals(corner_m: np.ndarray) -> np.ndarray:
    """(t, 3), the unit normals of triangles (t, 3, 3)."""
    normal = doubled_areas(corner_m)
    return normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]


def doubled_plan_areas(corner_m: np.ndarray) -> np.ndarray:
    """(t,), twice the signed areas of triangles (t, 3, 2), positive if counter-clockwise."""
    u, v = corner_m[:, 1] - corner_m[:, 0], corner_m[:, 2] - corner_m[:, 0]
    return np.asarray(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])


def border_rings(triangle: np.ndarray, face: np.ndarray, twin: np.ndarray) -> list[tuple[int, list[int]]]:
    """(face, vertices) of each ring along the border of a face, in the order of their first sides.

    A side is on the border if there is no triangle of the same face across it. A ring has the direction of its
    triangles (t, 3). face: (t,). twin: see :func:`twins`.

    The next side of a border is found by turning around the common vertex within the face. So where two borders of a
    face touch in a vertex, they may become one ring.
    """
    other = twin.ravel()
    is_border = (other < 0) | (face[other // 3] != np.repeat(face, 3))
    half, is_first = _border_sides(is_border, other)
    vertex, number = triangle.ravel()[half].tolist(), face[half // 3].tolist()
    first = np.flatnonzero(is_first).tolist()
    return [
        (number[start], vertex[start:end]) for start, end in zip(first, [*first[1:], len(half)], strict=True)
    ]


@entry
def _border_sides(is_border: np.ndarray, twin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(half-edges (n,) of the borders of faces, ring after ring; whether each begins a ring)."""
    result, is_first, is_pending = (
        np.empty(len(twin), np.int64),
        np.zeros(len(twin), np.bool_),
        is_border.copy(),
    )
    num = 0
    for first in range(len(twin)):
        half = first
        while is_pending[half]:
            result[num], is_first[num], is_pending[half] = half, half == first, False
            num += 1
            half += 1 if half % 3 < 2 else -2
            # at most once around, as a surface that is no manifold may lead in circles
            for _ in range(len(twin)):
                if is_border[half]:
                    break
                half = twin[half]
                half += 1 if half % 3 < 2 else -2
    return result[:num], is_first[:num]


def face_numbers(twin: np.ndarray, label: np.ndarray) -> np.ndarray:
    """int (t,): the face of each triangle. Faces are numbered from 0 in the order of their first triangles.

    Two triangles are in one face if they share a side and have equal labels, or if a chain of such triangles links
    them. twin: see :func:`twins`. label: int (t,).
    """
    beside = twin // 3
    triangle, side = np.nonzero((twin >= 0) & (label[beside] == label[:, None]))
    return groups(len(twin), np.column_stack([triangle, beside[triangle, side]]))


def first_of_faces(face: np.ndarray) -> np.ndarray:
    """The first triangle (f,) of each of the faces that :func:`face_numbers` gives."""
    # a new face has a higher number than all before
    return np.flatnonzero(differs(np.maximum.accumulate(face)))


def is_closed(vertex_m: np.ndarray, triangle: np.ndarray) -> bool:
    """Whether every edge has exactly two triangles, in opposite directions, after merging the vertices that files do
    not distinguish."""
    corner = unique_rows(np.rint(vertex_m / _WELD_M))[1][triangle]
    corner = corner[(corner != corner.take(NEXT, 1)).all(axis=1)]
    size = len(vertex_m)
    start, end = corner.ravel(), corner.take(NEXT, 1).ravel()
    forward, back = np.sort(start * size + end), np.sort(end * size + start)
    return bool(len(forward) and (forward[1:] > forward[:-1]).all() and (forward == back).all())


def unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(the distinct rows of ``rows`` (n, k), ascending; the number of each row among them, int64 (n,))."""
    # numpy's own function takes several times as long for a few rows
    order = np.lexsort(rows.T[::-1])
    ordered, is_new = rows[order], np.ones(len(rows), bool)
    is_new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    number = np.empty(len(rows), np.int64)
    number[order] = np.cumsum(is_new) - 1
    return ordered[is_new], number
