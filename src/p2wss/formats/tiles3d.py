"""3D Tiles 1.1: a tree of glTF tiles on the globe, as web maps (CesiumJS, three.js, deck.gl, QGIS) stream it.

Specifications: https://docs.ogc.org/cs/22-025r4/22-025r4.html (OGC 22-025r4), and of the glTF extensions
``EXT_mesh_features`` and ``EXT_structural_metadata``, by which a viewer identifies the building of a face.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyproj

from p2wss import __version__
from p2wss.formats.glb import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, FLOAT, UNSIGNED_INT, Binary, container
from p2wss.formats.glb import gltf_material as material_of
from p2wss.formats.meshes import Body, Frame, material_names
from p2wss.mesh import Mesh
from p2wss.storage.errors import InputError

MAX_MESHES = 256
_EARTH_CENTRED, _GEOGRAPHIC = "EPSG:4978", "EPSG:4979"
# coordinates in a tile are 32 bits wide: its bounds are wider by this much
_ROUNDING_M = 1e-3
_NORMAL_STEPS = 1e4


def tileset_files(
    bodies: Sequence[Body], frame: Frame, facts: Mapping[str, Any], max_meshes: int = MAX_MESHES
) -> dict[str, bytes]:
    """The files of a tileset by their names, ``tileset.json`` last.

    The root tile places a local frame (east, north, up at the middle of the meshes) on the globe; in it every vertex is
    where pyproj transforms it to, so that neither scale nor convergence of the projection displaces anything. Below it
    a quadtree has tiles of at most ``max_meshes`` meshes as leaves. The terrain, if there is one, is the content of the
    root. Nothing is simplified: an inner tile has no buildings, and its geometric error is its diagonal.

    Raises :class:`InputError` if PROJ cannot transform the CRS.

    Heights of a compound CRS become heights above the ellipsoid if PROJ has the grid of its geoid. Otherwise, and
    without a vertical CRS, they are written as heights above the ellipsoid, which the extras of the asset state.
    """
    earth_centred = _transformer(frame.crs, _EARTH_CENTRED)
    corner_m = _corners(bodies, frame)
    centre_m = corner_m.mean(axis=0)
    to_globe = _east_north_up(frame.crs, centre_m)
    local = [
        replace(body, mesh=body.mesh.moved(_local(body.mesh.vertex_m, earth_centred, to_globe)))
        for body in bodies
    ]
    buildings = [body for body in local if not body.is_terrain]
    terrains = [body for body in local if body.is_terrain]
    files: dict[str, bytes] = {}
    root = _tile(buildings, "0", max_meshes, files) if buildings else None
    tile: dict[str, Any] = {"children": [root.tile]} if root is not None else {}
    bounds = [(root.low_m, root.high_m)] if root is not None else []
    if terrains:
        files["content/terrain.glb"], low_m, high_m = _content(terrains, np.zeros(3))
        tile["content"] = {"uri": "content/terrain.glb"}
        bounds.append((low_m, high_m))
    low, high = (f(bounds or np.zeros((1, 2, 3)), axis=(0, 1)) for f in (np.min, np.max))
    error_m = float(np.linalg.norm(high - low))
    tileset = {
        "asset": {
            "version": "1.1",
            "generator": f"p2wss {__version__}",
            "extras": {"p2wss": dict(facts), "crs": frame.crs, "heights": _heights(frame.crs)},
        },
        "geometricError": error_m,
        "root": {
            "boundingVolume": {"box": _box(low, high)},
            "geometricError": error_m,
            "refine": "ADD",
            # column by column
            "transform": to_globe.T.ravel().tolist(),
            **tile,
        },
    }
    files["tileset.json"] = json.dumps(tileset, separators=(",", ":")).encode()
    return files


@dataclass(frozen=True)
class _Tile:
    """A tile as JSON and its bounds in the local frame."""

    tile: dict[str, Any] = field(repr=False)
    low_m: np.ndarray
    high_m: np.ndarray


def _tile(parts: Sequence[Body], name: str, max_meshes: int, files: dict[str, bytes]) -> _Tile:
    """A leaf with all parts, or an inner tile with those of each quarter below it. Contents are added to ``files``."""
    centre_m = np.array([np.mean(_bounds(part.mesh), axis=0) for part in parts])
    if len(parts) <= max_meshes or (np.ptp(centre_m[:, :2], axis=0) == 0).all():
        origin_m = np.round(centre_m.mean(axis=0))
        uri = f"content/{name}.glb"
        files[uri], low_m, high_m = _content(parts, origin_m)
        transform = [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, *origin_m.tolist(), 1.0]
        leaf = {
            "boundingVolume": {"box": _box(low_m, high_m)},
            "geometricError": 0.0,
            "transform": transform,
            "content": {"uri": uri},
        }
        return _Tile(leaf, low_m + origin_m, high_m + origin_m)
    middle_m = (centre_m[:, :2].min(axis=0) + centre_m[:, :2].max(axis=0)) / 2
    quarter = (centre_m[:, :2] >= middle_m) @ [1, 2]
    children = [
        _tile(
            [part for part, q in zip(parts, quarter, strict=True) if q == number],
            f"{name}{number}",
            max_meshes,
            files,
        )
        for number in np.unique(quarter).tolist()
    ]
    low_m = np.min([child.low_m for child in children], axis=0)
    high_m = np.max([child.high_m for child in children], axis=0)
    inner = {
        "boundingVolume": {"box": _box(low_m, high_m)},
        "geometricError": float(np.linalg.norm(high_m - low_m)),
        "children": [child.tile for child in children],
    }
    return _Tile(inner, low_m, high_m)


def _content(parts: Sequence[Body], origin_m: np.ndarray) -> tuple[bytes, np.ndarray, np.ndarray]:
    """A GLB of the parts, y up as glTF prescribes, and its bounds, z up, around ``origin_m``.

    Each corner of a face has the normal of the face and the number of its building, the row of the property table.
    """
    names = material_names(parts)
    whole = Mesh.joined([part.mesh for part in parts]).translated(-origin_m)
    vertex_m, triangle = whole.vertex_m, whole.triangle
    first_building = np.cumsum([0, *(len(part.buildings) for part in parts)])
    building = np.concatenate([p.building + first for p, first in zip(parts, first_building, strict=False)])
    material = np.concatenate([_material_numbers(part, names) for part in parts])
    length = 2 * whole.area_m2[:, None]
    normal = np.where(length > 0, whole.doubled_m2 / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])

    binary = Binary()
    primitives = []
    for number in np.unique(material).tolist():
        rows = np.flatnonzero(material == number)
        primitive = _primitive(binary, vertex_m, triangle[rows], normal[rows], building[rows])
        feature_ids = {"featureCount": int(first_building[-1]), "attribute": 0, "propertyTable": 0}
        extensions = {"EXT_mesh_features": {"featureIds": [feature_ids]}}
        primitives.append(primitive | {"material": number, "extensions": extensions})
    tree = {
        "asset": {"version": "2.0", "generator": f"p2wss {__version__}"},
        "extensionsUsed": ["EXT_mesh_features", "EXT_structural_metadata"],
        "extensions": {"EXT_structural_metadata": _metadata(parts, binary)},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "materials": [material_of(name) for name in names],
    }
    return container(tree, binary), vertex_m.min(axis=0) - _ROUNDING_M, vertex_m.max(axis=0) + _ROUNDING_M


def _primitive(
    binary: Binary, vertex_m: np.ndarray, triangle: np.ndarray, normal: np.ndarray, building: np.ndarray
) -> dict[str, Any]:
    """Attributes and indices of the triangles (t, 3) of one material, whose arrays are added to ``binary``.

    vertex_m: (v, 3), z up. normal: unit normals of the triangles, (t, 3). building: their feature numbers, (t,).
    """
    # corners with the same vertex, normal and building are stored once
    key = np.column_stack(
        [
            triangle.ravel(),
            np.repeat(np.rint(normal * _NORMAL_STEPS).astype(int), 3, axis=0),
            np.repeat(building, 3),
        ]
    )
    _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
    position = _y_up(vertex_m[triangle.ravel()[first]])
    bounds = {"min": position.min(axis=0).tolist(), "max": position.max(axis=0).tolist()}
    of_corner = _y_up(np.repeat(normal, 3, axis=0)[first])
    feature = np.repeat(building, 3)[first].astype("<f4")
    return {
        "attributes": {
            "POSITION": binary.append(position, ARRAY_BUFFER, componentType=FLOAT, type="VEC3", **bounds),
            "NORMAL": binary.append(of_corner, ARRAY_BUFFER, componentType=FLOAT, type="VEC3"),
            "_FEATURE_ID_0": binary.append(feature, ARRAY_BUFFER, componentType=FLOAT, type="SCALAR"),
        },
        "indices": binary.append(
            index.reshape(-1).astype("<u4"),
            ELEMENT_ARRAY_BUFFER,
            componentType=UNSIGNED_INT,
            type="SCALAR",
        ),
    }


def _metadata(parts: Sequence[Body], binary: Binary) -> dict[str, Any]:
    """The property table: id and height of each building, in the order of the feature numbers."""
    ids = [ref.building_id.encode() for part in parts for ref in part.buildings]
    offsets = np.cumsum([0, *map(len, ids)]).astype("<u4")
    z_m = [
        part.mesh.corner_m[part.building == number, :, 2]
        for part in parts
        for number in range(len(part.buildings))
    ]
    heights = [float(np.ptp(of_building)) if of_building.size else 0.0 for of_building in z_m]
    # the specification requires that views of tables begin at multiples of eight bytes
    values = binary.append_view(b"".join(ids), 8)
    string_offsets = binary.append_view(offsets.tobytes(), 8)
    height = binary.append_view(np.array(heights, "<f4").tobytes(), 8)
    properties = {
        "building_id": {"type": "STRING", "required": True, "description": "id of the footprint"},
        "height_m": {
            "type": "SCALAR",
            "componentType": "FLOAT32",
            "required": True,
            "description": "difference of the highest and the lowest vertex, in metres",
        },
    }
    return {
        "schema": {"id": "p2wss", "classes": {"building": {"properties": properties}}},
        "propertyTables": [
            {
                "class": "building",
                "count": len(ids),
                "properties": {
                    "building_id": {"values": values, "stringOffsets": string_offsets},
                    "height_m": {"values": height},
                },
            }
        ],
    }


def _material_numbers(body: Body, names: Sequence[str]) -> np.ndarray:
    numbers = np.zeros(len(body.mesh.triangle), int)
    for faces in body.faces:
        numbers[faces.triangle] = names.index(faces.material)
    return numbers


def _y_up(xyz: np.ndarray) -> np.ndarray:
    """Float32 coordinates (n, 3) of glTF: viewers turn its y to the z of the tile."""
    return np.column_stack([xyz[:, 0], xyz[:, 2], -xyz[:, 1]]).astype("<f4")


def _box(low_m: np.ndarray, high_m: np.ndarray) -> list[float]:
    """The bounding volume "box": its centre and three half axes."""
    half = (high_m - low_m) / 2
    return [*((low_m + high_m) / 2).tolist(), *np.diag(half).ravel().tolist()]


def _corners(bodies: Sequence[Body], frame: Frame) -> np.ndarray:
    corners = [bound for body in bodies for bound in _bounds(body.mesh)]
    low_high = np.array(corners) if corners else np.array([frame.origin_m])
    return np.array([low_high.min(axis=0), low_high.max(axis=0)])


def _bounds(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    return mesh.vertex_m.min(axis=0), mesh.vertex_m.max(axis=0)


def _transformer(crs: str, target: str) -> pyproj.Transformer:
    source = pyproj.CRS.from_user_input(crs)
    return pyproj.Transformer.from_crs(
        source if source.is_compound else source.to_3d(), target, always_xy=True
    )


def _heights(crs: str) -> str:
    """What the heights of the tiles are."""
    source = pyproj.CRS.from_user_input(crs)
    if not source.is_compound:
        return "as in the clouds, taken as heights above the ellipsoid"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a grid that is missing
        group = pyproj.transformer.TransformerGroup(source, _GEOGRAPHIC, always_xy=True)
    if group.best_available:
        return "above the ellipsoid"
    return "as in the clouds, taken as heights above the ellipsoid: PROJ has no grid of the geoid here"


def _east_north_up(crs: str, centre_m: np.ndarray) -> np.ndarray:
    """The matrix (4, 4) from east, north and up at a point to coordinates from the centre of the earth."""
    ((longitude, latitude, _),) = _transformed(centre_m[None], _transformer(crs, _GEOGRAPHIC))
    (sin_u, sin_v), (cos_u, cos_v) = (f(np.deg2rad([longitude, latitude])) for f in (np.sin, np.cos))
    matrix = np.eye(4)
    matrix[:3, 0] = -sin_u, cos_u, 0
    matrix[:3, 1] = -sin_v * cos_u, -sin_v * sin_u, cos_v
    matrix[:3, 2] = cos_v * cos_u, cos_v * sin_u, sin_v
    (matrix[:3, 3],) = _transformed(centre_m[None], _transformer(crs, _EARTH_CENTRED))
    return matrix


def _local(vertex_m: np.ndarray, transformer: pyproj.Transformer, to_globe: np.ndarray) -> np.ndarray:
    """Vertices (v, 3) of the CRS in the local frame."""
    globe_m = _transformed(vertex_m, transformer)
    return np.asarray((globe_m - to_globe[:3, 3]) @ to_globe[:3, :3])


def _transformed(point_m: np.ndarray, transformer: pyproj.Transformer) -> np.ndarray:
    result = np.column_stack(transformer.transform(*np.asarray(point_m, float).T))
    if not np.isfinite(result).all():
        raise InputError("3dtiles: PROJ cannot transform these coordinates to WGS 84; is the CRS right?")
    return result
