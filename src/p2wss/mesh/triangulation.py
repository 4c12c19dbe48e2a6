"""Triangles of planar polygons with holes, as validators of city models make them."""

from collections.abc import Sequence

import numpy as np
import shapely

from p2wss.mesh.topology import crossed, doubled_plan_areas


def triangulated(
    place_m: np.ndarray, vertex: np.ndarray, ring: np.ndarray, face_of_ring: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(vertices of the triangles of polygons, int64 (t, 3), counter-clockwise; the face of each triangle, ascending).

    These are constrained Delaunay triangulations, as in validators. A polygon that is not valid has no triangles.
    place_m: (k, 2), the corners of all rings, each in the plane of its face. vertex, ring: (k,), the vertex and the
    ring of each corner, rings ascending. face_of_ring: the face of each ring, ascending, exteriors before holes.
    """
    # the numbers of vertices are passed as heights, which stay with the corners
    rings = np.asarray(shapely.linearrings(np.column_stack([place_m, vertex]), indices=ring), object)
    polygons = np.asarray(shapely.polygons(rings, indices=face_of_ring), object)
    polygons[~shapely.is_valid(polygons)] = None
    divided = shapely.constrained_delaunay_triangles(polygons)
    corner = shapely.get_coordinates(divided, include_z=True).reshape(-1, 4, 3)[:, :3]
    turns_back = doubled_plan_areas(corner) < 0
    corner[turns_back] = corner[turns_back, ::-1]
    return corner[:, :, 2].astype(np.int64), np.repeat(
        np.arange(len(divided)), shapely.get_num_geometries(divided)
    )


def triangulated_in_space(
    point_m: np.ndarray, faces: Sequence[Sequence[Sequence[int] | np.ndarray]], normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """:func:`triangulated` for faces in space, at least one. faces: the rings of each, indices of ``point_m`` (v, 3).
    normal: (f, 3), the unit normals of the faces, 0 for a face without area."""
    rings = [ring for face in faces for ring in face]
    face_of_ring = np.repeat(np.arange(len(faces)), list(map(len, faces)))
    corner, ring = np.concatenate(rings), np.repeat(np.arange(len(rings)), list(map(len, rings)))
    axes = axes_of(normal)[face_of_ring[ring]]
    place_m = (axes @ (point_m[corner] - point_m[0])[..., None])[..., 0]
    return triangulated(place_m, corner, ring, face_of_ring)


def axes_of(normal: np.ndarray) -> np.ndarray:
    """(f, 2, 3), two unit vectors in the plane of each unit normal (f, 3), counter-clockwise around it."""
    across = crossed(np.eye(3)[np.abs(normal).argmin(axis=1)], normal)
    # a face without area has no normal, and its corners are in one place, which is no polygon
    across /= np.maximum(np.linalg.norm(across, axis=1), 1e-300)[:, None]
    return np.stack([across, crossed(normal, across)], axis=1)
