"""Reading CityJSON: buildings as triangles, for measures; their solids as they are, for checks; their footprints."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mapbox_earcut
import numpy as np
import pyproj
import shapely

from p2wss.mesh import Mesh
from p2wss.mesh.faces import Surface
from p2wss.skeleton.types import FaceKind
from p2wss.storage.messages import InputError, log, reading

if TYPE_CHECKING:
    import geopandas as gpd

_KIND = {
    "GroundSurface": FaceKind.GROUND,
    "WallSurface": FaceKind.WALL,
    "RoofSurface": FaceKind.ROOF,
    "OuterFloorSurface": FaceKind.FLOOR,
}
# kind of a surface if the file does not state it
_UNKNOWN = 255
# city objects that are read: buildings and plants
_TYPES = ("Building", "SolitaryVegetationObject", "PlantCover")
# children of a building that are not read: they are inside it, and repeat its surfaces
_INSIDE = ("BuildingRoom", "BuildingUnit", "BuildingStorey", "BuildingFurniture")
# names of levels of detail with roof planes, the best first
_LODS = ("2.2", "2.3", "2.0", "2", "2.1")
# geometries that are read, and how many lists there are around each of their polygons
_DEPTHS = {"MultiSurface": 1, "CompositeSurface": 1, "Solid": 2, "MultiSolid": 3, "CompositeSolid": 3}
_OF_SOLIDS = 3
# so many bytes at either end of a file tell whether it is CityJSON
_NUM_SHOWN = 4096
# plans have coordinates of millimetres
_GRID_M = 1e-3


@dataclass(frozen=True)
class ReadSolid:
    """A building from a file or, if not ``is_building``, a plant. mesh: its triangles in the CRS, labelled by their
    polygons; empty if there is no geometry of level of detail 2. part: int (t,), the number of the solid of each
    triangle, 0 for a triangle of no solid; None: all triangles are of one solid."""

    building_id: str
    mesh: Mesh
    attributes: dict[str, Any]
    is_building: bool = True
    part: np.ndarray | None = None


def read(path: str | Path) -> list[ReadSolid]:
    """The buildings of :func:`read_city`."""
    return [solid for solid in read_city(path)[0] if solid.is_building]


def read_city(path: str | Path) -> tuple[list[ReadSolid], pyproj.CRS | None]:
    """(every building and plant of a CityJSON file or CityJSONSeq; the CRS that the file states, or None).

    They have the solids, or else the surfaces, of level of detail 2; parts of a building are joined. Of several with
    one id, the last is taken, with a warning. Raises :class:`InputError` if the file is missing or not CityJSON.
    """
    documents, scale, translate = _documents(path)
    solids: list[ReadSolid] = []
    with reading(path, "CityJSON"):
        for document in documents:
            solids += _buildings(*_content(document, documents[0], scale, translate))
        by_id = {(each.building_id, each.is_building): each for each in solids}
        if len(by_id) < len(solids):
            ((repeated, _),) = Counter(each.building_id for each in solids).most_common(1)
            log.warning(
                "warning: %s: id %s occurs more than once; the last of such buildings is taken",
                path,
                repeated,
            )
        if not any(len(each.mesh.triangle) for each in solids):
            objects = [each for document in documents for each in document.get("CityObjects", {}).values()]
            lods = {str(given.get("lod")) for each in objects for given in each.get("geometry", [])}
            if lods:
                text = "warning: %s: no geometry is of level of detail 2, and no other is read; its levels are %s"
                log.warning(text, path, ", ".join(sorted(lods)))
        return list(by_id.values()), _stated_crs(documents)


def is_cityjson(path: str | Path) -> bool:
    """Whether a file looks like CityJSON, by its beginning and its end."""
    if not Path(path).is_file():
        return False
    with open(path, "rb") as file:
        begin = file.read(_NUM_SHOWN)
        file.seek(max(0, Path(path).stat().st_size - _NUM_SHOWN))
        return re.search(rb'"type"\s*:\s*"CityJSON"', begin + file.read()) is not None


def plans(path: str | Path) -> gpd.GeoDataFrame:
    """The buildings of a CityJSON file or CityJSONSeq as footprints, with ``building_id`` and their attributes, except
    attributes that are lists or objects.

    A footprint is the area that the ground surfaces of the lowest level of detail cover, or all its surfaces if none is
    stated to be ground; parts of a building are joined. Raises :class:`InputError` if the file is not CityJSON, or has
    no buildings.
    """
    import geopandas as gpd

    documents, scale, translate = _documents(path)
    rows: list[dict[str, Any]] = []
    shapes = []
    with reading(path, "CityJSON"):
        for document in documents:
            objects, vertex_m = _content(document, documents[0], scale, translate)
            for name, building in objects.items():
                if building["type"] != "Building":
                    continue
                given = [each for some in _geometries(objects, name) for each in some]
                lowest = min((str(each.get("lod")) for each in given), default="")
                lists = [_polygons_of(each) for each in given if str(each.get("lod")) == lowest]
                faces = [(rings, kind) for some in lists for _, rings, kind in some]
                ground = [rings for rings, kind in faces if kind == FaceKind.GROUND]
                parts = [_in_plan(rings, vertex_m) for rings in ground or [rings for rings, _ in faces]]
                shapes.append(shapely.union_all(shapely.buffer(parts, 0.0), grid_size=_GRID_M))
                attributes = building.get("attributes", {}).items()
                single = {key: value for key, value in attributes if not isinstance(value, list | dict)}
                rows.append(single | {"building_id": name})
        if not rows:
            raise InputError(f"{path}: has no buildings")
        return gpd.GeoDataFrame(rows, geometry=shapes, crs=_stated_crs(documents))


def _in_plan(rings: Any, vertex_m: np.ndarray) -> shapely.Polygon:
    xy_m = [vertex_m[_ring(ring, vertex_m), :2] for ring in rings if len(ring) >= 3]
    return shapely.Polygon(xy_m[0], xy_m[1:]) if xy_m else shapely.Polygon()


@dataclass(frozen=True)
class Shell:
    """A shell of a solid in a file. name: of the city object. number: of the shell in its solid; 0 is the outer one.
    vertex_m: float64 (v, 3). surfaces: its polygons. composite: the number of its geometry in the city object if it is
    a composite solid, whose solids must not overlap; else None."""

    name: str
    lod: str
    number: int
    vertex_m: np.ndarray
    surfaces: Sequence[Surface]
    composite: int | None = None


def shells(path: str | Path) -> Iterator[Shell]:
    """The shells of all solids of a CityJSON file or CityJSONSeq, of city objects of any type.

    Raises :class:`InputError` if the file is missing or not CityJSON.
    """
    documents, scale, translate = _documents(path)
    for document in documents:
        with reading(path, "CityJSON"):
            in_document = list(_shells(*_content(document, documents[0], scale, translate)))
        yield from in_document


def _shells(objects: dict[str, Any], vertex_m: np.ndarray) -> Iterator[Shell]:
    for name, city_object in objects.items():
        for place, geometry in enumerate(city_object.get("geometry", [])):
            boundaries = geometry.get("boundaries", [])
            composite = place if geometry["type"] == "CompositeSolid" else None
            solids = {"Solid": [boundaries], "MultiSolid": boundaries, "CompositeSolid": boundaries}
            for solid in solids.get(geometry["type"], []):
                for number, shell in enumerate(solid or [[]]):  # one without shells is not valid either
                    surfaces = [
                        Surface(FaceKind.WALL, -1, [_ring(ring, vertex_m) for ring in rings])
                        for rings in shell
                    ]
                    yield Shell(name, str(geometry.get("lod", "")), number, vertex_m, surfaces, composite)


def _ring(indices: Sequence[int], vertex_m: np.ndarray) -> np.ndarray:
    """A ring of vertex indices. Raises ValueError for an index without a vertex."""
    ring = np.array(indices)
    if ring.ndim != 1 or (len(ring) and ring.dtype.kind not in "iu"):
        raise ValueError("a ring must be a list of whole numbers")
    if len(ring) and (ring.min() < 0 or ring.max() >= len(vertex_m)):
        raise ValueError(f"a ring has the vertex {ring.max()} of {len(vertex_m)} vertices")
    return ring.astype(np.int64)


def _documents(path: str | Path) -> tuple[list[dict[str, Any]], np.ndarray, np.ndarray]:
    """(the JSON objects of a file, scale and translation of their vertices). Raises :class:`InputError` if they are not
    CityJSON, or have different transforms."""
    with reading(path, "CityJSON"):
        text = Path(path).read_text(encoding="utf-8-sig")
        if text.lstrip().startswith("<"):
            raise ValueError("it is XML; if it is CityGML, convert it: citygml-tools to-cityjson FILE")
        try:
            # not splitlines: strings may contain characters that only Python takes for the end of a line
            documents = [json.loads(line) for line in text.split("\n") if line.strip()]
        except json.JSONDecodeError:
            documents = [json.loads(text)]
    objects = [document for document in documents if isinstance(document, dict)]
    if not objects or len(objects) < len(documents) or objects[0].get("type") != "CityJSON":
        raise InputError(f"{path}: not CityJSON: the first object must have the type CityJSON")
    transforms = [each.get("transform") for each in objects if each.get("type") == "CityJSON"]
    if any(each != transforms[0] for each in transforms):
        raise InputError(
            f"{path}: has several headers whose transforms differ, as of files that were put together; read each"
            " of these alone"
        )
    with reading(path, "CityJSON"):
        transform = objects[0].get("transform", {"scale": [1, 1, 1], "translate": [0, 0, 0]})
        scale = np.array(transform["scale"], float).reshape(3)
        return objects, scale, np.array(transform["translate"], float).reshape(3)


def _stated_crs(documents: list[dict[str, Any]]) -> pyproj.CRS | None:
    stated = documents[0].get("metadata", {}).get("referenceSystem")
    return None if stated is None else pyproj.CRS.from_user_input(stated)


def _content(
    document: dict[str, Any], first: dict[str, Any], scale: np.ndarray, translate: np.ndarray
) -> tuple[dict[str, Any], np.ndarray]:
    """(city objects, vertices) of a JSON object. Instances of templates (CityJSON 2.0, 3.4) become geometries with
    vertices of their own. first: the first object of a sequence, which has the templates."""
    objects = document.get("CityObjects", {})
    parts_m = [np.array(document.get("vertices", []), float).reshape(-1, 3) * scale + translate]
    templates = first.get("geometry-templates", {"vertices-templates": [], "templates": []})
    local = np.array(templates["vertices-templates"], float).reshape(-1, 3)
    num_vertices = len(parts_m[0])
    for city_object in objects.values():
        geometries = city_object.get("geometry", [])
        for k, instance in enumerate(geometries):
            if instance["type"] == "GeometryInstance":
                template = templates["templates"][instance["template"]]
                boundaries = _shifted(template["boundaries"], num_vertices, len(local))
                geometries[k] = template | {"boundaries": boundaries}
                matrix = np.array(instance["transformationMatrix"], float).reshape(4, 4)
                place_m = parts_m[0][instance["boundaries"][0]]
                parts_m.append(local @ matrix[:3, :3].T + matrix[:3, 3] + place_m)
                num_vertices += len(local)
    vertex_m = np.concatenate(parts_m)
    if not np.isfinite(vertex_m).all():
        raise ValueError("a coordinate is not finite")
    return objects, vertex_m


def _shifted(boundaries: Any, by: int, num_vertices: int) -> Any:
    """Boundaries of any depth, with ``by`` added to the numbers of vertices. Raises ValueError for a vertex that does
    not exist."""
    if isinstance(boundaries, list):
        return [_shifted(each, by, num_vertices) for each in boundaries]
    if not 0 <= boundaries < num_vertices:
        raise ValueError(f"a template has the vertex {boundaries} of {num_vertices} vertices")
    return boundaries + by


def _buildings(objects: dict[str, Any], vertex_m: np.ndarray) -> list[ReadSolid]:
    solids = []
    for name, building in objects.items():
        if building["type"] not in _TYPES:
            continue
        triangles, kinds, parts = [np.zeros((0, 3), int)], [np.zeros(0, np.uint8)], [0]
        for given in _geometries(objects, name):
            by_lod = [[each for each in given if str(each.get("lod")) == lod] for lod in _LODS]
            best = next(filter(None, by_lod), [])
            # some files repeat the surfaces of a solid beside it
            closed = [each for each in best if "Solid" in each["type"]]
            for geometry in closed or best:
                first = max(parts) + 1
                for number, rings, kind in _polygons_of(geometry):
                    parts.append(first + number if closed else 0)
                    triangles.append(triangulate(vertex_m, [_ring(ring, vertex_m) for ring in rings]))
                    kinds.append(np.full(len(triangles[-1]), kind, np.uint8))
        triangle = np.concatenate(triangles)
        surface = np.repeat(np.arange(len(triangles)), [len(part) for part in triangles]) - 1
        used, local = np.unique(triangle, return_inverse=True)
        mesh = Mesh(
            vertex_m[used],
            local.reshape(-1, 3).astype(np.int32),
            np.concatenate(kinds),
            surface.astype(np.int32),
        )
        is_building = building["type"] == "Building"
        solids.append(
            ReadSolid(
                name,
                _of_known_kinds(mesh),
                building.get("attributes", {}),
                is_building,
                np.array(parts)[1 + surface],
            )
        )
    return solids


def _geometries(objects: dict[str, Any], name: str) -> list[list[dict[str, Any]]]:
    """The geometries that are read: a list for a city object, and one for each of its parts."""
    names = [name]
    for parent in names:
        children = [child for child in objects[parent].get("children", []) if child in objects]
        names += [each for each in children if each not in names and objects[each]["type"] not in _INSIDE]
    given = [objects[each].get("geometry", []) for each in names]
    return [[each for each in some if each["type"] in _DEPTHS] for some in given]


def _polygons_of(geometry: dict[str, Any]) -> Iterator[tuple[int, Any, int]]:
    """(number of its solid in the geometry, rings, kind) of each polygon of a geometry."""
    semantics = geometry.get("semantics", {"surfaces": [], "values": None})
    kinds = [_KIND.get(surface["type"], FaceKind.WALL) for surface in semantics["surfaces"]]
    found = [(0, geometry["boundaries"], semantics["values"])]
    for depth in range(_DEPTHS[geometry["type"]], 0, -1):
        found = [
            (k if depth == _OF_SOLIDS else number, each, values[k] if values else None)
            for number, boundaries, values in found
            for k, each in enumerate(boundaries)
        ]
    for number, rings, surface in found:
        yield number, rings, _UNKNOWN if surface is None else kinds[surface]


def _of_known_kinds(mesh: Mesh) -> Mesh:
    """The mesh, in which surfaces of unknown kind become walls, roofs or ground by their slope."""
    is_unknown = mesh.kind == _UNKNOWN
    if not is_unknown.any():
        return mesh
    by_slope = np.where(mesh.planes.normal[:, 2] > 0, FaceKind.ROOF, FaceKind.GROUND)
    by_slope[mesh.planes.is_wall] = FaceKind.WALL
    return replace(mesh, kind=np.where(is_unknown, by_slope[mesh.number], mesh.kind).astype(np.uint8))


def triangulate(vertex_m: np.ndarray, rings: Sequence[np.ndarray]) -> np.ndarray:
    """Triangles, int (t, 3), of one planar polygon of vertex indices, in the orientation of the polygon."""
    if len(rings) == 1 and len(rings[0]) == 3:
        return rings[0].reshape(1, 3).astype(int)
    exterior = vertex_m[rings[0]]
    # Newell's normal: exact for a planar ring, an average for a slightly bent one
    normal = np.cross(exterior - exterior[0], np.roll(exterior, -1, axis=0) - exterior[0]).sum(axis=0)
    length = np.linalg.norm(normal)
    if not length > 0:
        return np.zeros((0, 3), int)
    # axes of the plane, as seen from outside, so that triangles get the orientation of the polygon. The triangles, and
    # so samples of points on them, depend on the axes: they are as in the script with which
    # tests/unit/eval/test_files.py compares
    u = np.cross(normal, [0, 0, 1] if abs(normal[2]) < 0.9 * length else [1, 0, 0])
    u /= np.linalg.norm(u)
    v = np.cross(normal / length, u)
    index = np.concatenate(rings)
    plane = (vertex_m[index] - exterior[0]) @ np.column_stack([u, v])
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    return index[mapbox_earcut.triangulate_float64(plane, ends).reshape(-1, 3)].astype(int)
