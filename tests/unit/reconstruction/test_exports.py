"""The output files of a reconstruction: the same content in all formats, each written whole or not at all."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import cityjson_rules
import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
import sionna_scene
import trimesh
from toy_clouds import LAMBERT, cleaned, cloud_over

import p2wss
from p2wss.cli import inspection
from p2wss.config import OUTPUT_SUFFIXES, Reconstruct
from p2wss.data.terrain import Terrain
from p2wss.reconstruction.outputs import exports
from p2wss.reconstruction.pipeline import run
from p2wss.reconstruction.result import Result
from p2wss.reconstruction.skin import block_skins
from p2wss.storage import files
from p2wss.storage.messages import InputError
from p2wss.storage.schemas.wedges import WEDGES

X, Y = 652000.0, 6861000.0
EVERYTHING = Reconstruct(outputs=list(OUTPUT_SUFFIXES), per_building=True)


@pytest.fixture(scope="module")
def results() -> list[Result]:
    """Two flat houses 6 m high on ground at 2 m, and a footprint without points."""
    boxes = [shapely.box(X + 30 * i, Y, X + 30 * i + 10, Y + 8) for i in range(2)]
    frame = gpd.GeoDataFrame(
        {"building_id": ["A/1", "a_1", "far"]},
        geometry=[*boxes, shapely.box(X + 900, Y, X + 910, Y + 9)],
        crs=LAMBERT,
    )
    return run(cleaned(frame), cloud_over(*boxes), None, "tile", Reconstruct())


def test_the_summary_tells_whether_a_delivered_file_is_damaged(results: list[Result], tmp_path: Path) -> None:
    config = EVERYTHING.model_copy(update={"per_building": True})
    exports.write(tmp_path, "out", results, LAMBERT, {}, config)
    delivered = {path for path in tmp_path.rglob("*") if path.is_file()} - {tmp_path / "out.json"}
    assert len(delivered) > 10
    summary = tmp_path / "out.json"
    assert set(json.loads(summary.read_text())["sha256"]) == {
        path.relative_to(tmp_path).as_posix() for path in delivered
    }
    assert inspection.check(summary)["checksum"] == inspection.INTACT
    for path in delivered:
        content = path.read_bytes()
        place = len(content) // 2
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        assert inspection.check(summary)["checksum"] == (
            f"{path.relative_to(tmp_path).as_posix()}: damaged or changed"
        )
        path.write_bytes(content)
    path.unlink()
    assert "not readable: No such file" in inspection.check(summary)["checksum"]


def test_every_format_has_the_same_content(results: list[Result], tmp_path: Path) -> None:
    written = exports.write(tmp_path, "out", results, LAMBERT, {"code": "x"}, EVERYTHING)
    names = sorted(path.name for path in tmp_path.iterdir() if path.is_file())
    suffixes = [suffix for suffix in OUTPUT_SUFFIXES.values() if "/" not in suffix]
    assert names == sorted([f"out{suffix}" for suffix in suffixes] + ["out.json", "out.mtl"])
    assert list(sionna_scene.read(tmp_path / "out_sionna").shapes) == ["A_1", "a_1-2"]
    assert sorted(written) == sorted(path for path in tmp_path.rglob("*") if path.is_file())

    summary = json.loads((tmp_path / "out.json").read_text())
    assert (
        summary["crs"] == "EPSG:2154"
        and summary["origin_m"] == [X, Y, 2]
        and summary["p2wss"] == {"code": "x"}
    )
    assert summary["buildings"]["status"] == {"ok": 2, "none": 1}
    assert summary["buildings"]["reasons"] == {"no-points": 1} and summary["buildings"]["total"] == 3

    gpkg, parquet = gpd.read_file(tmp_path / "out.gpkg"), gpd.read_parquet(tmp_path / "out.parquet")
    assert gpkg.crs == parquet.crs == LAMBERT and files.read_metadata(tmp_path / "out.parquet") == {
        "code": "x"
    }
    assert gpkg["building_id"].tolist() == ["A/1", "a_1", "far"]
    for column in gpkg.columns.drop("geometry"):
        for a, b in zip(gpkg[column], parquet[column], strict=True):
            assert (pd.isna(a) and pd.isna(b)) or a == b
    assert gpkg.geometry.geom_equals(parquet.geometry).all()
    attributes = {
        feature["id"]: feature["CityObjects"][feature["id"]]["attributes"]
        for feature in map(json.loads, (tmp_path / "out.city.jsonl").read_text().splitlines()[1:])
    }
    document = json.loads((tmp_path / "out.city.json").read_text())
    assert cityjson_rules.assert_document(document) == 2
    for row in parquet.to_dict("records"):
        properties = attributes[row["building_id"]]
        assert properties == document["CityObjects"][row["building_id"]]["attributes"]
        assert set(properties) == set(row) - {"building_id", "geometry"}
        assert properties["status"] == row["status"] and properties["num_points"] == row["num_points"]

    for suffix in (".obj", ".ply", ".stl", ".glb"):
        volume = sum(m.volume for m in trimesh.load_scene(tmp_path / f"out{suffix}").geometry.values())
        assert volume == pytest.approx(2 * 10 * 8 * 6, rel=1e-3)
        singles = sorted(path.name for path in (tmp_path / "out").glob(f"*{suffix}"))
        # ids that are the same on a file system that ignores case
        assert singles == [f"A_1{suffix}", f"a_1-2{suffix}"]
        first = trimesh.load_mesh(tmp_path / "out" / f"A_1{suffix}")
        assert first.is_watertight and first.volume == pytest.approx(480, rel=1e-3)
        # all with the origin of the tile
        second = trimesh.load_mesh(tmp_path / "out" / f"a_1-2{suffix}")
        assert second.bounds[0, 0] == pytest.approx(30, abs=1e-3)


def test_columns_that_tables_have_no_type_for_are_text(results: list[Result], tmp_path: Path) -> None:
    """A table of Python may have values of any types in one column, which cost the whole file; and numbers of cells
    may have 64 bits without a sign, which lost their last digits."""
    columns = {
        "mixed": ["1", 2, None],
        "cell": [2**63 + 5, 1, 2],
        "flag": [True, 2, None],
        "whole": [2**62 + 1, 1, 2],
    }
    rows = [
        replace(result, columns={name: values[k] for name, values in columns.items()})
        for k, result in enumerate(results)
    ]
    exports.write(tmp_path, "out", rows, LAMBERT, {}, Reconstruct(outputs=["gpkg", "geoparquet", "cityjson"]))
    for table in (
        gpd.read_file(tmp_path / "out.gpkg", layer="buildings"),
        gpd.read_parquet(tmp_path / "out.parquet"),
    ):
        assert table["cell"].tolist() == ["9223372036854775813", "1", "2"]
        assert table["mixed"].tolist()[:2] == ["1", "2"] and table["mixed"].isna().tolist()[2]
        assert table["flag"].tolist()[:2] == ["True", "2"] and table["whole"].tolist() == columns["whole"]


def test_materials_are_those_of_the_columns_or_of_the_settings(tmp_path: Path) -> None:
    """BD TOPO's codes of brick walls and slate roofs; a footprint without a code has the settings' materials."""
    boxes = [shapely.box(X + 30 * i, Y, X + 30 * i + 10, Y + 8) for i in range(2)]
    frame = gpd.GeoDataFrame(
        {
            "building_id": ["A", "B"],
            "materiaux_des_murs": ["49", None],
            "materiaux_de_la_toiture": ["20", "90"],
            "usage": ["Annexe", None],
        },
        geometry=boxes,
        crs=LAMBERT,
    )
    results = run(cleaned(frame), cloud_over(*boxes), None, "tile", Reconstruct())
    assert [dict(result.columns) for result in results] == [
        {"materiaux_des_murs": "49", "materiaux_de_la_toiture": "20", "usage": "Annexe"},
        {"materiaux_des_murs": None, "materiaux_de_la_toiture": "90", "usage": None},
    ]
    plain = {"wall": "wood", "roof": "metal", "ground": "wet_ground"}
    config = Reconstruct(materials=plain, outputs=["obj"])
    assert [exports.mesh(result, config).buildings[0].materials for result in results] == [
        {"wall": "brick", "roof": "slate", "ground": "brick", "outer_floor": "wet_ground"},
        {"wall": "wood", "roof": "metal", "ground": "wood", "outer_floor": "wet_ground"},
    ]
    ignored = Reconstruct(materials={**plain, "from_footprints": False})
    assert exports.mesh(results[0], ignored).buildings[0].materials["wall"] == "wood"
    exports.write(tmp_path, "out", results, LAMBERT, {}, config)
    lines = (tmp_path / "out.obj").read_text().splitlines()
    assert {line for line in lines if line.startswith("usemtl")} == {
        "usemtl brick",
        "usemtl slate",
        "usemtl wood",
        "usemtl metal",
    }
    assert "mtllib out.mtl" in lines and (tmp_path / "out.mtl").read_text().count("newmtl") == 4


def test_the_name_of_a_material_library_has_no_blank(results: list[Result], tmp_path: Path) -> None:
    exports.write(tmp_path, "my old tile", results, LAMBERT, {}, Reconstruct(outputs=["obj"]))
    (line,) = (
        line
        for line in (tmp_path / "my old tile.obj").read_text(encoding="utf-8").splitlines()
        if line.startswith("mtllib")
    )
    assert line == "mtllib my_old_tile.mtl" and (tmp_path / "my_old_tile.mtl").is_file()


def test_meshes_stand_in_the_terrain(results: list[Result], tmp_path: Path) -> None:
    slope = np.tile(np.linspace(0, 4, 200, dtype=np.float32), (100, 1))
    land = Terrain(slope, X - 80, Y + 50, 1.0)
    config = Reconstruct(
        outputs=["glb", "cityjsonseq"], terrain_margin_m=15, materials={"ground": "wet_ground"}
    )
    exports.write(tmp_path, "out", results, LAMBERT, {}, config, land)
    scene = trimesh.load_scene(tmp_path / "out.glb")
    assert set(scene.geometry) == {"A/1", "a_1", "terrain"}
    assert scene.geometry["terrain"].visual.material.name == "wet_ground"
    assert all(mesh.is_watertight and mesh.volume > 0 for mesh in scene.geometry.values())
    low, high = scene.geometry["terrain"].bounds
    # 70 m by 38 m, to the centres of the next cells
    assert high[0] - low[0] == pytest.approx(71, abs=0.01) and high[2] - low[2] == pytest.approx(39, abs=0.01)
    assert scene.geometry["A/1"].bounds[0, 1] < scene.geometry["a_1"].bounds[0, 1]
    summary = json.loads((tmp_path / "out.json").read_text())
    num_triangles = len(scene.geometry["terrain"].faces)
    assert summary["terrain"] == {"mesh": "terrain", "triangles": num_triangles, "spacing_m": 1.0}
    # the buildings in CityJSON do not change
    (tmp_path / "without_terrain").mkdir()
    exports.write(tmp_path / "without_terrain", "out", results, LAMBERT, {}, config)
    assert (tmp_path / "out.city.jsonl").read_text() == (
        tmp_path / "without_terrain" / "out.city.jsonl"
    ).read_text()


def test_touching_buildings_share_a_skin(tmp_path: Path) -> None:
    boxes = [shapely.box(X + 10 * i, Y, X + 10 * i + 10, Y + 8) for i in range(2)]
    boxes.append(shapely.box(X + 40, Y, X + 50, Y + 8))
    frame = gpd.GeoDataFrame({"building_id": ["b", "a", "alone"]}, geometry=boxes, crs=LAMBERT)
    row = run(cleaned(frame), cloud_over(*boxes), None, "tile", Reconstruct())
    config = Reconstruct(outputs=["ply", "cityjsonseq"], skin=True, wedges=True)
    written = exports.write(tmp_path, "out", row, LAMBERT, {"code": "x"}, config)
    pieces = trimesh.load_mesh(tmp_path / "out.ply").split()
    assert len(pieces) == 2 and all(piece.is_volume for piece in pieces)
    summary = json.loads((tmp_path / "out.json").read_text())
    assert summary["skin"] == {"blocks": 1, "buildings_in_blocks": 2, "not_joined": 0, "cut_from_terrain": 0}
    meshes = [exports.mesh(result, config) for result in row]
    skins = block_skins.joined(meshes)
    block, alone = block_skins.skin_bodies(skins, meshes)
    assert (block.name, alone.name) == ("block_a", "alone")
    assert [building.building_id for building in block.buildings] == ["a", "b"]
    # a box of 20 m by 8 m, of which each building has one half
    assert trimesh.Trimesh(block.mesh.vertex_m, block.mesh.triangle).volume == pytest.approx(
        2 * 80 * 6, rel=1e-3
    )
    assert len(block.mesh.triangle) < 0.9 * sum(len(mesh.mesh.triangle) for mesh in meshes[:2])

    assert tmp_path / "out.wedges.parquet" in written
    assert files.read_metadata(tmp_path / "out.wedges.parquet") == {"code": "x"}
    table = files.read_table(tmp_path / "out.wedges.parquet", WEDGES).to_pandas()
    assert table["opening_angle_deg"].to_numpy() == pytest.approx(np.full(len(table), 90), abs=0.1)
    of_block = table[table["skin"] == 0]
    assert set(of_block["building_id_0"]) == {"a", "b"} and (table["skin"] == 1).sum() == 12
    assert (of_block["building_id_0"] == of_block["building_id_1"]).all()
    # in the CRS; nothing where the houses meet, x = 10
    middle = (of_block["x0_m"] + of_block["x1_m"]) / 2 - X
    assert ((middle - 10).abs() > 1).all()
    land = Terrain(np.full((100, 200), 2, np.float32), X - 80, Y + 50, 1.0)
    for skin_terrain in ("cut", "overlap"):
        (tmp_path / skin_terrain).mkdir()
        stated = config.model_copy(update={"skin_terrain": skin_terrain})
        exports.write(tmp_path / skin_terrain, "out", row, LAMBERT, {}, stated, land)
        summary = json.loads((tmp_path / skin_terrain / "out.json").read_text())
        assert summary["skin"]["cut_from_terrain"] == (2 if skin_terrain == "cut" else 0)
        mesh = trimesh.load_mesh(tmp_path / skin_terrain / "out.ply")
        assert mesh.is_watertight and mesh.volume > 0
        table = files.read_table(tmp_path / skin_terrain / "out.wedges.parquet", WEDGES).to_pandas()
        assert ("ground" in set(table["kind_0"]) | set(table["kind_1"])) == (skin_terrain == "overlap")
    # CityJSON keeps a solid per building
    document = (tmp_path / "out.city.jsonl").read_text().splitlines()
    assert [json.loads(line)["id"] for line in document[1:]] == ["b", "a", "alone"]


def test_terrain_of_another_place_is_refused(results: list[Result], tmp_path: Path) -> None:
    away = Terrain(np.zeros((20, 20), np.float32), X + 5000, Y, 1.0)
    with pytest.raises(InputError, match="no height around the buildings"):
        exports.write(tmp_path, "out", results, LAMBERT, {}, Reconstruct(), away)
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_written_leaves_the_others_whole(results: list[Result], tmp_path: Path) -> None:
    (tmp_path / "out.obj").mkdir()
    (tmp_path / "out.obj" / "in the way").touch()
    with pytest.raises(InputError, match=r"out\.obj: not written"):
        exports.write(tmp_path, "out", results, LAMBERT, {}, Reconstruct(outputs=["stl", "obj", "ply"]))
    assert sorted(os.listdir(tmp_path)) == ["out.mtl", "out.obj", "out.stl"]
    assert trimesh.load_mesh(tmp_path / "out.stl").is_watertight


@pytest.mark.parametrize(("gap_m", "doubts"), [(0.5, {}), (3.0, {"mostly-unseen": 1})])
def test_a_building_of_which_less_than_half_is_seen_is_to_be_checked(
    gap_m: float, doubts: dict[str, int], tmp_path: Path
) -> None:
    x, y = np.random.default_rng(0).uniform(-5, 15, (2, 6000))
    is_roof = (np.abs(x - 5) < 5) & (np.abs(y - 5) < 5)
    points = np.column_stack([x, y, np.where(is_roof, 6.0, 0.0), np.where(is_roof, 6, 2)])
    # patches of 1 m
    points = points[~is_roof | ((x % (1 + gap_m) < 1) & (y % (1 + gap_m) < 1))]
    footprints = gpd.GeoSeries([shapely.box(0, 0, 10, 10)], crs=28992).translate(85000, 447000)
    points[:, :2] += 85000, 447000
    config = {"reconstruct": {"registration": "never"}}  # which has a flag for most of these
    with p2wss.reconstruct(points, footprints, model="none", config=config, progress=False) as scene:
        counts = files.read_json(scene.write(tmp_path, ["gpkg"])[-1], dict)["buildings"]
    assert counts["status"] == {"ok": 1} and counts["doubts"] == doubts
