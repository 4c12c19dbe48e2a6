"""CityJSON 2.0 as a text sequence (CityJSONSeq: one header line, then one feature per building) or one document.

Specifications: https://www.cityjson.org/specs/2.0.1/ and https://www.cityjson.org/cityjsonseq/ .
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mapbox_earcut
import numpy as np

from p2wss.data.solids.faces import Surface
from p2wss.data.solids.repair import SCALE_M, stored
from p2wss.errors import InputError
from p2wss.skeleton.types import FaceKind

SURFACE_TYPE = {
    FaceKind.GROUND: "GroundSurface",
    FaceKind.WALL: "WallSurface",
    FaceKind.ROOF: "RoofSurface",
    FaceKind.FLAT: "RoofSurface",
}
_KIND = {"GroundSurface": FaceKind.GROUND, "WallSurface": FaceKind.WALL, "RoofSurface": FaceKind.ROOF}


@dataclass(frozen=True)
class Solid:
    """A building to write: vertex_m float64 (v, 3) in the CRS, surfaces, and attributes of JSON types.

    Without surfaces it becomes a Building without geometry.
    """

    building_id: str
    vertex_m: np.ndarray
    surfaces: Sequence[Surface]
    attributes: dict[str, Any] = field(default_factory=dict)


def reference_system(epsg: int) -> str:
    """The URL of a CRS in the form that CityJSON requires.

    >>> reference_system(2154)
    'https://www.opengis.net/def/crs/EPSG/0/2154'
    """
    return f"https://www.opengis.net/def/crs/EPSG/0/{epsg}"


def lines(solids: Iterable[Solid], epsg: int | None, lod: str = "2.0") -> Iterator[str]:
    """The lines of a CityJSONSeq, header first, without line ends. The first solid defines the local origin."""
    translate = [0.0, 0.0, 0.0]
    started = False
    for solid in solids:
        if not started:
            if len(solid.vertex_m):
                translate = [float(v) for v in np.floor(np.asarray(solid.vertex_m).min(axis=0))]
            yield _compact(_header(translate, epsg))
            started = True
        yield _compact(_feature(solid, np.array(translate), lod))
    if not started:
        yield _compact(_header(translate, epsg))


def document(solids: Sequence[Solid], epsg: int | None, lod: str = "2.0") -> str:
    """The same content as :func:`lines`, as a single CityJSON object."""
    texts = map(json.loads, lines(solids, epsg, lod))
    city = next(texts)
    vertices: list[list[int]] = city["vertices"]
    for feature in texts:
        first = len(vertices)
        vertices += feature["vertices"]
        for city_object in feature["CityObjects"].values():
            for geometry in city_object.get("geometry", []):
                geometry["boundaries"] = [
                    [[[vertex + first for vertex in ring] for ring in rings] for rings in shell]
                    for shell in geometry["boundaries"]
                ]
        city["CityObjects"] |= feature["CityObjects"]
    if vertices:
        corner = np.array(vertices) * SCALE_M + city["transform"]["translate"]
        extent = [*corner.min(axis=0), *corner.max(axis=0)]
        city.setdefault("metadata", {})["geographicalExtent"] = [round(float(v), 4) for v in extent]
    return _compact(city)


def _header(translate: list[float], epsg: int | None) -> dict[str, Any]:
    header: dict[str, Any] = {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [SCALE_M] * 3, "translate": translate},
        "CityObjects": {},
        "vertices": [],
    }
    if epsg is not None:
        header["metadata"] = {"referenceSystem": reference_system(epsg)}
    return header


def _feature(solid: Solid, translate: np.ndarray, lod: str) -> dict[str, Any]:
    grid, surfaces = stored(solid.vertex_m, solid.surfaces)
    grid = grid - np.round(translate / SCALE_M).astype(np.int64)
    shell = [[[int(vertex) for vertex in ring] for ring in surface.rings] for surface in surfaces]
    kinds = [SURFACE_TYPE[FaceKind(surface.kind)] for surface in surfaces]
    # a vertex within a face is in no ring
    used = sorted({vertex for rings in shell for ring in rings for vertex in ring})
    number = {vertex: position for position, vertex in enumerate(used)}
    shell = [[[number[vertex] for vertex in ring] for ring in rings] for rings in shell]
    building: dict[str, Any] = {"type": "Building", "attributes": solid.attributes}
    if shell:
        types = sorted(set(kinds))
        building["geometry"] = [
            {
                "type": "Solid",
                "lod": lod,
                "boundaries": [shell],
                "semantics": {
                    "surfaces": [{"type": name} for name in types],
                    "values": [[types.index(kind) for kind in kinds]],
                },
            }
        ]
    return {
        "type": "CityJSONFeature",
        "id": solid.building_id,
        "CityObjects": {solid.building_id: building},
        "vertices": grid[used].tolist(),
    }


def _compact(value: dict[str, Any]) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False)


@dataclass(frozen=True)
class ReadSolid:
    """A building from a file, triangulated.

    vertex_m: float64 (v, 3) in the CRS. triangle: int (t, 3). kind: uint8 (t,), a ``FaceKind``. surface: int (t,), the
    number of the polygon that a triangle is part of. All are empty if the building has no geometry of the level of
    detail.
    """

    building_id: str
    vertex_m: np.ndarray
    triangle: np.ndarray
    kind: np.ndarray
    surface: np.ndarray
    attributes: dict[str, Any]


def read(path: str | Path, lod: str) -> list[ReadSolid]:
    """Every Building of a CityJSON file or CityJSONSeq with its solids of one level of detail, parts joined.

    Raises :class:`InputError` if the file is missing or not CityJSON.
    """
    try:
        text = Path(path).read_text()
        documents = [json.loads(line) for line in text.splitlines() if line.strip()]
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except json.JSONDecodeError:
        documents = [_whole(path, text)]
    if not documents or documents[0].get("type") != "CityJSON":
        raise InputError(f"{path}: not CityJSON: the first object must have the type CityJSON")
    transform = documents[0].get("transform", {"scale": [1, 1, 1], "translate": [0, 0, 0]})
    scale, translate = np.array(transform["scale"]), np.array(transform["translate"])
    solids: list[ReadSolid] = []
    for document in documents:
        if document.get("vertices"):
            vertex = np.array(document["vertices"], float) * scale + translate
        else:
            vertex = np.zeros((0, 3))
        solids += _buildings(document["CityObjects"], vertex, lod)
    return solids


def _whole(path: str | Path, text: str) -> dict[str, Any]:
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: not CityJSON: {error}") from error


def _buildings(objects: dict[str, Any], vertex_m: np.ndarray, lod: str) -> list[ReadSolid]:
    solids = []
    for name, building in objects.items():
        if building["type"] != "Building":
            continue
        members = [building] + [objects[child] for child in building.get("children", []) if child in objects]
        triangles, kinds = [np.zeros((0, 3), int)], [np.zeros(0, np.uint8)]
        for geometry in (g for member in members for g in member.get("geometry", [])):
            if str(geometry.get("lod")) == lod and geometry["type"] == "Solid":
                for triangle, kind in _triangulated(geometry, vertex_m):
                    triangles.append(triangle)
                    kinds.append(np.full(len(triangle), kind, np.uint8))
        triangle = np.concatenate(triangles)
        surface = np.repeat(np.arange(len(triangles)), [len(part) for part in triangles]) - 1
        used, local = np.unique(triangle, return_inverse=True)
        solids.append(
            ReadSolid(
                name,
                vertex_m[used],
                local.reshape(-1, 3),
                np.concatenate(kinds),
                surface,
                building.get("attributes", {}),
            )
        )
    return solids


def _triangulated(geometry: dict[str, Any], vertex_m: np.ndarray) -> Iterator[tuple[np.ndarray, int]]:
    semantics = geometry.get("semantics", {"surfaces": [], "values": None})
    for s, shell in enumerate(geometry["boundaries"]):
        for p, rings in enumerate(shell):
            values = semantics["values"][s] if semantics["values"] else None
            surface = values[p] if values else None
            kind = FaceKind.WALL if surface is None else _KIND.get(semantics["surfaces"][surface]["type"])
            yield (
                triangulate(vertex_m, [np.array(ring) for ring in rings]),
                FaceKind.WALL if kind is None else kind,
            )


def triangulate(vertex_m: np.ndarray, rings: Sequence[np.ndarray]) -> np.ndarray:
    """Triangles, int (t, 3), of one planar polygon of vertex indices, in the orientation of the polygon."""
    exterior = vertex_m[rings[0]]
    # Newell's normal: exact for a planar ring, an average for a slightly bent one
    normal = np.cross(exterior - exterior[0], np.roll(exterior, -1, axis=0) - exterior[0]).sum(axis=0)
    drop = int(np.abs(normal).argmax())
    axes = [axis for axis in range(3) if axis != drop]
    index = np.concatenate(rings)
    plane = np.ascontiguousarray(vertex_m[index][:, axes])
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    triangle = index[mapbox_earcut.triangulate_float64(plane, ends).reshape(-1, 3)]
    if not len(triangle):
        return triangle.reshape(-1, 3).astype(int)
    corner = vertex_m[triangle]
    sense = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).sum(axis=0) @ normal
    return triangle if sense >= 0 else triangle[:, ::-1]
