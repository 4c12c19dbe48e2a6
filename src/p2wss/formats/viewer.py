"""Buildings in 3D on a page: points and meshes as data, and the scripts that draw them.

Data and scripts are embedded in the page. Points are whole centimetres in int16, vertices whole millimetres in int32,
both in base64.
"""

import base64
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from itertools import takewhile
from typing import Any

import numpy as np

from p2wss.formats.materials import MATERIALS, materials_of
from p2wss.formats.meshes import SURFACE_NAMES
from p2wss.mesh import Mesh
from p2wss.skeleton.types import FaceKind

FACE_COLORS = {
    FaceKind.GROUND: "#9a9a9a",
    FaceKind.WALL: "#e8dfd0",
    FaceKind.ROOF: "#c8603a",
    FaceKind.FLAT: "#d9a06b",
    FaceKind.FLOOR: "#b5bd9c",
}
# states of a building by its attributes, as in the legend
OK, FLAGGED, FLAT, NONE = "ok", "flagged", "flat", "none"
PLANT_COLOR, OTHER_COLOR, GROUND_COLOR = "#5f9350", "#b9b4ab", "#cfd4c9"
# colours of the files that are compared with the first file
OTHER_COLORS = ("#2a6f97", "#3f7d4e", "#b8a13c", "#6c757d")
# attribute: title of its column in the table; the table is sorted by the first attribute
COLUMNS = {
    "residual_m": "distance of the points (m)",
    "state": "state",
    "reason": "reason",
    "footprint_flags": "footprint",
    "roof_type": "roof",
    "num_points": "points",
    "num_triangles": "triangles",
}


@dataclass(frozen=True)
class Layer:
    """Meshes of one source. is_ours: distances of points are measured to these meshes, and their faces are coloured by
    kind."""

    key: str
    name: str
    color: str
    is_ours: bool


# footprints without a mesh, as flat meshes
OUTLINES = Layer("outlines", "Footprints without a mesh", "#b3261e", is_ours=False)


@dataclass(frozen=True)
class Place:
    """The surroundings of the buildings of a scene. plants, others (buildings without attributes), ground: in the frame
    of the buildings; a reader can hide them. crs: name of the CRS. meanings: of reasons and flags."""

    plants: Sequence[Mesh] = ()
    others: Sequence[Mesh] = ()
    ground: Mesh | None = None
    crs: str = ""
    meanings: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Shown:
    """A building on the page. meshes: by the keys of their layers. point_m: (n, 3), in the frame of the meshes.
    distance_m: (n,), distances of the points to the mesh of the layer with ``is_ours``. group, title, about: used if
    one building is shown at a time. materials: of surfaces; None: taken from the attributes."""

    building_id: str
    meshes: Mapping[str, Mesh]
    point_m: np.ndarray
    distance_m: np.ndarray
    attributes: Mapping[str, Any] = field(default_factory=dict)
    group: str = ""
    title: str = ""
    about: str = ""
    materials: Mapping[str, str] | None = None


def viewer(
    buildings: Sequence[Shown], layers: Sequence[Layer], together: bool, place: Place = Place()
) -> dict[str, Any]:
    """The values that a template embeds: the data of the buildings as JSON, three.js, and the script that draws the
    data. buildings: at least one. together: whether all are shown together, or one at a time."""
    plants, others = Mesh.joined(place.plants), Mesh.joined(place.others)
    around = (
        ("plants", "Vegetation", PLANT_COLOR, plants),
        ("others", "Other buildings", OTHER_COLOR, others.part(others.kind != FaceKind.GROUND)),
        ("ground", "Ground", GROUND_COLOR, place.ground or Mesh.empty()),
    )
    data = {
        "kinds": [FACE_COLORS[kind] for kind in sorted(FACE_COLORS)],
        # the surface of each kind, as materials are by the name of the surface
        "surfaces": [SURFACE_NAMES[kind] for kind in sorted(FACE_COLORS)],
        "methods": [
            {"key": layer.key, "name": layer.name, "color": layer.color, "ours": layer.is_ours}
            | {"shown": layer.is_ours or layer == OUTLINES}
            for layer in layers
        ],
        "together": together,
        "around": [
            {"key": key, "name": name, "color": color, **_mesh(mesh)}
            for key, name, color, mesh in around
            if len(mesh.triangle)
        ],
        "crs": place.crs,
        "meanings": place.meanings,
        "materials": {name: "#{:02x}{:02x}{:02x}".format(*each.colour) for name, each in MATERIALS.items()},
        "buildings": [_building(building) for building in buildings],
    }
    assets = files("p2wss.formats") / "assets"
    # "</script>" in a building's id must not end the element
    text = json.dumps(data, separators=(",", ":"), default=str).replace("<", "\\u003c")
    library, script = ((assets / name).read_text("utf-8") for name in ("three.min.js", "viewer.js"))
    return {"data": text, "library": library, "script": script, "together": together}


