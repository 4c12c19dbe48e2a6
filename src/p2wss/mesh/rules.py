"""Validate a solid against the rules of ISO 19107, as validators of city models do.

The numbers of the rules and the tolerances are those of val3dity (Ledoux 2018, "val3dity: validation of 3D GIS
primitives according to the international standards", https://doi.org/10.1186/s40965-018-0043-x;
https://val3dity.readthedocs.io/en/latest/errors/); the tests are our own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from p2wss.mesh import polygon_kernels, shell_kernels
from p2wss.mesh.faces import Surface
from p2wss.mesh.topology import NEXT, crossed, twins, unit_normals
from p2wss.mesh.triangulation import triangulated
from p2wss.skeleton.groups import groups
from p2wss.skeleton.types import cross, distinct, next_in_ring, numbered, writable

MEANINGS: dict[int, str] = {
    101: "a ring has fewer than three vertices",
    102: "consecutive vertices of a ring are the same, within the tolerance of merging them",
    104: "a ring touches or crosses itself",
    201: "two rings of a face cross or touch",
    202: "two rings of a face are the same",
    203: "a face is not planar: a vertex is too far from the plane of least squares",
    204: "a face is not planar: it has a fold",
    205: "holes divide the interior of a face",
    206: "a hole is outside the face",
    207: "a hole is inside another hole",
    208: "a hole turns as the exterior does",
    301: "the shell has fewer than four faces",
    302: "the shell is not closed",
    303: "an edge or a vertex of the shell is not manifold",
    305: "the shell consists of several parts",
    306: "faces of the shell touch or cross each other",
    307: "faces of the shell are oriented differently from their neighbours",
    405: "the shell is inside out",
    501: "solids of a composite overlap",
    503: "solids of a composite are apart",
}


@dataclass(frozen=True)
class Tolerances:
    """snap_m: vertices within this distance are merged. planar_m: the largest distance of a vertex from the plane of
    its face. fold_deg: the largest angle between the normals of the triangles of a face."""

    snap_m: float = 1e-3
    planar_m: float = 1e-2
    fold_deg: float = 20.0


# the defaults of val3dity, and the tolerances of the files that we write. These are stricter, so that the rounding in
# val3dity does not matter, and faces are planar to a fifth of a millimetre
VAL3DITY = Tolerances()
WRITING = Tolerances(1.2e-3, 2e-4, 18.0)


# normals of triangles that are compared with all others at once
_TOGETHER = 500


@dataclass(frozen=True)
class Breach:
    """A rule that a solid breaks. face: the number of the face, or -1 if it is a rule of the shell."""

    code: int
    face: int = -1


def breaches(
    vertex_m: np.ndarray,
    surfaces: Sequence[Surface],
    tolerances: Tolerances = VAL3DITY,
    is_outer: bool = True,
) -> list[Breach]:
    """The rules that a shell of planar polygons breaks, none for a valid one.

    Vertices within ``snap_m`` of each other are one. As in validators, rules of the shell are tested only if all its
    faces are valid, and crossings of faces only if the shell is closed. vertex_m: float64 (v, 3), coordinates as a file
    stores them. is_outer: false for the shell of a hollow, whose faces look inwards.
    """
    if not surfaces:
        return [Breach(301)]
    faces = _Faces.of(vertex_m, surfaces, tolerances.snap_m)
    result = faces.breaches(tolerances)
    if not result and len(surfaces) < 4:
        result = [Breach(301)]
    if result:
        return result
    triangle, corner = faces.triangle, faces.vertex_m[faces.triangle]
    code = shell_code(triangle)
    if code == 0 and crosses_itself(faces.vertex_m, triangle):
        code = 306
    if code == 0:
        volume = np.einsum("ij,ij->", corner[:, 0], crossed(corner[:, 1], corner[:, 2]))
        code = 0 if (volume > 0) == is_outer else 405
    return [Breach(code)] if code else []


@dataclass
class _Faces:
    """Polygons as the compiled tests take them. vertex_m: near the origin, so that rounding does not matter.
    triangle: vertices of the triangles of all faces, int64 (t, 3), filled by :meth:`breaches`."""

    vertex_m: np.ndarray
    corner: np.ndarray
    ring_offset: np.ndarray
    face_ring: np.ndarray
    triangle: np.ndarray

    @classmethod
    def of(cls, vertex_m: np.ndarray, surfaces: Sequence[Surface], snap_m: float) -> _Faces:
        """The faces of surfaces on vertices (v, 3), metres; vertices nearer to each other than ``snap_m`` are one."""
        rings = [ring for surface in surfaces for ring in surface.rings]
        corner = np.concatenate([np.zeros(0, np.int64), *rings]).astype(np.int64)
        ring_offset = np.cumsum([0, *map(len, rings)], dtype=np.int64)
        face_ring = np.cumsum([0, *(len(surface.rings) for surface in surfaces)], dtype=np.int64)
        used, local = numbered(corner)
        near = np.ascontiguousarray(np.asarray(vertex_m, float).reshape(-1, 3)[used])
        if len(near):
            near = near - near.min(axis=0)
        merged = polygon_kernels.merged_vertices(near, snap_m)
        return cls(near, merged[local], ring_offset, face_ring, np.zeros((0, 3), np.int64))

    def breaches(self, tolerances: Tolerances) -> list[Breach]:
        """The rules that single faces break. Sets ``triangle`` once all rings are valid and planar."""
        num_rings = np.diff(self.face_ring)
        is_short = num_rings == 0
        is_short[np.repeat(np.arange(len(num_rings)), num_rings)[np.diff(self.ring_offset) < 3]] = True
        if is_short.any():
            return [Breach(101, f) for f in np.flatnonzero(is_short).tolist()]
        plane_m, off_plane_m = self._in_planes()
        codes = polygon_kernels.broken_ring_rules(plane_m, self.corner, self.ring_offset, self.face_ring)
        size = np.diff(self.ring_offset[self.face_ring])
        # three vertices are in a plane
        codes[(size > 3) & (off_plane_m > tolerances.planar_m) & ((codes > 102) | (codes == 0))] = 203
        result = [Breach(int(codes[f]), f) for f in np.flatnonzero(codes).tolist()]
        if result:
            return result
        face_of_ring = np.repeat(np.arange(len(size)), num_rings)
        ring = np.repeat(np.arange(len(face_of_ring)), np.diff(self.ring_offset))
        self.triangle, face = triangulated(plane_m, self.corner, ring, face_of_ring)
        normal = unit_normals(self.vertex_m[self.triangle])
        of_faces = np.split(normal, np.searchsorted(face, np.arange(1, len(size))))
        lowest = np.array([_lowest_cosine(of_face) for of_face in of_faces])
        is_folded = lowest < np.cos(np.radians(tolerances.fold_deg))
        return [Breach(204, f) for f in np.flatnonzero(is_folded).tolist()]

    def _in_planes(self) -> tuple[np.ndarray, np.ndarray]:
        """(corners (k, 2) in the least-squares plane of their face, distance of the farthest corner of each face from
        that plane (f,)). A plane is seen from the side from which the exterior of its face turns counter-clockwise."""
        first = self.ring_offset[self.face_ring[:-1]]
        size = np.diff(self.ring_offset[self.face_ring])
        face = np.repeat(np.arange(len(size)), size)
        point_m = self.vertex_m[self.corner]
        away_m = point_m - (np.add.reduceat(point_m, first) / size[:, None])[face]
        spread = np.add.reduceat(away_m[:, :, None] * away_m[:, None, :], first)
        # along the axes of the least, the middle and the largest spread
        place_m = np.einsum("ki,kij->kj", away_m, np.linalg.eigh(spread)[1][face])
        plane_m = np.ascontiguousarray(place_m[:, 2:0:-1])
        area_m2 = cross(plane_m, plane_m[next_in_ring(self.ring_offset)])
        area_m2[np.arange(len(point_m)) >= self.ring_offset[self.face_ring[:-1] + 1][face]] = 0.0  # of holes
        plane_m[:, 1] *= np.where(np.add.reduceat(area_m2, first) < 0.0, -1.0, 1.0)[face]
        return plane_m, np.maximum.reduceat(np.abs(place_m[:, 0]), first)


def _lowest_cosine(normal: np.ndarray) -> float:
    """The cosine of the largest angle between unit normals (t, 3), without a matrix of all pairs."""
    rows = np.split(normal, range(_TOGETHER, len(normal), _TOGETHER))
    return min(float((some @ normal.T).min()) for some in rows)


def crosses_itself(vertex_m: np.ndarray, triangle: np.ndarray, asked: np.ndarray | None = None) -> bool:
    """Whether one of the triangles ``asked``, (k,), by default all, intersects another of the triangles (t, 3) beyond a
    common vertex or edge."""
    asked = np.arange(len(triangle)) if asked is None else asked
    return bool(shell_kernels.any_intersect(vertex_m, writable(triangle, np.int64), asked))


def shell_code(triangle: np.ndarray) -> int:
    """The first rule that the triangles (t, 3) break as a closed, manifold, oriented surface of one part, or 0."""
    triangle = np.asarray(triangle, np.int64)
    if (triangle == triangle.take(NEXT, 1)).any():
        return 303
    size = int(triangle.max(initial=-1)) + 1
    start, end = triangle.ravel(), triangle.take(NEXT, 1).ravel()
    if len(distinct(start * size + end)) < len(start):
        sides = np.minimum(start, end) * size + np.maximum(start, end)
        return 303 if (np.unique(sides, return_counts=True)[1] > 2).any() else 307
    twin = twins(triangle)
    if (twin < 0).any():
        return 302
    half = np.arange(twin.size).reshape(-1, 3)
    # the half-edges that leave a vertex, from one triangle to the next around it: a fan
    fan = groups(twin.size, np.column_stack([half.ravel(), twin[:, [2, 0, 1]].ravel()]))
    if fan.max() + 1 != len(distinct(triangle)):
        return 303
    part = groups(len(triangle), np.column_stack([half.ravel(), twin.ravel()]) // 3)
    return 305 if part.max() > 0 else 0
