"""A scene for Sionna RT: a folder with Mitsuba XML, one plain PLY per shape, the top of the terrain, and a JSON.

``sionna.rt.load_scene("STEM_sionna/scene.xml", merge_shapes=False)`` reads it. Sionna RT finds edges that diffract only
within a shape, and a shape has only one material. So a shape is by default a whole solid.
"""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import pyproj
import scipy
import shapely

from p2wss import __version__
from p2wss.formats.materials import EDITION, MATERIALS, Properties, properties
from p2wss.formats.meshes import AXES, Body, Frame, file_names, material_names
from p2wss.mesh import Mesh
from p2wss.skeleton.types import FaceKind
from p2wss.storage.messages import log

_PLY_FACE = np.dtype([("count", "u1"), ("vertex", "<i4", 3)])
TERRAIN_TOP = "terrain_top.ply"
# most squares of the top of the terrain: 4 km by 4 km in squares of 2 m, which take 1.6 GB
_MAX_SQUARES = 4_000_000


@dataclass(frozen=True)
class _Shape:
    """A shape of the scene: a body, or the piece of a body with one material."""

    name: str
    buildings: list[str]
    material: str
    mesh: Mesh


def scene_files(
    bodies: Sequence[Body],
    frame: Frame,
    facts: Mapping[str, Any],
    frequency_ghz: float,
    split_materials: bool = False,
    map_cell_m: float = 2.0,
) -> dict[str, bytes]:
    """The contents of the files by their names, relative to the folder; ``scene.xml`` is the last.

    split_materials: make a shape of each material of a mesh. Otherwise a mesh is one shape, with the material of the
    largest part of its wall area. map_cell_m: size of the squares of the terrain's top.
    """
    terrain = [body for body in bodies if body.is_terrain]
    plants = [body for body in bodies if body.is_plant]
    others = [body for body in bodies if not (body.is_terrain or body.is_plant)]
    shapes = [shape for body in (*terrain, *others) for shape in _shapes(body, split_materials)]
    if plants:
        (material,) = material_names(plants)
        shapes.append(_Shape("vegetation", [], material, Mesh.joined([body.mesh for body in plants])))
    # ids are ASCII without points: Sionna RT reads the XML in the encoding of the system, Mitsuba reserves the point
    ids = file_names([re.sub(r"[^A-Za-z0-9_-]", "_", shape.name) for shape in shapes])
    materials = {
        name: properties(MATERIALS[name].itu_type, frequency_ghz)
        for name in dict.fromkeys(shape.material for shape in shapes)
    }
    files = {
        f"meshes/{name}.ply": _ply(shape.mesh.vertex_m - frame.origin_m, shape.mesh.triangle)
        for shape, name in zip(shapes, ids, strict=True)
    }
    latitude_deg, longitude_deg = _wgs84(frame)
    is_mixed = any(len(material_names([body])) > 1 for body in others)
    remarks = notes(materials, frequency_ghz, bool(terrain), is_mixed, split_materials)
    for body in terrain[:1]:
        cell_m = map_cell_m * np.ceil(
            np.sqrt(np.ptp(body.mesh.vertex_m[:, :2], axis=0).prod() / _MAX_SQUARES) / map_cell_m
        )
        if cell_m > map_cell_m:
            remarks.append(
                f"the squares of {TERRAIN_TOP} have {cell_m:g} m, not {map_cell_m:g}: the terrain is large"
            )
            log.warning("warning: %s", remarks[-1])
        files[TERRAIN_TOP] = _top(body.mesh, others, frame, cell_m)
    document = {
        "p2wss": dict(facts),
        "crs": frame.crs,
        "origin_m": frame.origin_m.tolist(),
        "origin_wgs84": {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg},
        "axes": AXES,
        "frequency_ghz": frequency_ghz,
        "materials": {name: _facts(name, values) for name, values in materials.items()},
        "shapes": {
            name: {
                "file": f"meshes/{name}.ply",
                "material": shape.material,
                "buildings": shape.buildings,
            }
            for shape, name in zip(shapes, ids, strict=True)
        },
        "terrain_top": TERRAIN_TOP if terrain else None,
        "notes": remarks,
    }
    files["scene.json"] = (json.dumps(document, indent=1, ensure_ascii=False) + "\n").encode()
    comments = [
        f"p2wss {__version__}; metres; x east, y north, z up",
        f"crs {frame.crs}",
        f"origin_m {frame.origin} (add it to every vertex)",
        f"origin in WGS 84: latitude {latitude_deg}, longitude {longitude_deg}",
        *remarks,
    ]
    material_of_mesh = {name: shape.material for name, shape in zip(ids, shapes, strict=True)}
    files["scene.xml"] = _xml(comments, materials, material_of_mesh, frequency_ghz)
    return files