def scene_page(
    title: str,
    summary: Sequence[str],
    buildings: Sequence[Shown],
    layers: Sequence[Layer],
    place: Place = Place(),
) -> str:
    """A page with all buildings in one picture and in a table.

    summary: sentences above.
    """
    buildings = sorted(buildings, key=lambda building: -(number(building.attributes, "residual_m") or 0.0))
    present = {
        name for building in buildings for name, value in building.attributes.items() if value is not None
    }
    return str(
        environment("p2wss.formats")
        .get_template("scene.html.j2")
        .render(
            title=title,
            summary=summary,
            viewer=viewer(buildings, layers, together=True, place=place) if buildings else None,
            columns={name: text for name, text in COLUMNS.items() if name in present or name == "state"},
        )
    )


def environment(*packages: str) -> Any:
    """The environment of jinja2 for templates in the folders ``templates`` of packages, such as ``p2wss.eval``: text
    from the data is escaped.

    A template that uses an undefined value raises ``jinja2.UndefinedError``. Lines that hold only a statement leave
    no blank lines in the page.
    """
    import jinja2  # only once a page is written

    return jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(package) for package in packages]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _building(building: Shown) -> dict[str, Any]:
    point_m = building.point_m
    place_m = np.round(point_m.mean(axis=0)) if len(point_m) else np.zeros(3)
    near = (np.abs(point_m - place_m) <= np.iinfo(np.int16).max // 100).all(axis=1)
    point_m, distance_m = point_m[near], building.distance_m[near]
    corners = np.concatenate([point_m, *(mesh.vertex_m for mesh in building.meshes.values())])
    bounds_m = [corners.min(axis=0), corners.max(axis=0)] if len(corners) else np.zeros((2, 3))
    return {
        "id": building.building_id,
        "group": building.group,
        "title": building.title,
        "about": building.about,
        "state": _state(building),
        "residual": number(building.attributes, "residual_m"),
        "height": _height_m(building),
        "attributes": {name: _exact(value) for name, value in building.attributes.items()},
        # the columns of the input come before p2wss's attribute status
        "inputs": list(takewhile(lambda name: name != "status", building.attributes))
        if "status" in building.attributes
        else [],
        "materials": materials_of(building.attributes) if building.materials is None else building.materials,
        "bounds": np.round(bounds_m, 2).tolist(),
        "place": place_m.tolist(),
        "points": _base64(np.round((point_m - place_m) * 100).astype(np.int16)),
        "distances": _base64(np.round(np.clip(distance_m, 0, 1) * 255).astype(np.uint8)),
        "meshes": {key: _mesh(mesh) for key, mesh in building.meshes.items()},
    }


def _mesh(mesh: Mesh) -> dict[str, str]:
    return {
        "vertices": _base64(np.round(mesh.vertex_m * 1000).astype(np.int32)),
        "triangles": _base64(mesh.triangle.astype(np.uint32)),
        "kinds": _base64(mesh.kind.astype(np.uint8)),
        "facts": f"{len(mesh.triangle)} triangles",
    }


def _state(building: Shown) -> str:
    if not building.meshes.keys() - {OUTLINES.key}:
        return NONE
    if building.attributes.get("status") == FLAT:
        return FLAT
    flags = ("not_representable", "footprint_flags")
    return FLAGGED if any(building.attributes.get(name) for name in flags) else OK


def number(attributes: Mapping[str, Any], name: str) -> float | None:
    """The attribute as a number; None if it is missing, or is no finite number, as attributes of other programs."""
    value = attributes.get(name)
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def _height_m(building: Shown) -> float | None:
    """The height of a building by its attributes, or if it lacks them, as of another program, the height of its meshes;
    None without a mesh."""
    top_m, ground_m = (number(building.attributes, name) for name in ("roof_z_max_m", "ground_z_m"))
    if top_m is not None and ground_m is not None:
        return top_m - ground_m
    z_m = [mesh.vertex_m[:, 2] for key, mesh in building.meshes.items() if key != OUTLINES.key]
    return float(np.ptp(np.concatenate(z_m))) if any(map(len, z_m)) else None


def _exact(value: Any) -> Any:
    """The value as scripts can read it: None for NaN, which JSON lacks; text for integers of more than 53 bits."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, int) and abs(value) > 2**53 else value


def _base64(values: np.ndarray) -> str:
    little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return base64.b64encode(little.tobytes()).decode()
