"""``p2wss reconstruct`` as a user runs it: files in, files out, or one line and nothing lost."""

from __future__ import annotations

import json
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyproj
import pytest
import sionna_scene
import trimesh
from oracle_network import Oracle
from toy_survey import run, write_weights

import p2wss
from p2wss import cli
from p2wss.data.terrain import Terrain, write_terrain
from p2wss.nets import predictor, weights_file
from p2wss.nets.weights_file import shipped_model


def test_files_named_after_the_cloud(place: Path) -> None:
    assert run(place) == 0
    assert sorted(p.name for p in (place / "out").iterdir()) == [
        "cloud.city.jsonl",
        "cloud.gpkg",
        "cloud.html",
        "cloud.json",
    ]
    (row,) = gpd.read_file(place / "out" / "cloud.gpkg").to_dict("records")
    assert (row["building_id"], row["status"], row["method"]) == ("A", "ok", "point2wss")
    assert row["eave_height_m"] == pytest.approx(6.0) and row["ground_z_m"] == pytest.approx(101.0)


def test_without_a_model_the_points_decide(place: Path) -> None:
    files = [str(place / part) for part in ("cloud.laz", "footprints.gpkg", "out")]
    assert cli.main(["reconstruct", *files]) == 0
    (row,) = gpd.read_file(place / "out" / "cloud.gpkg").to_dict("records")
    assert (row["status"], row["method"]) == ("ok", "fit")
    # the flat roof that the points show
    assert row["angle_deg"] == "0 0 0 0" and row["residual_m"] < 0.01


