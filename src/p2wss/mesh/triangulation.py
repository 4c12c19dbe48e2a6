"""Triangles of planar polygons with holes, as validators of city models make them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from p2wss.mesh.topology import doubled_plan_areas


def triangulated(
    place_m: np.ndarray, vertex: np.ndarray, ring: np.ndarray, face_of_ring: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(vertices of the triangles of polygons, int64 (t, 3), counter-clockwise; the face of each triangle, ascending):
    constrained Delaunay triangulations, as validators use them; none of a polygon that is not valid.

    place_m: (k, 2), the corners of all rings, each in the plane of its face. vertex: (k,), of each corner. ring: (k,),
    its ring, ascending. face_of_ring: the face of each ring, ascending, exteriors before holes.
    """
    rings = np.asarray(shapely.linearrings(place_m, indices=ring), object)
    polygons = np.asarray(shapely.polygons(rings, indices=face_of_ring), object)
    polygons[~shapely.is_valid(polygons)] = None
    parts, face = shapely.get_parts(shapely.constrained_delaunay_triangles(polygons), return_index=True)
    corner_m = shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3]
    turns_back = doubled_plan_areas(corner_m) < 0
    corner_m[turns_back] = corner_m[turns_back, ::-1]
    of_corner = zip(face_of_ring[ring].tolist(), map(tuple, place_m.tolist()), strict=True)
    vertex_at = dict(zip(of_corner, vertex.tolist(), strict=True))
    of_place = zip(np.repeat(face, 3).tolist(), map(tuple, corner_m.reshape(-1, 2).tolist()), strict=True)
    return np.array([vertex_at[each] for each in of_place], np.int64).reshape(-1, 3), face


def triangulated_in_space(
    point_m: np.ndarray, faces: Sequence[Sequence[Sequence[int] | np.ndarray]], normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The same of the rings of faces, at least one, of points (v, 3). normal: (f, 3), the unit normals of the faces; a
    face without area, whose normal is 0, has no triangles."""
    rings = [ring for face in faces for ring in face]
    face_of_ring = np.repeat(np.arange(len(faces)), list(map(len, faces)))
    corner, ring = np.concatenate(rings), np.repeat(np.arange(len(rings)), list(map(len, rings)))
    across = np.cross(np.eye(3)[np.abs(normal).argmin(axis=1)], normal)
    across /= np.maximum(np.linalg.norm(across, axis=1), np.finfo(float).tiny)[:, None]
    axes = np.stack([across, np.cross(normal, across)], axis=1)[face_of_ring[ring]]
    place_m = (axes @ (point_m[corner] - point_m[0])[..., None])[..., 0]
    return triangulated(place_m, corner, ring, face_of_ring)
