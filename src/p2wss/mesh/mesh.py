"""The mesh of a building: triangles, each with the kind and the label of its face, and what follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from p2wss.mesh import topology
from p2wss.mesh.faces import Surface, surfaces_of
from p2wss.mesh.shell_kernels import Triangles, planes_at, planes_of
from p2wss.mesh.topology import NEXT
from p2wss.skeleton.types import Meshes, numbered, writable

if TYPE_CHECKING:
    import trimesh

# a plane is upright, or faces upwards, by the z of its normal
_UPRIGHT_NZ = 0.05
# the derived properties that follow from triangles and labels alone, and those that do not depend on labels, if each
# face gets a label of its own
_CONNECTION = ("twin", "face", "surfaces", "number", "at")
_SHAPE = ("corner_m", "doubled_m2", "area_m2", "twin", "face", "is_closed", "edge_m")


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with common vertices. Nothing changes after its construction; what is derived is computed once.

    vertex_m: float64 (v, 3). triangle: int (t, 3), counter-clockwise seen from outside. kind: uint8 (t,),
    :class:`p2wss.skeleton.FaceKind`. label: int (t,), a number for the plane of each triangle. Triangles of one label
    that share a side are one planar face of one kind. The numbers themselves mean nothing.
    """

    vertex_m: np.ndarray
    triangle: np.ndarray
    kind: np.ndarray
    label: np.ndarray

    @classmethod
    def of_kernel(cls, meshes: Meshes, index: int) -> Mesh:
        """One mesh of the kernel, which knows the planes of roofs and walls by the edges of the footprint."""
        vertex_m, triangle, kind, edge = meshes.mesh(index)
        _, label = np.unique(np.column_stack([kind, edge]), axis=0, return_inverse=True)
        return cls(vertex_m, triangle, kind, label.reshape(-1).astype(np.int32))

    @classmethod
    def empty(cls) -> Mesh:
        """A mesh without triangles."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, np.uint8), np.zeros(0, np.int32))

    @classmethod
    def joined(cls, meshes: Sequence[Mesh]) -> Mesh:
        """All triangles of several meshes, in one mesh. Triangles of different meshes share no vertex and no label."""
        meshes = meshes or [cls.empty()]
        first = np.cumsum([0, *(len(mesh.vertex_m) for mesh in meshes)])
        label = np.cumsum([0, *(mesh.label.max(initial=-1) + 1 for mesh in meshes)])
        return cls(
            np.concatenate([mesh.vertex_m for mesh in meshes]),
            np.concatenate([mesh.triangle + start for mesh, start in zip(meshes, first, strict=False)]),
            np.concatenate([mesh.kind for mesh in meshes]),
            np.concatenate([mesh.label + start for mesh, start in zip(meshes, label, strict=False)]),
        )

    def __getstate__(self) -> dict[str, Any]:
        # surfaces are stored once more with a reconstruction, and what follows from them is slow to find
        kept = (*(field.name for field in fields(self)), "surfaces")
        return {name: value for name, value in vars(self).items() if name in kept}

    def moved(self, vertex_m: np.ndarray) -> Mesh:
        """The same triangles with other places of the vertices, (v, 3), which turn no face over."""
        return self._with(_CONNECTION, vertex_m=vertex_m)

    def of_faces(self) -> Mesh:
        """The same triangles with a label for each face: separate faces no longer share a plane."""
        return self._with(_SHAPE, label=self.face.astype(np.int32))

    def _with(self, kept: Sequence[str], **changes: np.ndarray) -> Mesh:
        result = replace(self, **changes)
        vars(result).update({name: vars(self)[name] for name in kept if name in vars(self)})
        return result

    def translated(self, by_m: Sequence[float] | np.ndarray) -> Mesh:
        """The mesh moved by a vector (3,)."""
        return self.moved(self.vertex_m + np.asarray(by_m))

    def part(self, rows: np.ndarray | slice) -> Mesh:
        """The mesh of some of the triangles, by mask, number or slice, without vertices that they do not use."""
        triangle = self.triangle[rows]
        is_used = np.bincount(triangle.ravel(), minlength=len(self.vertex_m)) > 0
        number = np.cumsum(is_used, dtype=triangle.dtype) - 1
        return Mesh(self.vertex_m[is_used], number[triangle], self.kind[rows], self.label[rows])

    def to_trimesh(self) -> trimesh.Trimesh:
        """The mesh for trimesh, with the attributes of its faces ``kind`` and ``label``."""
        import trimesh  # takes longer to import than the rest of the room

        attributes = {"kind": self.kind, "label": self.label}
        return trimesh.Trimesh(self.vertex_m, self.triangle, face_attributes=attributes, process=False)

    @cached_property
    def arrays(self) -> Triangles:
        """The mesh for compiled code."""
        vertex_m, triangle = writable(self.vertex_m, np.float64), writable(self.triangle, np.int64)
        return Triangles(vertex_m, triangle, writable(self.kind, np.uint8), writable(self.label, np.int64))

    @cached_property
    def corner_m(self) -> np.ndarray:
        """(t, 3, 3), the corners of the triangles."""
        return self.vertex_m.take(self.triangle, 0)

    @cached_property
    def doubled_m2(self) -> np.ndarray:
        """(t, 3), the normals of the triangles, outwards, twice as long as their areas."""
        return topology.doubled_areas(self.corner_m)

    @cached_property
    def area_m2(self) -> np.ndarray:
        """(t,), the areas of the triangles."""
        return np.linalg.norm(self.doubled_m2, axis=1) / 2

    @cached_property
    def volume_m3(self) -> float:
        """The volume of a closed mesh, negative if its faces look inwards."""
        corner_m = self.vertex_m[self.triangle[:, 0]] - self.vertex_m.min(axis=0)
        return float(np.einsum("ij,ij->", corner_m, self.doubled_m2) / 6)

    @cached_property
    def twin(self) -> np.ndarray:
        """int64 (t, 3), the half-edge across each side (:func:`p2wss.mesh.topology.twins`)."""
        return topology.twins(self.triangle)

    @cached_property
    def face(self) -> np.ndarray:
        """int (t,), the face of each triangle. Faces are numbered in the order of their first triangles."""
        return topology.face_numbers(self.twin, self.label)

    @cached_property
    def surfaces(self) -> list[Surface]:
        """The faces as polygons, in the order of their numbers."""
        return surfaces_of(self.vertex_m, self.triangle, self.kind, self.label, self.face, self.twin)

    @cached_property
    def number(self) -> np.ndarray:
        """int (t,), the plane of each triangle, numbered from 0 in the order of their labels."""
        return numbered(self.label)[1]

    @cached_property
    def at(self) -> tuple[np.ndarray, np.ndarray]:
        """(vertices, planes), int (k,): all pairs of a vertex and a plane through it, in ascending order."""
        return planes_at(self.arrays.triangle, self.number, len(self.vertex_m))

    @cached_property
    def planes(self) -> Planes:
        """The planes that the labels stand for (:func:`p2wss.mesh.shell_kernels.planes_of`)."""
        num = int(self.number.max(initial=-1)) + 1
        return Planes(*planes_of(self.arrays._replace(label=self.number), num))

    @cached_property
    def num_planes_at(self) -> np.ndarray:
        """int (v,), how many planes meet at each vertex."""
        return np.bincount(self.at[0], minlength=len(self.vertex_m))

    @cached_property
    def is_closed(self) -> bool:
        """Whether every edge has exactly two triangles (:func:`p2wss.mesh.topology.is_closed`)."""
        return topology.is_closed(self.vertex_m, self.triangle)

    @cached_property
    def edge_m(self) -> np.ndarray:
        """(t, 3), the lengths of the sides of the triangles."""
        return np.linalg.norm(self.corner_m - self.corner_m.take(NEXT, 1), axis=2)


@dataclass(frozen=True)
class Planes:
    """The planes of a mesh, numbered from 0 in the order of their labels.

    kind: uint8 (p,). normal: (p, 3), outwards; 0 for a plane without area. area_m2: (p,).
    """

    kind: np.ndarray
    normal: np.ndarray
    area_m2: np.ndarray

    @property
    def is_wall(self) -> np.ndarray:
        """bool (p,): upright planes."""
        return np.abs(self.normal[:, 2]) < _UPRIGHT_NZ