def test_materials_of_the_command_line(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They win over the config, which keeps the others; a misspelt one is refused before the work."""
    config = '{"reconstruct": {"materials": {"wall": "wood", "roof": "slate"}}}'
    options = ["--format", "obj", "--config", config]
    assert run(place, *options, "--materials", "wall=brick, ground=wet_ground") == 0
    lines = (place / "out" / "cloud.obj").read_text().splitlines()
    assert {line for line in lines if line.startswith("usemtl")} == {"usemtl brick", "usemtl slate"}
    for text, reason in (("wall=brik", "wall: Input should be"), ("window=glass", "window: unknown key")):
        assert run(place, "--materials", text) == 2
        assert f"reconstruct.materials.{reason}" in capsys.readouterr().err


def test_a_scene_for_sionna(place: Path, caplog: pytest.LogCaptureFixture) -> None:
    """One building on terrain for a radar at 77 GHz: every file of the folder is read by a strict reader."""
    land = Terrain(np.full((40, 40), 100.9, np.float32), 651985.0, 6861024.0, 1.0)
    write_terrain(place / "dtm.tif", land, pyproj.CRS.from_epsg(2154), {})
    codes = gpd.read_file(place / "footprints.gpkg").assign(
        materiaux_des_murs="10", materiaux_de_la_toiture="20"
    )
    codes.to_file(place / "footprints.gpkg")
    options = ["--model", "none", "--format", "sionna", "--terrain", str(place / "dtm.tif")]
    with caplog.at_level("INFO"):
        assert run(place, *options, "--frequency-ghz", "77") == 0
    assert sorted(path.name for path in (place / "out").iterdir()) == ["cloud.json", "cloud_sionna"]
    scene = sionna_scene.read(place / "out" / "cloud_sionna")
    assert set(scene.shapes) == {"terrain", "A"}
    for shape in scene.shapes.values():
        solid = trimesh.Trimesh(shape.vertex_m, shape.triangle, process=False)
        assert solid.is_watertight and solid.volume > 0
    # 10 m by 8 m by 6 m above the ground of the cloud, and down to 0.5 m below the terrain
    house = trimesh.Trimesh(scene.shapes["A"].vertex_m, scene.shapes["A"].triangle, process=False)
    assert house.volume == pytest.approx(10 * 8 * (107 - 100.4), rel=0.01)
    # walls of stone are marble to the recommendation, which ends at 60 GHz; the ground ends at 10 GHz
    assert scene.shapes["A"].material == "mat-stone-77000-MHz"
    assert scene.shapes["terrain"].material == "mat-medium_dry_ground-77000-MHz"
    for about in (
        "marble from 1 to 60 GHz",
        "medium_dry_ground from 1 to 10 GHz",
        "material of most of its walls",
    ):
        assert about in caplog.text
    assert run(place, *options, "--frequency-ghz", "0") == 2


def test_the_weights_of_the_package_have_a_name(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    came, own = write_weights(place / "point2wss.safetensors"), write_weights(place / "own")
    loaded: list[Path] = []
    monkeypatch.setattr(predictor, "load_predictor", lambda path, device: loaded.append(path) or Oracle())
    monkeypatch.setattr(weights_file, "shipped_model", lambda: came)
    files = [str(place / part) for part in ("cloud.laz", "footprints.gpkg", "out")]
    for options, method, wanted in (
        ([], "fit", []),
        (["--roofs", "parametric"], "fit", []),
        (["--model", "none"], "fit", []),
        (["--model", "point2wss"], "point2wss", [came]),
        (["--model", str(own)], "point2wss", [own]),
    ):
        loaded.clear()
        assert cli.main(["reconstruct", *files, *options]) == 0 and loaded == wanted
        assert gpd.read_file(place / "out" / "cloud.gpkg")["method"].tolist() == [method]
    monkeypatch.setattr(weights_file, "shipped_model", lambda: None)
    assert cli.main(["reconstruct", *files, "--model", "point2wss"]) == 2
    assert "this p2wss has no weights; name a file" in capsys.readouterr().err


def test_shipped_weights_are_found_in_the_package() -> None:
    weights = shipped_model()
    assert weights is None or weights.stat().st_size > 0
    expected = Path(p2wss.__file__).parent / "weights" / "point2wss.safetensors"
    assert (weights == expected) if expected.exists() else weights is None


def test_the_device_is_that_of_the_option(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    devices: list[str] = []
    monkeypatch.setattr(predictor, "load_predictor", lambda path, device: devices.append(device) or Oracle())
    assert run(place) == 0 and run(place, "--device", "cpu") == 0
    assert devices == ["auto", "cpu"]


def test_formats_of_the_command_line(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(place, "--format", "stl, obj", "--per-building") == 0
    out = place / "out"
    assert sorted(str(path.relative_to(out)) for path in out.rglob("*.*")) == [
        "cloud.json", "cloud.mtl", "cloud.obj", "cloud.stl", "cloud/A.mtl", "cloud/A.obj", "cloud/A.stl"
    ]  # fmt: skip
    capsys.readouterr()
    assert run(place, "--format", "obj,dwg") == 2
    assert (
        "reconstruct.outputs.1: Input should be 'cityjsonseq', 'cityjson', 'glb'" in capsys.readouterr().err
    )


def test_levels_of_detail_and_names_of_attributes(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--model", "none", "--format", "cityjsonseq", "--crs", "EPSG:5698"]
    assert run(place, *options, "--lods", "1.2, 2.0", "--attribute-names", "3dbag") == 0
    path = place / "out" / "cloud.city.jsonl"
    header, feature, *_ = map(json.loads, path.read_text().splitlines())
    assert header["metadata"]["referenceSystem"].endswith("/5698")
    assert "from cloud.laz" in header["metadata"]["title"]
    building = feature["CityObjects"][feature["id"]]
    assert [geometry["lod"] for geometry in building["geometry"]] == ["1.2", "2.0"]
    assert {"b3_dak_type", "b3_h_dak_70p", "b3_volume_lod22"} <= set(building["attributes"])
    assert cli.main(["check", str(path)]) == 0
    assert capsys.readouterr().out.endswith(": 2 solids, 0 invalid\n")
    assert run(place, "--lods", "2.2") == 2
    assert "reconstruct.lods.0: Input should be '1.2' or '2.0'" in capsys.readouterr().err


def test_a_terrain_joins_the_meshes(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    height = np.full((80, 80), 100.0, np.float32)
    for name, crs in (("dtm.tif", "EPSG:2154"), ("rd.tif", "EPSG:28992")):
        write_terrain(place / name, Terrain(height, 651970.0, 6861050.0, 1.0), crs, {})
    assert run(place, "--terrain", str(place / "dtm.tif"), "--format", "glb") == 0
    scene = trimesh.load_scene(place / "out" / "cloud.glb")
    assert set(scene.geometry) == {"A", "terrain"} and all(m.is_watertight for m in scene.geometry.values())
    # the house reaches below the land it stands on
    assert scene.geometry["A"].bounds[0, 1] < scene.geometry["terrain"].bounds[1, 1]
    capsys.readouterr()
    assert run(place, "--terrain", str(place / "rd.tif"), "--format", "glb") == 2
    assert "rd.tif: is in Amersfoort" in capsys.readouterr().err


def test_a_tile_names_the_outputs_and_may_be_empty(place: Path) -> None:
    assert run(place, "--tile", "0652_6862") == 0
    assert run(place, "--tile", "0700_6862") == 0
    assert len(gpd.read_file(place / "out" / "0652_6862.gpkg")) == 1
    assert len(gpd.read_file(place / "out" / "0700_6862.gpkg")) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("cloud", "truncated"),
        ("gone", "no such file"),
        ("crs", "no point near any"),
        ("lines", "no polygons"),
        ("elsewhere", "no point near any"),
    ],
)
def test_bad_input_is_one_line_and_changes_no_file(
    change: str, message: str, place: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(place) == 0
    before = {path.name: path.read_bytes() for path in (place / "out").iterdir()}
    capfd.readouterr()
    cloud, other = place / "cloud.laz", place / "other.gpkg"
    good = gpd.read_file(place / "footprints.gpkg")
    if change == "cloud":
        cloud.write_bytes(cloud.read_bytes()[:-600])
    if change == "gone":
        cloud.unlink()
    if change == "crs":
        good.set_crs(28992, allow_override=True).to_file(other)
    if change == "lines":
        good.set_geometry(good.boundary).to_file(other)
    if change == "elsewhere":
        good.set_geometry(good.translate(5000, 0)).to_file(other)
    assert run(place, footprints=other.name if other.exists() else "footprints.gpkg") == 2
    *before_it, line = [text for text in capfd.readouterr().err.splitlines() if text]
    assert line.startswith("p2wss: error: ") and message in line
    # nothing else, no traceback
    assert before_it == []
    assert {path.name: path.read_bytes() for path in (place / "out").iterdir()} == before


def test_a_folder_that_cannot_be_written_is_one_line(place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (place / "out").write_text("a file")
    assert run(place) == 2
    assert "not written" in capfd.readouterr().err.splitlines()[-1]


def test_skin_and_wedges_by_options(place: Path) -> None:
    assert run(place, "--skin", "--wedges") == 0
    summary = json.loads((place / "out" / "cloud.json").read_text())
    assert summary["skin"] == {"blocks": 0, "buildings_in_blocks": 0, "not_joined": 0, "cut_from_terrain": 0}
    table = pd.read_parquet(place / "out" / "cloud.wedges.parquet")
    assert set(table["building_id_0"]) == {"A"} and len(table) >= 12
