"""How flat the faces of a mesh are."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def face_of_triangle(triangle: np.ndarray, label: np.ndarray) -> np.ndarray:
    """The face, 0 to num_faces - 1 in the order of their first triangles, that each triangle is part of: int (t,).

    Two triangles are of one face if they share an edge and have equal labels, or are linked so through others.
    triangle int (t, 3), label int (t, n), one row per triangle: kind and edge of the kernel's meshes, for example.
    """
    triangle, label = np.asarray(triangle, int).reshape(-1, 3), np.asarray(label)
    if not len(triangle):
        return np.zeros(0, int)
    ends = np.sort(np.stack([triangle, np.roll(triangle, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    rows = np.hstack([ends, np.repeat(label.reshape(len(triangle), -1), 3, axis=0)])
    side_triangle = np.repeat(np.arange(len(triangle)), 3)
    order = np.lexsort(rows.T)
    rows, side_triangle = rows[order], side_triangle[order]
    same = np.flatnonzero((rows[1:] == rows[:-1]).all(axis=1))
    links = coo_array(
        (np.ones(len(same)), (side_triangle[same], side_triangle[same + 1])), shape=(len(triangle),) * 2
    )
    return np.asarray(connected_components(links, directed=False)[1], int)


def out_of_plane_m(vertex_m: np.ndarray, triangle: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Largest distance of a face's vertices from their least-squares plane, per face: (num_faces,), metres.

    vertex_m (v, 3), triangle (t, 3), face (t,) from 0 to num_faces - 1.
    """
    vertex_m, triangle = np.asarray(vertex_m, float), np.asarray(triangle, int)
    num_faces = int(face.max()) + 1 if len(face) else 0
    deviation_m = np.zeros(num_faces)
    for f in range(num_faces):
        corner = vertex_m[np.unique(triangle[face == f])]
        corner = corner - corner.mean(axis=0)
        normal = np.linalg.svd(corner, full_matrices=True)[2][-1]
        deviation_m[f] = np.abs(corner @ normal).max()
    return deviation_m
