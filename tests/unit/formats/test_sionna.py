"""The folder for Sionna RT, read back by a strict reader."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sionna_scene
import trimesh
from yard_house import yard_house

from p2wss import skeleton
from p2wss.data.terrain import Terrain
from p2wss.formats import sionna
from p2wss.formats.materials import MATERIALS, TABLE, properties
from p2wss.formats.meshes import Body, BuildingRef, Frame, frame_around
from p2wss.formats.sionna import scene_files
from p2wss.mesh import Mesh
from p2wss.reconstruction.skin import terrain_mesh
from p2wss.skeleton.types import FaceKind, Polygons

X, Y = 84805.0, 447472.0
BRICK = {"wall": "brick", "roof": "tile", "ground": "brick"}


@pytest.fixture(scope="module")
def meshes() -> list[Body]:
    """Two gable houses, the second of brick with tiles, and their terrain, which is the last."""
    ring = np.array([[0, 0], [10, 0], [10, 8], [0, 8]], float)
    built = skeleton.build(
        Polygons.from_rings([[ring]] * 2), np.array([35.0, 90, 35, 90] * 2), np.array([5.0, 5.0])
    )
    result = []
    for i, name in enumerate(("NL.IMBAG.Pand.0503100000000001", "B 2")):
        mesh = Mesh.of_kernel(built, i).translated([X + 10 + 20 * i, Y + 10, 2])
        result.append(Body.of_building(name, mesh))
    result[1] = replace(result[1], buildings=(BuildingRef("B 2", BRICK),))
    heights = 2 + 0.05 * np.arange(60, dtype=np.float32)[None] + np.zeros((40, 1), np.float32)
    land = Terrain(heights, X, Y + 40, 1.0)
    window = terrain_mesh.window(land, (X + 4, Y + 4, X + 50, Y + 30))
    return [*result, terrain_mesh.block(window, 0.1)]


def write(folder: Path, meshes: Sequence[Body], frequency_ghz: float = 3.5, **options: bool) -> Frame:
    frame = frame_around(meshes, "EPSG:28992")
    for name, content in scene_files(meshes, frame, {"code": "x"}, frequency_ghz, **options).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return frame


def closed(shape: sionna_scene.Shape) -> trimesh.Trimesh:
    solid = trimesh.Trimesh(shape.vertex_m, shape.triangle, process=False)
    assert solid.is_watertight and solid.is_winding_consistent and solid.volume > 0
    return solid


def test_a_shape_per_building_and_the_terrain(meshes: list[Body], tmp_path: Path) -> None:
    frame = write(tmp_path, meshes)
    scene = sionna_scene.read(tmp_path)
    assert list(scene.shapes) == ["terrain", "NL_IMBAG_Pand_0503100000000001", "B_2"]
    for shape, mesh in zip(scene.shapes.values(), (meshes[2], *meshes[:2]), strict=True):
        assert shape.vertex_m == pytest.approx(mesh.mesh.vertex_m - frame.origin_m, abs=1e-4)
        assert (shape.triangle == mesh.mesh.triangle).all()
        closed(shape)
    assert [shape.material for shape in scene.shapes.values()] == [
        "mat-medium_dry_ground",
        "mat-concrete",
        "mat-brick",
    ]
    assert [values["type"] for values in scene.materials.values()] == [
        "medium_dry_ground",
        "concrete",
        "brick",
    ]


def test_place_and_contents_are_stated_in_comments_and_json(meshes: list[Body], tmp_path: Path) -> None:
    frame = write(tmp_path, meshes)
    scene = sionna_scene.read(tmp_path)
    facts = scene.facts
    assert facts["crs"] == "EPSG:28992" and facts["origin_m"] == frame.origin_m.tolist()
    # the church of Delft, 2 km away, is at 52.012 N, 4.361 E
    assert facts["origin_wgs84"]["latitude_deg"] == pytest.approx(52.0112, abs=1e-3)
    assert facts["origin_wgs84"]["longitude_deg"] == pytest.approx(4.3647, abs=1e-3)
    assert facts["shapes"]["NL_IMBAG_Pand_0503100000000001"] == {
        "file": "meshes/NL_IMBAG_Pand_0503100000000001.ply",
        "material": "concrete",
        "buildings": ["NL.IMBAG.Pand.0503100000000001"],
    }
    assert facts["shapes"]["terrain"]["buildings"] == [] and facts["p2wss"] == {"code": "x"}
    assert f"origin_m {frame.origin} (add it to every vertex)" in scene.comments
    assert any(comment.startswith("origin in WGS 84: latitude 52.01") for comment in scene.comments)
    # the roof of tiles is written as brick, the material of the walls, and a note says so
    assert len(facts["notes"]) == 1 and "material of most of its walls" in facts["notes"][0]


def test_the_map_surface_is_the_top_of_the_terrain(meshes: list[Body], tmp_path: Path) -> None:
    frame = write(tmp_path, meshes)
    vertex_m, triangle = sionna_scene.read_ply(tmp_path / "terrain_top.ply")
    top = trimesh.Trimesh(vertex_m, triangle, process=False)
    assert (top.face_normals[:, 2] > 0.5).all()
    # half squares of 2 m, and none whose square has its centre in a house of 10 m by 8 m
    size = np.floor(np.ptp(meshes[2].mesh.vertex_m[:, :2], axis=0) / 2) * 2
    plan = trimesh.Trimesh(vertex_m * [1, 1, 0], triangle, process=False)
    assert plan.area_faces == pytest.approx(2.0, rel=1e-5)
    assert size.prod() - plan.area == pytest.approx(2 * 10 * 8, abs=2 * 10)
    centre = plan.triangles[:, :, :2].reshape(-1, 6, 2).mean(axis=1) + frame.origin_m[:2]
    for house in meshes[:2]:
        low, high = house.mesh.vertex_m[:, :2].min(axis=0), house.mesh.vertex_m[:, :2].max(axis=0)
        assert not ((centre > low) & (centre < high)).all(axis=1).any()
    # on the plane of the terrain, which rises by 5 cm a metre
    x_m = vertex_m[:, 0] + frame.origin_m[0] - X
    assert vertex_m[:, 2] + frame.origin_m[2] == pytest.approx(2 + 0.05 * (x_m - 0.5), abs=1e-3)


def test_a_map_of_another_cell(meshes: list[Body], tmp_path: Path) -> None:
    frame = frame_around(meshes, "EPSG:28992")
    areas = []
    for cell_m in (0.5, 1.0):
        files = scene_files([meshes[2]], frame, {}, 3.5, map_cell_m=cell_m)
        (tmp_path / "top.ply").write_bytes(files["terrain_top.ply"])
        vertex_m, triangle = sionna_scene.read_ply(tmp_path / "top.ply")
        plan = trimesh.Trimesh(vertex_m * [1, 1, 0], triangle, process=False)
        assert plan.area_faces == pytest.approx(cell_m**2 / 2, rel=1e-3)
        areas.append(plan.area)
    assert (
        areas[0]
        == pytest.approx(areas[1])
        == pytest.approx(np.ptp(meshes[2].mesh.vertex_m[:, :2], axis=0).prod())
    )


def test_without_terrain_a_note_says_that_there_is_no_ground(meshes: list[Body], tmp_path: Path) -> None:
    write(tmp_path, meshes[:1])
    scene = sionna_scene.read(tmp_path)
    assert scene.facts["terrain_top"] is None and list(scene.shapes) == ["NL_IMBAG_Pand_0503100000000001"]
    assert scene.facts["notes"] == ["the scene has no ground; --terrain adds it"]
    assert "the scene has no ground; terrain adds it" in scene.comments


def test_split_materials(meshes: list[Body], tmp_path: Path) -> None:
    write(tmp_path, meshes, split_materials=True)
    scene = sionna_scene.read(tmp_path)
    assert {name: shape.material for name, shape in scene.shapes.items()} == {
        "terrain": "mat-medium_dry_ground",
        "NL_IMBAG_Pand_0503100000000001": "mat-concrete",
        "B_2-brick": "mat-brick",
        "B_2-tile": "mat-tile",
    }
    assert scene.materials["mat-tile"]["type"] == "brick"
    roof = np.isin(meshes[1].mesh.kind, (FaceKind.ROOF, FaceKind.FLAT)).sum()
    assert len(scene.shapes["B_2-tile"].triangle) == roof
    assert len(scene.shapes["B_2-brick"].triangle) == len(meshes[1].mesh.triangle) - roof
    assert any("does not find diffracting edges between two shapes" in note for note in scene.facts["notes"])


def test_open_ground_has_the_material_of_the_terrain(meshes: list[Body], tmp_path: Path) -> None:
    row = yard_house(X + 10, Y + 10, 2.0)
    position = [*row.origin_xy_m, row.ground_z_m]
    materials = {**BRICK, "outer_floor": "medium_dry_ground"}
    house = Body.of_building("yard", row.mesh.translated(position), materials)
    write(tmp_path / "whole", [house, meshes[2]])
    assert sionna_scene.read(tmp_path / "whole").shapes["yard"].material == "mat-brick"
    write(tmp_path / "split", [house, meshes[2]], split_materials=True)
    floor = sionna_scene.read(tmp_path / "split").shapes["yard-medium_dry_ground"]
    assert len(floor.triangle) == (row.mesh.kind == FaceKind.FLOOR).sum() > 0
    # no map of the terrain below the floor
    vertex_m, triangle = sionna_scene.read_ply(tmp_path / "split" / "terrain_top.ply")
    centre = vertex_m[triangle].reshape(-1, 6, 3)[:, :, :2].mean(axis=1)
    low = floor.vertex_m[:, :2].min(axis=0), floor.vertex_m[:, :2].max(axis=0)
    assert not ((centre > low[0]) & (centre < low[1])).all(axis=1).any()


def test_a_skin_has_the_material_of_most_of_its_walls(meshes: list[Body], tmp_path: Path) -> None:
    house = meshes[1]
    corner = house.mesh.vertex_m[house.mesh.triangle]
    # the two triangles of one long wall are of wood, and so is the whole roof
    is_wood = (house.mesh.kind == FaceKind.WALL) & (np.ptp(corner[:, :, 1], axis=1) == 0) & (
        corner[:, 0, 1] == Y + 10
    ) | (house.mesh.kind == FaceKind.ROOF)
    refs = (BuildingRef("a", BRICK), BuildingRef("b", {"wall": "wood", "roof": "wood"}))
    skin = replace(house, name="block 1", building=is_wood.astype(np.int32), buildings=refs)
    write(tmp_path, [skin])
    scene = sionna_scene.read(tmp_path)
    assert scene.shapes["block_1"].material == "mat-brick"
    assert scene.facts["shapes"]["block_1"]["buildings"] == ["a", "b"]


def test_ids_are_unique_and_plain(meshes: list[Body], tmp_path: Path) -> None:
    names = ["a/1", "A_1", "Ö--2", "terrain", ' <"&> ', "."]
    copies = [replace(meshes[0], name=name, buildings=(BuildingRef(name),)) for name in names]
    write(tmp_path, [*copies, meshes[2]])
    scene = sionna_scene.read(tmp_path)
    assert len(scene.shapes) == 7
    assert len({name.lower() for name in scene.shapes}) == 7
    stated = [shape["buildings"] for shape in scene.facts["shapes"].values()]
    assert stated == [[], *([name] for name in names)]
    assert scene.shapes["terrain"].material == "mat-medium_dry_ground"


@pytest.mark.parametrize(
    ("frequency_ghz", "constant"),
    [
        (3.5, []),
        (1.0, []),
        (10.0, []),
        (28.0, ["medium_dry_ground"]),
        (77.0, ["medium_dry_ground", "brick"]),
        (0.9, ["medium_dry_ground", "concrete", "brick"]),
        (140.0, ["medium_dry_ground"]),
    ],
)
def test_materials_at_a_frequency(
    frequency_ghz: float, constant: list[str], meshes: list[Body], tmp_path: Path
) -> None:
    """Types that the recommendation does not define there become materials of constant properties, with a note."""
    write(tmp_path, meshes, frequency_ghz)
    scene = sionna_scene.read(tmp_path)
    plain = [name for name, values in scene.materials.items() if values["kind"] == "itu-radio-material"]
    suffix = f"-{round(frequency_ghz * 1000)}-MHz"
    assert sorted(scene.materials) == sorted(plain + [f"mat-{name}{suffix}" for name in constant])
    about = [note for note in scene.facts["notes"] if note.startswith("ITU-R P.2040-3 defines ")]
    assert sorted(note.split()[3] for note in about) == sorted(constant)
    assert scene.facts["frequency_ghz"] == frequency_ghz


def test_properties_follow_the_recommendation() -> None:
    """Values of ITU-R P.2040, table 3: a f^b and c f^d."""
    assert {material.itu_type for material in MATERIALS.values()} <= set(TABLE)
    assert set(TABLE) <= sionna_scene.ITU_TYPES
    ground = properties("medium_dry_ground", 10.0)
    assert ground.relative_permittivity == pytest.approx(15 * 10**-0.1)
    assert ground.conductivity_s_per_m == pytest.approx(0.035 * 10**1.63) and ground.held_from_ghz is None
    assert ground.valid_ghz == (1, 10)
    radar = properties("medium_dry_ground", 77.0)
    assert radar.held_from_ghz == 10 and radar.relative_permittivity == ground.relative_permittivity
    # the imaginary part of the permittivity goes with the conductivity by the frequency
    assert radar.conductivity_s_per_m / 77 == pytest.approx(ground.conductivity_s_per_m / 10)
    assert properties("brick", 77.0).held_from_ghz == 110 and properties("brick", 50.0).held_from_ghz == 40
    assert properties("concrete", 200.0).relative_permittivity == 5.17


def test_the_map_of_a_large_terrain_has_larger_squares(
    meshes: list[Body], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sionna, "_MAX_SQUARES", 100)
    write(tmp_path, meshes)
    vertex_m, triangle = sionna_scene.read_ply(tmp_path / "terrain_top.ply")
    # 46 m by 26 m: 299 squares of 2 m, and 75 of 4 m
    plan = trimesh.Trimesh(vertex_m * [1, 1, 0], triangle, process=False)
    assert plan.area_faces == pytest.approx(8.0, rel=1e-5)
    facts = json.loads((tmp_path / "scene.json").read_text(encoding="utf-8"))
    assert "the squares of terrain_top.ply have 4 m, not 2: the terrain is large" in facts["notes"]
