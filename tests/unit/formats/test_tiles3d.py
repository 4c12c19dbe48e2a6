"""3D Tiles, read back by a reader that shares no code with the writer: places, bounds, ids."""

from __future__ import annotations

import itertools
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyproj
import pytest

from p2wss.formats.meshes import TERRAIN, Body, BuildingRef, Frame, frame_around
from p2wss.formats.tiles3d import tileset_files
from p2wss.mesh import Mesh
from p2wss.skeleton.types import FaceKind
from p2wss.storage.errors import InputError

LAMBERT, RD, RD_NAP = "EPSG:2154", "EPSG:28992", "EPSG:7415"
CORNER = {
    LAMBERT: (652000.0, 6861000.0, 140.0),
    RD: (84600.0, 447300.0, 1.5),
    RD_NAP: (84600.0, 447300.0, 1.5),
}
_DTYPES = {5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3}
# glTF's y axis points up; the tiles' z axis does
Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])


def box(name: str, low: np.ndarray, size: tuple[float, float, float]) -> Body:
    corner = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
    triangle = np.array(
        [
            [0, 6, 4], [0, 2, 6], [1, 5, 7], [1, 7, 3], [0, 4, 5], [0, 5, 1],
            [2, 7, 6], [2, 3, 7], [0, 3, 2], [0, 1, 3], [4, 6, 7], [4, 7, 5],
        ]
    )  # fmt: skip
    kind = np.repeat([FaceKind.GROUND, FaceKind.FLAT, *[FaceKind.WALL] * 4], 2).astype(np.uint8)
    mesh = Mesh(low + corner * size, triangle, kind, np.arange(len(kind)) // 2)
    return Body.of_building(name, mesh, {"roof": "tile", "wall": "brick"})


def town(crs: str, count: int = 40, extent_m: float = 3000.0) -> list[Body]:
    draw = np.random.default_rng(4)
    corner = np.array(CORNER[crs])
    return [
        box(f"h{i}", corner + draw.uniform(0, [extent_m, extent_m, 30]), tuple(draw.uniform(4, 14, 3)))
        for i in range(count)
    ]


@dataclass
class Content:
    """What a viewer knows of a tile: triangles (t, 3, 3) in earth-centred coordinates, normals of their corners,
    material and id per triangle, and heights of the ids."""

    tile: dict[str, Any]
    matrix: np.ndarray
    local: np.ndarray
    triangle: np.ndarray
    normal: np.ndarray
    material: list[str]
    building: list[str]
    heights: dict[str, float]


def tiles(files: dict[str, bytes]) -> Iterator[tuple[dict[str, Any], np.ndarray, list[dict[str, Any]]]]:
    """Every tile with the matrix of its frame and the tiles above it."""

    def walk(tile: dict[str, Any], matrix: np.ndarray, above: list[dict[str, Any]]) -> Iterator[Any]:
        if "transform" in tile:
            matrix = matrix @ np.array(tile["transform"]).reshape(4, 4).T
        yield tile, matrix, above
        for child in tile.get("children", []):
            yield from walk(child, matrix, [*above, tile])

    yield from walk(json.loads(files["tileset.json"])["root"], np.eye(4), [])


def contents(files: dict[str, bytes]) -> list[Content]:
    return [
        read_glb(files[tile["content"]["uri"]], tile, matrix)
        for tile, matrix, _ in tiles(files)
        if "content" in tile
    ]


def read_glb(content: bytes, tile: dict[str, Any], matrix: np.ndarray) -> Content:
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack_from("<I4s", content, 12)
    assert kind == b"JSON" and size % 4 == 0
    tree = json.loads(content[20 : 20 + size])
    binary = content[28 + size :]

    def view(number: int) -> bytes:
        where = tree["bufferViews"][number]
        return binary[where["byteOffset"] : where["byteOffset"] + where["byteLength"]]

    def array(number: int) -> np.ndarray:
        accessor = tree["accessors"][number]
        values = np.frombuffer(view(accessor["bufferView"]), _DTYPES[accessor["componentType"]])
        values = values.reshape(-1, _WIDTHS[accessor["type"]])
        assert len(values) == accessor["count"]
        if "min" in accessor:
            assert values.min(axis=0).tolist() == accessor["min"]
            assert values.max(axis=0).tolist() == accessor["max"]
        return values

    (table,) = tree["extensions"]["EXT_structural_metadata"]["propertyTables"]
    properties = table["properties"]
    for column in properties.values():
        for number in column.values():
            assert tree["bufferViews"][number]["byteOffset"] % 8 == 0
    text = view(properties["building_id"]["values"])
    offset = np.frombuffer(view(properties["building_id"]["stringOffsets"]), "<u4")
    ids = [text[a:b].decode() for a, b in itertools.pairwise(offset)]
    heights = np.frombuffer(view(properties["height_m"]["values"]), "<f4")
    assert len(ids) == len(heights) == table["count"]
    points, normals, materials, buildings = [], [], [], []
    for primitive in tree["meshes"][0]["primitives"]:
        (feature,) = primitive["extensions"]["EXT_mesh_features"]["featureIds"]
        assert feature == {"featureCount": len(ids), "attribute": 0, "propertyTable": 0}
        index = array(primitive["indices"]).reshape(-1, 3)
        position, normal = (array(primitive["attributes"][name])[index] for name in ("POSITION", "NORMAL"))
        of_corner = array(primitive["attributes"]["_FEATURE_ID_0"])[index][..., 0]
        assert (of_corner == of_corner[:, :1]).all()
        points.append(position @ Z_UP[:3, :3].T)
        normals.append(normal @ Z_UP[:3, :3].T)
        materials += [tree["materials"][primitive["material"]]["name"]] * len(index)
        buildings += [ids[int(number)] for number in of_corner[:, 0]]
    local, normal = np.concatenate(points).astype(float), np.concatenate(normals).astype(float)
    return Content(
        tile,
        matrix,
        local,
        local @ matrix[:3, :3].T + matrix[:3, 3],
        normal @ matrix[:3, :3].T,
        materials,
        buildings,
        dict(zip(ids, heights.tolist(), strict=True)),
    )


def in_crs(globe_m: np.ndarray, crs: str) -> np.ndarray:
    target = pyproj.CRS(crs)
    transformer = pyproj.Transformer.from_crs(
        "EPSG:4978", target if target.is_compound else target.to_3d(), always_xy=True
    )
    return np.column_stack(transformer.transform(*globe_m.reshape(-1, 3).T)).reshape(globe_m.shape)


@pytest.mark.parametrize("crs", [LAMBERT, RD, RD_NAP])
def test_every_triangle_is_where_it_was_to_the_centimetre(crs: str) -> None:
    meshes = town(crs)
    files = tileset_files(meshes, frame_around(meshes, crs), {}, max_meshes=7)
    by_name = {mesh.name: mesh for mesh in meshes}
    count = 0
    for content in contents(files):
        triangle = in_crs(content.triangle, crs)
        for name in set(content.building):
            rows = [i for i, building in enumerate(content.building) if building == name]
            expected = by_name[name].mesh.corner_m
            found = triangle[rows]
            # as sets: faces are sorted by material
            order, other = (np.lexsort(np.round(t.reshape(-1, 9), 1).T) for t in (expected, found))
            assert np.abs(expected[order] - found[other]).max() < 0.005
            assert content.heights[name] == pytest.approx(np.ptp(expected[..., 2]), abs=0.02)
            count += 1
            # walls, roof and floor keep their materials, and the normals point outwards
            centre = content.triangle[rows].mean(axis=(0, 1))
            outwards = content.triangle[rows].mean(axis=1) - centre
            assert (np.einsum("tk,tck->tc", outwards, content.normal[rows]) > 0).all()
            assert sorted({content.material[i] for i in rows}) == ["brick", "concrete", "tile"]
    assert count == len(meshes)


def test_a_tile_contains_its_content_and_the_tiles_below_it() -> None:
    meshes = town(LAMBERT)
    files = tileset_files(meshes, frame_around(meshes, LAMBERT), {}, max_meshes=7)
    tileset = json.loads(files["tileset.json"])
    assert tileset["asset"]["version"] == "1.1" and list(files)[-1] == "tileset.json"
    leaves = 0
    for tile, matrix, above in tiles(files):
        errors = [tileset["geometricError"], *(parent["geometricError"] for parent in above)]
        assert errors == sorted(errors, reverse=True) and tile["geometricError"] <= errors[-1]
        if "content" not in tile:
            assert tile["geometricError"] > 0 and tile["children"]
            continue
        leaves += 1
        assert tile["geometricError"] == 0 and len(above) >= 2
        content = read_glb(files[tile["content"]["uri"]], tile, matrix)
        assert len(content.heights) <= 7
        assert np.abs(content.local).max() < 4000
        for box_tile, box_matrix, _ in tiles(files):
            if json.dumps(tile) in json.dumps(box_tile):
                volume = np.array(box_tile["boundingVolume"]["box"])
                inverse = np.linalg.inv(box_matrix)
                point = content.triangle.reshape(-1, 3) @ inverse[:3, :3].T + inverse[:3, 3]
                share = (point - volume[:3]) / np.diag(volume[3:].reshape(3, 3))
                assert np.abs(share).max() <= 1
    assert leaves > 6


def test_the_tileset_stands_upright_on_the_globe() -> None:
    """A vertical edge points away from the centre of the earth, east is east, and x is not scaled by the projection."""
    meshes = [box("a", np.array(CORNER[LAMBERT]), (10.0, 20.0, 30.0))]
    (content,) = contents(tileset_files(meshes, frame_around(meshes, LAMBERT), {}))
    point = content.triangle.reshape(-1, 3)
    longitude, latitude, height = pyproj.Transformer.from_crs(
        "EPSG:4978", "EPSG:4979", always_xy=True
    ).transform(*point.T)
    assert 2.33 < longitude.min() < longitude.max() < 2.36 and 48.8 < latitude.min() < 48.9
    assert [height.min(), height.max()] == pytest.approx([140, 170], abs=0.002)
    up = content.local[:, :, 2]
    assert np.ptp(up) == pytest.approx(30, abs=0.002)


def test_a_terrain_is_the_content_of_the_root_and_a_skin_keeps_its_buildings() -> None:
    corner = np.array(CORNER[LAMBERT])
    a, b = box("a", corner, (5, 5, 8)), box("b", corner + np.array([5, 0, 0]), (5, 5, 6))
    skin = Body(
        "a+b",
        Mesh.joined([a.mesh, b.mesh]),
        np.repeat([0, 1], 12).astype(np.int32),
        (BuildingRef("a"), BuildingRef("b")),
    )
    ground = box("terrain", corner - [50, 50, 3], (100, 100, 2))
    mesh = replace(ground.mesh, kind=np.full(12, TERRAIN, np.uint8))
    terrain = Body.of_building("terrain", mesh, {"terrain": "wet_ground"})
    meshes = [skin, terrain]
    files = tileset_files(meshes, frame_around(meshes, LAMBERT), {"version": "x"})
    root, leaf = contents(files)
    assert set(root.building) == {"terrain"} and set(root.material) == {"wet_ground"}
    assert root.tile["refine"] == "ADD"
    assert leaf.building.count("a") == leaf.building.count("b") == 12
    assert leaf.heights == pytest.approx({"a": 8, "b": 6}, abs=0.001)
    extras = json.loads(files["tileset.json"])["asset"]["extras"]
    assert extras["p2wss"] == {"version": "x"} and extras["crs"] == LAMBERT
    assert extras["heights"].startswith("as in the clouds")


def test_without_meshes_there_is_an_empty_root() -> None:
    files = tileset_files([], Frame(np.array(CORNER[LAMBERT]), LAMBERT), {})
    assert list(files) == ["tileset.json"]
    root = json.loads(files["tileset.json"])["root"]
    assert "content" not in root and "children" not in root


def test_coordinates_that_are_not_of_the_crs_are_one_line() -> None:
    meshes = [box("a", np.array([np.inf, 1e9, 0.0]), (5, 5, 5))]
    with pytest.raises(InputError, match="PROJ cannot transform"):
        tileset_files(meshes, frame_around(meshes, LAMBERT), {})
