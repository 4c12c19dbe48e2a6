"""CityJSON 2.0 as a text sequence (CityJSONSeq: one header line, then one feature per building) or one document.

Specifications: https://www.cityjson.org/specs/2.0.1/ and https://www.cityjson.org/cityjsonseq/ .
"""

import itertools
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from p2wss.mesh.faces import Surface, doubled_area
from p2wss.mesh.repair import SCALE_M, stored
from p2wss.skeleton.types import FaceKind

SURFACE_TYPE = {
    FaceKind.GROUND: "GroundSurface",
    FaceKind.WALL: "WallSurface",
    FaceKind.ROOF: "RoofSurface",
    FaceKind.FLAT: "RoofSurface",
    FaceKind.FLOOR: "OuterFloorSurface",
}


# the URL of a CRS of EPSG, as CityJSON requires it
_CRS_URL = "https://www.opengis.net/def/crs/EPSG/0/"
# planes with less slope have no azimuth
_LEVEL_DEG = 0.1


@dataclass(frozen=True)
class Solid:
    """A city object to write: a building, or a plant.

    vertex_m: float64 (v, 3), in the CRS. surfaces: without any, the object has no geometry of LoD 2.0. attributes: of
    JSON types. block, block_vertex_m: surfaces and vertices of the same building as a block with a flat roof, LoD 1.2;
    empty to leave it out. city_type: of the city object; only a Building has semantic surfaces.
    """

    building_id: str
    vertex_m: np.ndarray
    surfaces: Sequence[Surface]
    attributes: dict[str, Any] = field(default_factory=dict)
    block_vertex_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    block: Sequence[Surface] = ()
    city_type: str = "Building"


@dataclass(frozen=True)
class Metadata:
    """What the header of a file states. epsg: code of the CRS, of a compound CRS if its code is known. title: of the
    file. reference_date: the day at which the data were valid, as ``2021-03-31``. slope, azimuth: names of the
    attributes of roof surfaces (not in the header)."""

    epsg: int | None = None
    title: str | None = None
    reference_date: str | None = None
    slope: str = "slope_deg"
    azimuth: str = "azimuth_deg"


def lines(solids: Iterable[Solid], metadata: Metadata) -> Iterator[str]:
    """The lines of a CityJSONSeq, header first, without line ends. The first solid defines the local origin."""
    return map(_compact, _objects(solids, metadata))


def _objects(solids: Iterable[Solid], metadata: Metadata) -> Iterator[dict[str, Any]]:
    """The objects of :func:`lines`."""
    others = iter(solids)
    first = list(itertools.islice(others, 1))
    translate = np.zeros(3)
    if first and len(first[0].vertex_m):
        translate = np.floor(np.asarray(first[0].vertex_m).min(axis=0))
    yield _header(translate, metadata)
    for solid in itertools.chain(first, others):
        yield _feature(solid, translate, metadata)


def document_pieces(solids: Iterable[Solid], metadata: Metadata) -> Iterator[str]:
    """The content of :func:`lines` as the text of a single CityJSON object, in pieces, building by building. Only the
    coordinates are kept in memory, as text."""
    objects = _objects(solids, metadata)
    city = next(objects)
    stated = city.pop("metadata", None)
    del city["CityObjects"], city["vertices"]
    yield _compact(city)[:-1] + ',"CityObjects":{'
    vertices: list[str] = []
    num_vertices, separator = 0, ""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for feature in objects:
        for city_object in feature["CityObjects"].values():
            for geometry in city_object.get("geometry", []):
                geometry["boundaries"] = [
                    [[[vertex + num_vertices for vertex in ring] for ring in rings] for rings in shell]
                    for shell in geometry["boundaries"]
                ]
        yield separator + _compact(feature["CityObjects"])[1:-1]
        separator = ","
        if feature["vertices"]:
            corner = np.array(feature["vertices"])
            low, high = np.minimum(low, corner.min(axis=0)), np.maximum(high, corner.max(axis=0))
            vertices.append(_compact(feature["vertices"])[1:-1])
            num_vertices += len(corner)
    yield f'}},"vertices":[{",".join(vertices)}]'
    if num_vertices:
        translate = city["transform"]["translate"]
        extent = [*(low * SCALE_M + translate), *(high * SCALE_M + translate)]
        stated = (stated or {}) | {"geographicalExtent": [round(float(v), 4) for v in extent]}
    yield (f',"metadata":{_compact(stated)}' if stated else "") + "}"


