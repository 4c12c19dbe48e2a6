"""Rings of half-edges around faces, compiled."""

from __future__ import annotations

import numpy as np

from p2wss.skeleton.compiled import allocating, inner
from p2wss.skeleton.ordering import sorted_by


@allocating
def rings_around(
    vertex_m: np.ndarray, half: np.ndarray, number: np.ndarray, axes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(vertices of the rings that half-edges make around faces, (k,), ring after ring; the length of each ring, (r,);
    its face, (r,); twice its area, negative for a hole, (r,)). No ring has a vertex twice, and no dead end is in one.

    vertex_m: (v, 3). half: int64 (h, 2), the vertices of each half-edge. number: int64 (h,), the face to its left.
    axes: (f, 2, 3), two unit vectors in the plane of each face, counter-clockwise.
    """
    begin, at = sorted_by(half[:, 0].copy(), len(vertex_m))
    ring, of_face, area = np.empty(len(half), np.int64), np.empty(len(half), np.int64), np.empty(len(half))
    ring_size, num, num_rings = np.empty(len(half), np.int64), 0, 0
    # the path so far, and the position of each vertex in it
    path, position = np.empty(len(half), np.int64), np.full(len(vertex_m), -1)
    is_done = np.zeros(len(half), np.bool_)
    for first in range(len(half)):
        k, size, face = (-1 if is_done[first] else first), 0, number[first]
        while k >= 0 or size:
            v = half[k, 0] if k >= 0 else -1
            begins = position[v] if k >= 0 else 0
            if begins >= 0:
                if size - begins > 2:
                    ring[num : num + size - begins] = path[begins:size]
                    num += size - begins
                    ring_size[num_rings], of_face[num_rings] = size - begins, face
                    area[num_rings] = _doubled_area(vertex_m, axes[face], path[begins:size])
                    num_rings += 1
                for each in path[begins:size]:
                    position[each] = -1
                size = begins
            if k < 0:
                break
            is_done[k], path[size], position[v], size = True, v, size, size + 1
            # where a face touches itself, the path goes on around the same part of the face
            onward, least = -1, np.inf
            for m in at[begin[half[k, 1]] : begin[half[k, 1] + 1]]:
                if number[m] == face and not is_done[m]:
                    turn = _turn(vertex_m, axes[face], v, half[k, 1], half[m, 1])
                    if turn < least:
                        onward, least = m, turn
            k = onward
    return ring[:num], ring_size[:num_rings], of_face[:num_rings], area[:num_rings]


@inner
def _in_plane(vertex_m: np.ndarray, axes: np.ndarray, place: int, origin: int) -> tuple[float, float]:
    """The coordinates of the vertex ``place`` relative to the vertex ``origin``, along the axes (2, 3)."""
    x, y, z = (
        vertex_m[place, 0] - vertex_m[origin, 0],
        vertex_m[place, 1] - vertex_m[origin, 1],
        vertex_m[place, 2] - vertex_m[origin, 2],
    )
    return axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z, axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z


@inner
def _doubled_area(vertex_m: np.ndarray, axes: np.ndarray, ring: np.ndarray) -> float:
    result = 0.0
    for i in range(1, len(ring) - 1):
        x, y = _in_plane(vertex_m, axes, ring[i], ring[0])
        after_x, after_y = _in_plane(vertex_m, axes, ring[i + 1], ring[0])
        result += x * after_y - y * after_x
    return result


@inner
def _turn(vertex_m: np.ndarray, axes: np.ndarray, before: int, place: int, after: int) -> float:
    """The angle at ``place``, clockwise, from the direction of ``before`` to the direction of ``after``."""
    x, y = _in_plane(vertex_m, axes, before, place)
    on_x, on_y = _in_plane(vertex_m, axes, after, place)
    return (np.arctan2(y, x) - np.arctan2(on_y, on_x) - 1e-12) % (2 * np.pi)
