"""A strict reader of the scenes for Sionna RT: what its loader and Mitsuba's PLY plugin take without a warning."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

# the keys of sionna.rt.radio_materials.itu.ITU_MATERIALS_PROPERTIES, sionna-rt 2.2.0
ITU_TYPES = {
    "vacuum", "concrete", "brick", "plasterboard", "wood", "glass", "clear_acrylic", "ceiling_board", "chipboard",
    "plywood", "marble", "floorboard", "vinyl_tile", "carpet_tile", "asphalt_concrete", "metal", "very_dry_ground",
    "medium_dry_ground", "wet_ground",
}  # fmt: skip


@dataclass(frozen=True)
class Shape:
    material: str
    vertex_m: np.ndarray
    triangle: np.ndarray


@dataclass(frozen=True)
class Scene:
    """shapes: by their ids. materials: attributes of the BSDFs by their ids. comments: of the XML."""

    shapes: dict[str, Shape]
    materials: dict[str, dict[str, str]]
    comments: list[str]
    facts: dict[str, Any]


def read(folder: Path) -> Scene:
    """The scene of a folder, every rule asserted; the files of the folder are exactly those that it names."""
    content = (folder / "scene.xml").read_bytes()
    # Sionna RT opens it in the encoding of the system
    text = content.decode("ascii")
    assert "\r" not in text
    root = ET.fromstring(text)
    assert root.tag == "scene" and root.attrib == {"version": "2.1.0"}
    materials: dict[str, dict[str, str]] = {}
    shapes: dict[str, Shape] = {}
    names = {"scene.xml", "scene.json"}
    for element in root:
        name = element.attrib["id"]
        # a point is Mitsuba's separator of the parts of a path
        assert re.fullmatch(r"[A-Za-z0-9_-]+", name), name
        assert name not in materials and name.removeprefix("mesh-") not in shapes
        values = {child.attrib["name"]: child for child in element}
        assert len(values) == len(element)
        if element.tag == "bsdf":
            assert name.startswith("mat-")
            materials[name] = _material(element.attrib["type"], name, values)
            continue
        assert element.tag == "shape" and element.attrib["type"] == "ply" and name.startswith("mesh-")
        assert set(values) == {"filename", "face_normals", "bsdf"}
        assert values["face_normals"].tag == "boolean" and values["face_normals"].attrib["value"] == "true"
        file, ref = values["filename"].attrib["value"], values["bsdf"].attrib["id"]
        assert ref in materials and values["bsdf"].tag == "ref" and file not in names
        names.add(file)
        shapes[name.removeprefix("mesh-")] = Shape(ref, *read_ply(folder / file))
    facts = json.loads((folder / "scene.json").read_text())
    assert set(facts["shapes"]) == set(shapes) and set(facts["materials"]) == {
        re.sub(r"^mat-|-\d+-MHz$", "", name) for name in materials
    }
    assert {shape.material for shape in shapes.values()} == set(materials)
    if facts["terrain_top"]:
        names.add(facts["terrain_top"])
    assert {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()} == names
    return Scene(shapes, materials, re.findall(r"<!-- (.*?) -->", text), facts)


def _material(kind: str, name: str, values: dict[str, ET.Element]) -> dict[str, str]:
    if kind == "itu-radio-material":
        assert set(values) == {"type", "thickness", "color"} and values["type"].attrib["value"] in ITU_TYPES
    else:
        assert kind == "radio-material"
        assert set(values) == {"relative_permittivity", "conductivity", "thickness", "color"}
        # load_scene refuses the name of a type for another kind of material
        assert name.removeprefix("mat-") not in ITU_TYPES
        assert float(values["relative_permittivity"].attrib["value"]) >= 1
    red, green, blue = map(float, values["color"].attrib["value"].split(","))
    assert max(red, green, blue) <= 1 and min(red, green, blue) >= 0
    return {"kind": kind} | {key: element.attrib["value"] for key, element in values.items()}


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a PLY that has nothing else; every vertex is used and differs from the others."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    pattern = (
        r"ply\nformat binary_little_endian 1\.0\nelement vertex (\d+)\nproperty float x\nproperty float y\n"
        r"property float z\nelement face (\d+)\nproperty list uchar int vertex_indices\n"
    )
    match = re.fullmatch(pattern, header.decode("ascii"))
    assert match, header
    num_vertices, num_faces = map(int, match.groups())
    assert len(body) == 12 * num_vertices + 13 * num_faces
    vertex_m = np.frombuffer(body, "<f4", 3 * num_vertices).reshape(-1, 3)
    face = np.frombuffer(body, [("count", "u1"), ("vertex", "<i4", 3)], num_faces, 12 * num_vertices)
    assert (face["count"] == 3).all()
    triangle = face["vertex"]
    assert set(np.unique(triangle)) == set(range(num_vertices))
    assert len(np.unique(vertex_m, axis=0)) == num_vertices
    return vertex_m, triangle
