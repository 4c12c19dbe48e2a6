"""Triangle meshes for simulators: Wavefront OBJ, binary PLY and binary STL, in metres, z up, around a stated origin.

Triangles are counter-clockwise seen from outside: normals point out of the solid. Vertices stay shared, so a solid
that is closed in memory is closed in the file.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from p2wss import __version__
from p2wss.formats.materials import DEFAULTS, EDITION, MATERIALS
from p2wss.mesh import Mesh
from p2wss.mesh.topology import unit_normals
from p2wss.skeleton.types import FaceKind

# kinds of the triangles of terrain and of plants, in addition to ``FaceKind``
TERRAIN = max(FaceKind) + 1
VEGETATION = TERRAIN + 1
SURFACE_NAMES = {
    FaceKind.GROUND: "ground",
    FaceKind.WALL: "wall",
    FaceKind.ROOF: "roof",
    FaceKind.FLAT: "roof",
    FaceKind.FLOOR: "outer_floor",
    TERRAIN: "terrain",
    VEGETATION: "vegetation",
}
_SURFACES = list(dict.fromkeys(SURFACE_NAMES.values()))
_SURFACE_OF_KIND = np.zeros(max(SURFACE_NAMES) + 1, int)
_SURFACE_OF_KIND[list(SURFACE_NAMES)] = [_SURFACES.index(name) for name in SURFACE_NAMES.values()]
AXES = "x = easting - origin_m[0], y = northing - origin_m[1], z = height - origin_m[2]; metres"
_VERTEX = np.dtype([("xyz", "<f4", 3)])
_PLY_FACE = np.dtype([("count", "u1"), ("vertex", "<i4", 3), ("kind", "u1"), ("building", "<i4")])
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")])


@dataclass(frozen=True)
class BuildingRef:
    """A building of which a mesh has faces. materials: names of materials by names of surfaces
    (:data:`SURFACE_NAMES`); a surface that is missing has the default material."""

    building_id: str
    materials: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Body:
    """A named mesh to write: one building, a skin of several buildings that touch, or the terrain.

    mesh: in the CRS; triangles of terrain have the kind :data:`TERRAIN`, triangles of a plant :data:`VEGETATION`.
    building: int32 (t,), the building of each triangle, an index into ``buildings``. The terrain, or a plant, is the
    only "building" of its mesh. attributes: for file formats that can store them.
    """

    name: str
    mesh: Mesh
    building: np.ndarray
    buildings: tuple[BuildingRef, ...]
    attributes: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of_building(cls, name: str, mesh: Mesh, materials: Mapping[str, str] | None = None) -> Body:
        """The body of a single building, of the terrain or of a plant, with its materials."""
        return cls(name, mesh, np.zeros(len(mesh.triangle), np.int32), (BuildingRef(name, materials or {}),))

    @property
    def is_terrain(self) -> bool:
        """Whether it is the terrain."""
        return TERRAIN in self.mesh.kind

    @property
    def is_plant(self) -> bool:
        """Whether it is a tree or a clump."""
        return VEGETATION in self.mesh.kind

    @cached_property
    def faces(self) -> list[Faces]:
        """The triangles, grouped by building and surface, in the order in which the groups first appear."""
        number = np.asarray(self.building, int) * len(_SURFACES) + _SURFACE_OF_KIND[self.mesh.kind]
        number, first, index = np.unique(number, return_index=True, return_inverse=True)
        triangles = np.split(np.argsort(index, kind="stable"), np.cumsum(np.bincount(index))[:-1])
        result = []
        for position in np.argsort(first).tolist():
            building, k = divmod(int(number[position]), len(_SURFACES))
            ref, surface = self.buildings[building], _SURFACES[k]
            material = ref.materials.get(surface, DEFAULTS[surface])
            result.append(Faces(ref.building_id, surface, material, triangles[position]))
        return result


@dataclass(frozen=True)
class Frame:
    """The local coordinates of a file: its point (0, 0, 0) is ``origin_m`` (x, y, z) in the CRS ``crs``, a text."""

    origin_m: np.ndarray
    crs: str

    @property
    def origin(self) -> str:
        """``origin_m`` as text, for comments in files."""
        return " ".join(f"{value:.10g}" for value in self.origin_m)


def frame_around(bodies: Sequence[Body], crs: str) -> Frame:
    """The frame with the lower corner of all meshes as its origin, in whole metres: so coordinates are small enough for
    32 bits."""
    corners = [body.mesh.vertex_m.min(axis=0) for body in bodies]
    # WKT that a user states may have several lines, and the end of a line would end a comment in a file
    crs = " ".join(crs.split())
    return Frame(np.floor(np.min(corners, axis=0)) if corners else np.zeros(3), crs)


@dataclass(frozen=True)
class Faces:
    """The triangles of a mesh that belong to one surface of one building. surface: a name of :data:`SURFACE_NAMES`.
    triangle: int (n,), indices of triangles."""

    building_id: str
    surface: str
    material: str
    triangle: np.ndarray


def obj(bodies: Sequence[Body], frame: Frame, library: str | None = None) -> bytes:
    """Wavefront OBJ: one object per mesh, its faces sorted by material, with their surfaces and buildings as comments.

    There are no groups, because loaders cut a mesh apart at groups. library: name of the file with the materials
    (:func:`mtl`); None for no materials.
    """
    lines = [
        f"# p2wss {__version__}; metres; x east, y north, z up",
        f"# crs {frame.crs}",
        f"# origin_m {frame.origin} (add it to every vertex)",
    ]
    if library is not None:
        lines.append(f"mtllib {library}")
    first = 1
    for body, name in zip(bodies, _distinct(_word(body.name) for body in bodies), strict=True):
        mesh = body.mesh
        lines.append(f"o {name}")
        lines += [f"# {name} {value:g}" for name, value in body.attributes.items()]
        lines += [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in (mesh.vertex_m - frame.origin_m).tolist()]
        material = None
        for faces in sorted(body.faces, key=lambda faces: faces.material):
            lines.append(f"# {faces.surface} {_word(faces.building_id)}")
            if library is not None and faces.material != material:
                material = faces.material
                lines.append(f"usemtl {material}")
            lines += [f"f {a} {b} {c}" for a, b, c in (mesh.triangle[faces.triangle] + first).tolist()]
        first += len(mesh.vertex_m)
    return ("\n".join(lines) + "\n").encode()


def mtl(bodies: Sequence[Body], more: Mapping[str, Sequence[str]] | None = None) -> bytes:
    """The materials of the meshes for :func:`obj`: names, colours and, in comments, types of ITU-R P.2040.

    more: further lines of each material, by its name.
    """
    lines = [f"# p2wss {__version__}"]
    for name in material_names(bodies):
        material = MATERIALS[name]
        red, green, blue = (value / 255 for value in material.colour)
        lines += [
            f"newmtl {name}",
            f"# {EDITION}: {material.itu_type}",
            f"Kd {red:.3f} {green:.3f} {blue:.3f}",
            "illum 1",
            *(more or {}).get(name, ()),
        ]
    return ("\n".join(lines) + "\n").encode()


def material_names(bodies: Sequence[Body]) -> list[str]:
    """Names of all materials of the meshes, in the order in which they first appear."""
    return list(dict.fromkeys(faces.material for body in bodies for faces in body.faces))


def ply(bodies: Sequence[Body], frame: Frame) -> bytes:
    """Binary PLY. Each face has its kind and the number of its building; comments map these numbers to ids."""
    vertex, triangle, kind, building = _joined(bodies, frame)
    face = np.zeros(len(triangle), _PLY_FACE)
    face["count"], face["vertex"], face["kind"], face["building"] = 3, triangle, kind, building
    buildings = [building for body in bodies for building in body.buildings]
    kinds = ", ".join(f"{int(number)} {name}" for number, name in SURFACE_NAMES.items())
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment p2wss {__version__}; metres; x east, y north, z up",
        f"comment crs {frame.crs}",
        f"comment origin_m {frame.origin} (add it to every vertex)",
        f"comment kind: {kinds}",
        *(f"comment building {number} {_word(ref.building_id)}" for number, ref in enumerate(buildings)),
        f"element vertex {len(vertex)}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "property uchar kind",
        "property int building",
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode() + vertex.tobytes() + face.tobytes()


def stl(bodies: Sequence[Body], frame: Frame) -> bytes:
    """Binary STL of all meshes together. The header of 80 bytes has the origin and as much of the CRS as fits."""
    vertex, triangle, _, _ = _joined(bodies, frame)
    face = np.zeros(len(triangle), _STL_FACE)
    face["corner"] = vertex["xyz"][triangle]
    face["normal"] = unit_normals(face["corner"].astype(float))
    # readers take a header that begins with "solid" for the text format
    header = f"p2wss metres z up origin_m {frame.origin} crs {frame.crs}".encode("ascii", "replace")[:80]
    return header.ljust(80) + len(face).to_bytes(4, "little") + face.tobytes()


def file_names(names: Sequence[str]) -> list[str]:
    """File names that differ on every file system, also on one that ignores case or allows only 255 bytes.

    >>> file_names(["A/1", "a_1", "..", "Ö 2"])
    ['A_1', 'a_1-2', '_', 'Ö_2']
    """
    words = [re.sub(r"[^\w.-]", "_", name).strip(".")[:100].encode()[:200] for name in names]
    return _distinct([word.decode(errors="ignore") or "_" for word in words], str.lower)


def _distinct(names: Iterable[str], same: Callable[[str], str] = str) -> list[str]:
    """The names, made distinct: a name that is the ``same`` as an earlier one gets its number, from 1, as a suffix."""
    result: list[str] = []
    used: set[str] = set()
    for number, name in enumerate(names, 1):
        while same(name) in used:
            name = f"{name}-{number}"
        used.add(same(name))
        result.append(name)
    return result


def _joined(bodies: Sequence[Body], frame: Frame) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(vertices (:data:`_VERTEX`), triangles, kind of each triangle, number of its building) of all meshes.

    Buildings are numbered mesh by mesh, in the order of each mesh's ``buildings``.
    """
    whole = Mesh.joined([body.mesh for body in bodies])
    vertex = np.zeros(len(whole.vertex_m), _VERTEX)
    vertex["xyz"] = whole.vertex_m - frame.origin_m
    first = np.cumsum([0, *(len(body.buildings) for body in bodies)])
    building = [body.building + start for body, start in zip(bodies, first, strict=False)]
    return vertex, whole.triangle, whole.kind, np.concatenate([np.zeros(0, int), *building])


def _word(name: str) -> str:
    """The name with "_" in place of white space, which would end a name in these formats."""
    return "_".join(name.split()) or "_"