def _header(translate: np.ndarray, metadata: Metadata) -> dict[str, Any]:
    header: dict[str, Any] = {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [SCALE_M] * 3, "translate": translate.tolist()},
        "CityObjects": {},
        "vertices": [],
    }
    stated = {
        "title": metadata.title,
        "referenceDate": metadata.reference_date,
        "referenceSystem": None if metadata.epsg is None else f"{_CRS_URL}{metadata.epsg}",
    }
    stated = {name: value for name, value in stated.items() if value is not None}
    return header | ({"metadata": stated} if stated else {})


def _feature(solid: Solid, translate: np.ndarray, metadata: Metadata) -> dict[str, Any]:
    vertices: list[list[int]] = []
    levels = (("1.2", solid.block_vertex_m, solid.block), ("2.0", solid.vertex_m, solid.surfaces))
    geometries = [_geometry(*level, translate, vertices, metadata) for level in levels if level[2]]
    building: dict[str, Any] = {"type": solid.city_type, "attributes": solid.attributes}
    if any(geometries):
        building["geometry"] = [geometry for geometry in geometries if geometry]
    if solid.city_type != "Building":
        for geometry in building["geometry"]:
            del geometry["semantics"]
    return {
        "type": "CityJSONFeature",
        "id": solid.building_id,
        "CityObjects": {solid.building_id: building},
        "vertices": vertices,
    }


def _geometry(
    lod: str,
    vertex_m: np.ndarray,
    surfaces: Sequence[Surface],
    translate: np.ndarray,
    vertices: list[list[int]],
    metadata: Metadata,
) -> dict[str, Any] | None:
    """The geometry of a solid; None without surfaces. Its vertices are added to ``vertices``.

    All ground, all walls and all outer floors have one semantic surface each, roofs one per plane.
    """
    grid, surfaces = stored(vertex_m, surfaces)
    if not surfaces:
        return None
    grid = grid - np.round(translate / SCALE_M).astype(np.int64)
    # only vertices of rings are written, as a vertex within a face is in no ring
    rings = [[ring.tolist() for ring in surface.rings] for surface in surfaces]
    used = sorted({vertex for of_surface in rings for ring in of_surface for vertex in ring})
    known = {tuple(vertex): position for position, vertex in enumerate(vertices)}
    number, places = {}, grid.tolist()
    for vertex in used:
        place = places[vertex]
        number[vertex] = known.setdefault(tuple(place), len(vertices))
        if number[vertex] == len(vertices):
            vertices.append(place)
    faces: dict[tuple[str, int], list[int]] = {}
    for i, surface in enumerate(surfaces):
        name = SURFACE_TYPE[FaceKind(surface.kind)]
        face = -1 if name != "RoofSurface" else surface.face if surface.face >= 0 else len(surfaces) + i
        faces.setdefault((name, face), []).append(i)
    semantics: list[dict[str, Any]] = []
    values = [0] * len(surfaces)
    for (name, face), members in sorted(faces.items()):
        for i in members:
            values[i] = len(semantics)
        semantics.append({"type": name})
        if face >= 0:
            semantics[-1] |= _plane(grid, [surfaces[i] for i in members], metadata)
    return {
        "type": "Solid",
        "lod": lod,
        "boundaries": [[[[number[vertex] for vertex in ring] for ring in each] for each in rings]],
        "semantics": {"surfaces": semantics, "values": [values]},
    }


def _plane(grid: np.ndarray, surfaces: Sequence[Surface], metadata: Metadata) -> dict[str, Any]:
    """Attributes of a roof plane: slope from the horizontal; azimuth of the way down, clockwise from grid north, which
    a level plane lacks; area."""
    rings = [grid[ring] * SCALE_M for surface in surfaces for ring in surface.rings]
    x, y, z = (np.sum([doubled_area(ring) for ring in rings], axis=0) / 2).tolist()
    slope_deg = math.degrees(math.atan2(math.hypot(x, y), z))
    attributes = {metadata.slope: round(slope_deg, 2)}
    if slope_deg >= _LEVEL_DEG:
        attributes[metadata.azimuth] = round(math.degrees(math.atan2(x, y)) % 360, 2) % 360
    return attributes | {"area_m2": round(math.hypot(x, y, z), 3)}


def _compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False)