def _xml(
    comments: Sequence[str],
    materials: Mapping[str, Properties],
    material_of_mesh: Mapping[str, str],
    frequency_ghz: float,
) -> bytes:
    """The scene as Mitsuba reads it, in ASCII. material_of_mesh: names of materials by names of meshes."""
    lines = [f"<!-- {_comment(comment)} -->" for comment in comments]
    lines.append('<scene version="2.1.0">')
    for name, values in materials.items():
        lines += _bsdf(name, values, frequency_ghz)
    for name, material in material_of_mesh.items():
        lines += [
            f'    <shape type="ply" id={quoteattr(f"mesh-{name}")}>',
            f'        <string name="filename" value={quoteattr(f"meshes/{name}.ply")}/>',
            '        <boolean name="face_normals" value="true"/>',
            f'        <ref id="{_bsdf_id(material, materials[material], frequency_ghz)}" name="bsdf"/>',
            "    </shape>",
        ]
    lines.append("</scene>")
    return ("\n".join(lines) + "\n").encode("ascii", "xmlcharrefreplace")


def notes(
    materials: Collection[str],
    frequency_ghz: float,
    has_terrain: bool,
    is_mixed: bool,
    split_materials: bool,
) -> list[str]:
    """Notes for the user of the scene: materials not defined at the frequency, a missing ground, wedges.

    materials: of the shapes. is_mixed: whether a building has several materials.
    """
    result = []
    for itu_type in dict.fromkeys(MATERIALS[name].itu_type for name in materials):
        values = properties(itu_type, frequency_ghz)
        if values.held_from_ghz is not None:
            low, high = values.valid_ghz
            result.append(
                f"{EDITION} defines {itu_type} from {low:g} to {high:g} GHz, not at {frequency_ghz:g} GHz"
                f" (--frequency-ghz); the scene uses its permittivity at {values.held_from_ghz:g} GHz"
            )
    if not has_terrain:
        result.append("the scene has no ground; --terrain adds it")
    if is_mixed and split_materials:
        result.append(
            "shapes are split by material; Sionna RT does not find diffracting edges between two shapes"
        )
    elif is_mixed:
        result.append(
            "each shape has the material of most of its walls, because Sionna RT finds diffracting edges only within a"
            " shape; --split-materials writes one shape per material"
        )
    return result


def _shapes(body: Body, split_materials: bool) -> list[_Shape]:
    mesh = body.mesh
    by_material: dict[str, list[np.ndarray]] = {}
    wall_m2: dict[str, float] = {}
    for piece in body.faces:
        by_material.setdefault(piece.material, []).append(piece.triangle)
        weight = mesh.area_m2[piece.triangle].sum() * (1.0 if piece.surface == "wall" else 1e-6)
        wall_m2[piece.material] = wall_m2.get(piece.material, 0.0) + weight
    buildings = [] if body.is_terrain else [ref.building_id for ref in body.buildings]
    if not split_materials or len(by_material) == 1:
        material = max(wall_m2, key=wall_m2.__getitem__)
        return [_Shape(body.name, buildings, material, mesh)]
    return [
        _Shape(f"{body.name}-{material}", buildings, material, mesh.part(np.concatenate(rows)))
        for material, rows in by_material.items()
    ]


