"""Meshes as a binary glTF 2.0 file: metres, y up as glTF prescribes, CRS and origin in the extras.

Specification: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html .
"""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from p2wss import __version__
from p2wss.formats.materials import EDITION, MATERIALS
from p2wss.formats.meshes import Body, Frame, material_names

ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
FLOAT, UNSIGNED_INT = 5126, 5125
_AXES = "x = easting - origin_m[0], y = height - origin_m[2], z = origin_m[1] - northing; metres"


def glb(bodies: Sequence[Body], frame: Frame, facts: dict[str, Any]) -> bytes:
    """The bytes of a GLB with one node per mesh below a root node, and one primitive per material. All primitives of a
    mesh share its vertices.

    A point (x, y, z) of the CRS has the coordinates (x - x0, z - z0, y0 - y) in the file, with
    ``frame.origin_m`` = (x0, y0, z0). Extras of the asset: CRS, origin and axes, and ``facts`` under ``p2wss``. Extras
    of the root node, which readers keep as properties of an object: CRS, origin and axes. Extras of a node: the ids and
    materials of its buildings. Extras of a primitive, under ``triangles``: pairs of a building's id and the number of
    its triangles, in the order of the triangles. Extras of a material: its type in ITU-R P.2040 and the edition.
    """
    place = {"crs": frame.crs, "origin_m": [float(value) for value in frame.origin_m], "axes": _AXES}
    binary = Binary()
    names = material_names(bodies)
    nodes = [
        {"name": body.name, "mesh": number, "extras": {**_extras(body), **body.attributes}}
        for number, body in enumerate(bodies)
    ]
    shapes = [{"name": body.name, "primitives": _primitives(body, frame, names, binary)} for body in bodies]
    # glTF has no empty lists
    children = {"children": list(range(1, len(nodes) + 1))} if nodes else {}
    root = {"name": "p2wss", **children, "extras": place}
    tree = {
        "asset": {
            "version": "2.0",
            "generator": f"p2wss {__version__}",
            "extras": {"p2wss": facts, **place},
        },
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [root, *nodes],
        "meshes": shapes,
        "materials": [gltf_material(name) for name in names],
        "accessors": binary.accessors,
        "bufferViews": binary.views,
        "buffers": [{"byteLength": len(binary.content)}] if binary.content else [],
    }
    text = json.dumps({key: value for key, value in tree.items() if value != []}, separators=(",", ":"))
    content = _chunk(b"JSON", text.encode(), b" ")
    if binary.content:
        content += _chunk(b"BIN\0", bytes(binary.content), b"\0")
    return struct.pack("<4sII", b"glTF", 2, 12 + len(content)) + content


@dataclass
class Binary:
    """The binary chunk, array by array, and the accessors that describe it."""

    content: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def append(self, values: np.ndarray, target: int, **accessor: Any) -> int:
        """Append an array, and return the number of its accessor. Elements must have four bytes, so that every array is
        aligned."""
        self.views.append(
            {"buffer": 0, "byteOffset": len(self.content), "byteLength": values.nbytes, "target": target}
        )
        self.accessors.append({"bufferView": len(self.views) - 1, "count": len(values), **accessor})
        self.content += values.tobytes()
        return len(self.accessors) - 1


def _primitives(body: Body, frame: Frame, names: Sequence[str], binary: Binary) -> list[dict[str, Any]]:
    x, y, z = (body.mesh.vertex_m - frame.origin_m).T
    vertex = np.column_stack([x, z, -y]).astype("<f4")
    bounds = {"min": vertex.min(axis=0).tolist(), "max": vertex.max(axis=0).tolist()}
    position = binary.append(vertex, ARRAY_BUFFER, componentType=FLOAT, type="VEC3", **bounds)
    pieces: dict[str, list[tuple[str, np.ndarray]]] = {}
    for faces in body.faces:
        pieces.setdefault(faces.material, []).append((faces.building_id, faces.triangle))
    result = []
    for material, parts in pieces.items():
        rows = np.concatenate([triangle for _, triangle in parts])
        corner = body.mesh.triangle[rows].astype("<u4").ravel()
        primitive = {
            "attributes": {"POSITION": position},
            "indices": binary.append(corner, ELEMENT_ARRAY_BUFFER, componentType=UNSIGNED_INT, type="SCALAR"),
            "material": names.index(material),
            "extras": {"triangles": [[building_id, len(triangle)] for building_id, triangle in parts]},
        }
        result.append(primitive)
    return result


def _extras(body: Body) -> dict[str, Any]:
    materials: dict[str, dict[str, str]] = {ref.building_id: {} for ref in body.buildings}
    for faces in body.faces:
        materials[faces.building_id][faces.surface] = faces.material
    if len(materials) == 1:
        ((building_id, surfaces),) = materials.items()
        return {"building_id": building_id, "materials": surfaces}
    return {"building_ids": list(materials), "materials": materials}


def gltf_material(name: str) -> dict[str, Any]:
    material = MATERIALS[name]
    # glTF's colours are linear
    color = [round((value / 255) ** 2.2, 4) for value in material.colour]
    return {
        "name": name,
        "pbrMetallicRoughness": {
            "baseColorFactor": [*color, 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": 0.9,
        },
        "extras": {"itu_r_p2040": material.itu_type, "edition": EDITION},
    }


def _chunk(kind: bytes, content: bytes, padding: bytes) -> bytes:
    content += padding * (-len(content) % 4)
    return struct.pack("<I4s", len(content), kind) + content
