"""OBJ, PLY, STL and GLB as an independent reader reads them: the same solids, closed and outwards."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
import trimesh
from yard_house import yard_house

from p2wss import skeleton
from p2wss.formats.glb import glb
from p2wss.formats.meshes import (
    SURFACE_NAMES,
    TERRAIN,
    VEGETATION,
    Body,
    BuildingRef,
    Frame,
    file_names,
    frame_around,
    mtl,
    obj,
    ply,
    stl,
)
from p2wss.mesh import Mesh
from p2wss.skeleton.types import FaceKind, Polygons

POSITION = np.array([652000.25, 6861000.5, 103.7])
L_SHAPE = [np.array([[0, 0], [16, 0], [16, 6], [7, 6], [7, 13], [0, 13]], float)]
COURTYARD = [
    np.array([[0, 0], [20, 0], [20, 20], [0, 20]], float),
    np.array([[6, 6], [6, 14], [14, 14], [14, 6]], float),
]


@pytest.fixture(scope="module")
def meshes() -> list[Body]:
    """An L with gables and, 40 m east of it, a block around a courtyard."""
    built = skeleton.build(
        Polygons.from_rings([L_SHAPE, COURTYARD]),
        np.array([30, 90, 30, 30, 90, 30] + [35] * 8, float),
        np.array([5.0, 6.0]),
    )
    assert (built.status == 0).all()
    result = []
    for i, name in enumerate(("house 1", "courtyard")):
        result.append(
            Body.of_building(name, Mesh.of_kernel(built, i).translated(POSITION + np.array([40 * i, 0, 0])))
        )
    return result


@pytest.fixture(scope="module")
def frame(meshes: list[Body]) -> Frame:
    return frame_around(meshes, "EPSG:2154")


def test_frame_is_the_lower_corner_in_whole_metres(frame: Frame) -> None:
    assert frame.origin_m.tolist() == [652000, 6861000, 103]
    assert frame_around([], "EPSG:2154").origin_m.tolist() == [0, 0, 0]


def solids_of(content: bytes, kind: str) -> dict[str, trimesh.Trimesh]:
    """Solids by name; for formats without separate solids, the connected pieces."""
    if kind == "obj":
        options = {"split_objects": True}
        return dict(trimesh.load_scene(BytesIO(content), file_type="obj", **options).geometry)
    if kind == "glb":
        return dict(trimesh.load_scene(BytesIO(content), file_type="glb").geometry)
    loaded = trimesh.load_mesh(BytesIO(content), file_type=kind)
    return {f"piece {i}": piece for i, piece in enumerate(loaded.split(only_watertight=False))}


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "glb"])
def test_solids_come_back_closed_and_outwards(kind: str, meshes: list[Body], frame: Frame) -> None:
    content = (
        glb(meshes, frame, {}) if kind == "glb" else {"obj": obj, "ply": ply, "stl": stl}[kind](meshes, frame)
    )
    pieces = list(solids_of(content, kind).values())
    assert len(pieces) == len(meshes)
    expected = sorted(
        trimesh.Trimesh(m.mesh.vertex_m - frame.origin_m, m.mesh.triangle).volume for m in meshes
    )
    assert sorted(piece.volume for piece in pieces) == pytest.approx(expected, rel=1e-5)
    for piece in pieces:
        assert piece.is_watertight and piece.is_winding_consistent and piece.volume > 0
    low = np.min([piece.bounds[0] for piece in pieces], axis=0)
    high = np.max([piece.bounds[1] for piece in pieces], axis=0)
    corners = np.concatenate([m.mesh.vertex_m for m in meshes]) - frame.origin_m
    expected_bounds = np.array([corners.min(axis=0), corners.max(axis=0)])
    if kind == "glb":
        # y up: x east, y height, -z north
        expected_bounds = expected_bounds[:, [0, 2, 1]]
        expected_bounds[:, 2] = -expected_bounds[::-1, 2]
    assert np.array([low, high]) == pytest.approx(expected_bounds, abs=2e-4)


def test_names_and_surfaces_in_obj(meshes: list[Body], frame: Frame) -> None:
    lines = obj(meshes, frame).decode().splitlines()
    assert [line for line in lines if line.startswith("o ")] == ["o house_1", "o courtyard"]
    assert "# crs EPSG:2154" in lines
    assert "# origin_m 652000 6861000 103 (add it to every vertex)" in lines
    num_faces: dict[str, int] = {}
    for line in lines:
        if line.startswith("# "):
            name = line.split()[1]
        if line.startswith("f "):
            num_faces[name] = num_faces.get(name, 0) + 1
    kinds = np.concatenate([mesh.mesh.kind for mesh in meshes])
    assert num_faces["ground"] == (kinds == FaceKind.GROUND).sum()
    assert num_faces["wall"] == (kinds == FaceKind.WALL).sum()
    assert num_faces["roof"] == np.isin(kinds, (FaceKind.ROOF, FaceKind.FLAT)).sum()


def test_open_ground_is_a_surface_of_its_own(frame: Frame) -> None:
    row = yard_house()
    floor = row.mesh.kind == FaceKind.FLOOR
    materials = {"wall": "brick", "roof": "tile", "ground": "brick", "outer_floor": "wet_ground"}
    mesh = Body.of_building("yard", row.mesh.translated(POSITION), materials)
    (faces,) = (faces for faces in mesh.faces if faces.surface == "outer_floor")
    assert faces.material == "wet_ground" and (faces.triangle == np.flatnonzero(floor)).all() and floor.any()
    unnamed = Body.of_building("yard", row.mesh).faces
    assert {f.surface: f.material for f in unnamed}["outer_floor"] == "medium_dry_ground"
    lines = obj([mesh], frame, "yard.mtl").decode().splitlines()
    start = lines.index("# outer_floor yard")
    assert lines[start + 1] == "usemtl wet_ground" and "newmtl wet_ground" in mtl([mesh]).decode()
    group = [line.startswith("f ") for line in lines[start + 2 :]]
    assert (group.index(False) if False in group else len(group)) == floor.sum()
    assert b"4 outer_floor" in ply([mesh], frame)
    names = [material["name"] for material in json.loads(glb_json(glb([mesh], frame, {})))["materials"]]
    assert sorted(names) == ["brick", "tile", "wet_ground"]
    assert set(SURFACE_NAMES) == {*FaceKind, TERRAIN, VEGETATION}


def glb_json(content: bytes) -> bytes:
    size, _ = struct.unpack("<I4s", content[12:20])
    return content[20 : 20 + size]


def test_ply_has_kind_and_building_of_every_face(meshes: list[Body], frame: Frame) -> None:
    content = ply(meshes, frame)
    header = content[: content.index(b"end_header")].decode().splitlines()
    assert "comment origin_m 652000 6861000 103 (add it to every vertex)" in header
    assert "comment building 0 house_1" in header and "comment building 1 courtyard" in header
    raw = trimesh.load_mesh(BytesIO(content), file_type="ply", process=False).metadata["_ply_raw"]["face"][
        "data"
    ]
    assert raw["kind"].ravel().tolist() == np.concatenate([mesh.mesh.kind for mesh in meshes]).tolist()
    assert raw["building"].ravel().tolist() == [0] * len(meshes[0].mesh.triangle) + [1] * len(
        meshes[1].mesh.triangle
    )


def test_ply_numbers_the_buildings_of_a_mesh_of_several(meshes: list[Body], frame: Frame) -> None:
    """A skin before a single building: its two buildings are 0 and 1, the building 2."""
    house, courtyard = meshes
    halves = np.arange(len(courtyard.mesh.triangle), dtype=np.int32) % 2
    skin = replace(courtyard, name="block", building=halves, buildings=(BuildingRef("a"), BuildingRef("b c")))
    content = ply([skin, house], frame)
    header = content[: content.index(b"end_header")].decode().splitlines()
    assert [line for line in header if line.startswith("comment building")] == [
        "comment building 0 a",
        "comment building 1 b_c",
        "comment building 2 house_1",
    ]
    raw = trimesh.load_mesh(BytesIO(content), file_type="ply", process=False).metadata["_ply_raw"]["face"]
    assert raw["data"]["building"].ravel().tolist() == [*halves.tolist(), *[2] * len(house.mesh.triangle)]


def test_materials_in_obj(meshes: list[Body], frame: Frame) -> None:
    """Faces have the material of their surface, and comments state these and the buildings; each material of an object
    begins once, and no group cuts it apart."""
    house, courtyard = meshes
    halves = np.arange(len(courtyard.mesh.triangle), dtype=np.int32) % 2
    materials = {"wall": "brick", "roof": "tile", "ground": "brick"}
    refs = (BuildingRef("a", materials), BuildingRef("b", {"wall": "wood"}))
    skin = replace(courtyard, name="block", building=halves, buildings=refs)
    shown: dict[tuple[str, ...], set[str]] = {}
    num_faces: dict[tuple[str, ...], int] = {}
    for line in obj([skin, house], frame, "scene.mtl").decode().splitlines():
        word, *rest = line.split()
        assert word not in "gs"
        if word == "#":
            group = tuple(rest)
        if word == "usemtl":
            (material,) = rest
        if word == "f":
            shown.setdefault(group, set()).add(material)
            num_faces[group] = num_faces.get(group, 0) + 1
    assert shown == {
        ("wall", "a"): {"brick"},
        ("roof", "a"): {"tile"},
        ("ground", "a"): {"brick"},
        ("wall", "b"): {"wood"},
        ("roof", "b"): {"concrete"},
        ("ground", "b"): {"concrete"},
        ("wall", "house_1"): {"concrete"},
        ("roof", "house_1"): {"concrete"},
        ("ground", "house_1"): {"concrete"},
    }
    assert num_faces["wall", "b"] == ((skin.mesh.kind == FaceKind.WALL) & (halves == 1)).sum()
    library = mtl([skin, house]).decode().splitlines()
    assert sorted(line for line in library if line.startswith("newmtl")) == [
        "newmtl brick",
        "newmtl concrete",
        "newmtl tile",
        "newmtl wood",
    ]


def test_glb_keeps_crs_origin_and_materials_where_readers_look(meshes: list[Body], frame: Frame) -> None:
    house, courtyard = meshes
    house = replace(house, buildings=(BuildingRef("house 1", {"wall": "brick", "roof": "tile"}),))
    content = glb([house, courtyard], frame, {"code": "x"})
    size, kind = struct.unpack("<I4s", content[12:20])
    tree = json.loads(content[20 : 20 + size])
    assert kind == b"JSON" and struct.unpack("<I", content[8:12]) == (len(content),)
    place = {"crs": "EPSG:2154", "origin_m": [652000, 6861000, 103]}
    root, *nodes = tree["nodes"]
    assert root["extras"].items() >= place.items() and root["children"] == [1, 2]
    assert tree["asset"]["extras"].items() >= {**place, "p2wss": {"code": "x"}}.items()
    assert [node["name"] for node in nodes] == ["house 1", "courtyard"]
    assert nodes[0]["extras"] == {
        "building_id": "house 1",
        "materials": {"wall": "brick", "roof": "tile", "ground": "concrete"},
    }
    names = [material["name"] for material in tree["materials"]]
    assert sorted(names) == ["brick", "concrete", "tile"]
    kinds = {"brick": house.mesh.kind == FaceKind.WALL, "concrete": house.mesh.kind == FaceKind.GROUND}
    kinds["tile"] = ~kinds["brick"] & ~kinds["concrete"]
    for primitive in tree["meshes"][0]["primitives"]:
        count = tree["accessors"][primitive["indices"]]["count"]
        assert count == 3 * kinds[names[primitive["material"]]].sum()
    assert [p["material"] for p in tree["meshes"][1]["primitives"]] == [names.index("concrete")]
    for view in tree["bufferViews"]:
        assert view["byteOffset"] % 4 == 0 and view["target"] in (34962, 34963)
    assert tree["buffers"][0]["byteLength"] == sum(view["byteLength"] for view in tree["bufferViews"])


def test_stl_is_binary_with_unit_normals_outwards(meshes: list[Body], frame: Frame) -> None:
    content = stl(meshes, frame)
    assert not content.startswith(b"solid") and b"origin_m 652000 6861000 103 crs EPSG:2154" in content[:80]
    (count,) = struct.unpack("<I", content[80:84])
    assert count == sum(len(mesh.mesh.triangle) for mesh in meshes) and len(content) == 84 + 50 * count
    record = np.frombuffer(content[84:], np.dtype("<12f4,<u2"), count)
    values = np.array([row[0] for row in record.tolist()])
    corner = values[:, 3:].reshape(-1, 3, 3)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    assert values[:, :3] == pytest.approx(normal, abs=1e-3)


def test_files_without_meshes_are_valid() -> None:
    frame = frame_around([], "EPSG:2154")
    assert stl([], frame)[80:] == bytes(4)
    assert b"element face 0" in ply([], frame) and obj([], frame).startswith(b"# p2wss")
    assert glb([], frame, {})[:4] == b"glTF"


def test_loaders_keep_each_mesh_whole(meshes: list[Body], frame: Frame) -> None:
    """A building, and a block of two, are one closed mesh each for trimesh, in OBJ and GLB."""
    house, courtyard = meshes
    halves = np.arange(len(courtyard.mesh.triangle), dtype=np.int32) % 2
    skin = replace(courtyard, name="block", building=halves, buildings=(BuildingRef("a"), BuildingRef("b")))
    for kind, content in (
        ("obj", obj([house, skin], frame, "x.mtl")),
        ("glb", glb([house, skin], frame, {})),
    ):
        options = {"split_objects": True} if kind == "obj" else {}
        loaded = trimesh.load_scene(BytesIO(content), file_type=kind, **options)
        sizes = sorted(len(mesh.faces) for mesh in loaded.geometry.values())
        assert sizes == sorted(len(body.mesh.triangle) for body in (house, skin)), kind
        assert all(mesh.is_watertight for mesh in loaded.geometry.values()), kind
    tree = json.loads(glb_json(glb([skin], frame, {})))
    (primitive,) = tree["meshes"][0]["primitives"]
    num_triangles: dict[str, int] = {}
    for building_id, number in primitive["extras"]["triangles"]:
        num_triangles[building_id] = num_triangles.get(building_id, 0) + number
    assert num_triangles == {"a": int((halves == 0).sum()), "b": int((halves == 1).sum())}
    assert tree["materials"][0]["extras"]["edition"] == "ITU-R P.2040-3"


def test_objects_in_obj_have_names_of_their_own(meshes: list[Body], frame: Frame) -> None:
    """Readers join those of one name, and blanks end a name."""
    bodies = [replace(meshes[0], name=name) for name in ("a b", "a_b", "A B", "a  b")]
    lines = obj(bodies, frame).decode().splitlines()
    assert [line for line in lines if line.startswith("o ")] == ["o a_b", "o a_b-2", "o A_B", "o a_b-4"]


def test_a_crs_of_several_lines_is_one_in_files(meshes: list[Body]) -> None:
    frame = frame_around(meshes, 'LOCAL["a",\n    UNIT["m",1]]')
    lines = obj(meshes, frame).decode().splitlines()
    assert {line.split(" ")[0] for line in lines} == {"#", "o", "v", "f"}
    assert b'comment crs LOCAL["a", UNIT["m",1]]\n' in ply(meshes, frame)


def test_names_of_files_have_as_many_bytes_as_file_systems_allow() -> None:
    """Characters of other scripts have three bytes or more: an id of 90 ended a run with --per-building."""
    first, second = file_names(["棟" * 90, "棟" * 90 + "b"])
    assert first == "棟" * 66 and second == first + "-2"