def _top(terrain: Mesh, buildings: Sequence[Body], frame: Frame, cell_m: float) -> bytes:
    """PLY of the upper side of the terrain, in squares of ``cell_m`` with two triangles each. Squares with their centre
    in a building are left out. A radio map has a value per triangle."""
    local = terrain.vertex_m - frame.origin_m
    top = local[np.unique(terrain.triangle[terrain.doubled_m2[:, 2] > 0])]
    low, high = top[:, :2].min(axis=0), top[:, :2].max(axis=0)
    counts = np.maximum(np.floor((high - low) / cell_m).astype(int), 1)
    x, y = (start + cell_m * np.arange(count + 1) for start, count in zip(low, counts, strict=True))
    node = np.column_stack([values.ravel() for values in np.meshgrid(x, y)])
    height = scipy.interpolate.LinearNDInterpolator(top[:, :2], top[:, 2])(node)
    # by rounding, nodes of the border may be outside
    outside = np.isnan(height)
    height[outside] = scipy.interpolate.NearestNDInterpolator(top[:, :2], top[:, 2])(node[outside])
    number = np.arange(len(node)).reshape(len(y), len(x))
    a, b, c, d = (
        corners.ravel() for corners in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    )
    is_free = ~_are_covered((node[a] + node[c]) / 2, buildings, frame)
    triangle = np.column_stack([a, b, c, a, c, d])[is_free].reshape(-1, 3)
    used, triangle = np.unique(triangle, return_inverse=True)
    return _ply(np.column_stack([node, height])[used], triangle.reshape(-1, 3))


def _are_covered(point_m: np.ndarray, buildings: Sequence[Body], frame: Frame) -> np.ndarray:
    """bool (n,): which of the points (n, 2) are in the footprint of a building."""
    # all faces but walls are used, as a skin that ends on the terrain has no floor
    surfaces = [
        body.mesh.corner_m[body.mesh.kind != FaceKind.WALL, :, :2] - frame.origin_m[:2] for body in buildings
    ]
    tree = shapely.STRtree(np.asarray(shapely.polygons(np.concatenate([np.zeros((0, 3, 2)), *surfaces]))))
    covered = np.zeros(len(point_m), bool)
    covered[tree.query(shapely.points(point_m), predicate="intersects")[0]] = True
    return covered


def _ply(vertex_m: np.ndarray, triangle: np.ndarray) -> bytes:
    """Binary PLY with only vertices and triangles, as Mitsuba warns of every other property."""
    face = np.zeros(len(triangle), _PLY_FACE)
    face["count"], face["vertex"] = 3, triangle
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertex_m)}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode() + vertex_m.astype("<f4").tobytes() + face.tobytes()


def _bsdf_id(name: str, values: Properties, frequency_ghz: float) -> str:
    """The id of a material. A material with constant properties needs another id than its ITU type, which Sionna RT
    would reject."""
    if values.held_from_ghz is None:
        return f"mat-{name}"
    return f"mat-{name}-{round(frequency_ghz * 1000)}-MHz"


def _bsdf(name: str, values: Properties, frequency_ghz: float) -> list[str]:
    material = MATERIALS[name]
    color = ", ".join(f"{value / 255:.3f}" for value in material.colour)
    if values.held_from_ghz is None:
        kind, rows = "itu-radio-material", [f'<string name="type" value="{material.itu_type}"/>']
    else:
        kind = "radio-material"
        rows = [
            f'<float name="relative_permittivity" value="{values.relative_permittivity:.6g}"/>',
            f'<float name="conductivity" value="{values.conductivity_s_per_m:.6g}"/>',
        ]
    rows += ['<float name="thickness" value="0.1"/>', f'<rgb name="color" value="{color}"/>']
    return [
        f'    <bsdf type="{kind}" id="{_bsdf_id(name, values, frequency_ghz)}">',
        *(f"        {row}" for row in rows),
        "    </bsdf>",
    ]


def _facts(name: str, values: Properties) -> dict[str, Any]:
    return {
        "itu_r_p2040": MATERIALS[name].itu_type,
        "edition": EDITION,
        "relative_permittivity": round(values.relative_permittivity, 6),
        "conductivity_s_per_m": round(values.conductivity_s_per_m, 6),
        "valid_ghz": list(values.valid_ghz),
        "held_from_ghz": values.held_from_ghz,
    }


def _wgs84(frame: Frame) -> tuple[float | None, float | None]:
    """Latitude and longitude of the origin in degrees; (None, None) if the CRS has no transformation to WGS 84."""
    try:
        to_wgs84 = pyproj.Transformer.from_crs(frame.crs, 4326, always_xy=True)
        longitude, latitude = to_wgs84.transform(*frame.origin_m[:2], errcheck=True)
    except pyproj.exceptions.ProjError:
        return None, None
    return round(latitude, 8), round(longitude, 8)


def _comment(text: str) -> str:
    """The text without double hyphens, which XML forbids in a comment; an option loses its hyphens."""
    return re.sub(r"--+", "-", re.sub(r"(?<=[ (])--", "", " ".join(text.split()))).rstrip("-")
