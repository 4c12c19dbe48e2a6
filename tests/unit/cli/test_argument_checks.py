"""``p2wss reconstruct`` refuses what cannot work, and warns of what may not, in one line before the work."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import rasterio
import trimesh
from places import ROOT
from toy_survey import BOX, run, write_cloud, write_weights

from p2wss.cli.common import check_out
from p2wss.clouds import reading as clouds
from p2wss.config import OUTPUT_SUFFIXES, TABLES_AND_MODELS, Config
from p2wss.data.terrain import Terrain, write_terrain
from p2wss.footprints import cleaning as footprints
from p2wss.formats.outputs import MESH_WRITERS
from p2wss.reconstruction.inputs import output_stem
from p2wss.storage.messages import InputError


def write_files(place: Path) -> None:
    """The wrong inputs of :data:`WRONG`, beside the right ones."""
    good = gpd.read_file(place / "footprints.gpkg")
    for ending in ("gpkg", "fgb"):  # the second does not state that it has no features
        good.iloc[:0].to_file(place / f"none.{ending}")
    good.set_geometry(good.boundary).to_file(place / "lines.gpkg")
    good.to_crs(4326).to_file(place / "degrees.gpkg")
    good.to_crs(4326).to_parquet(place / "degrees.parquet")
    good.to_crs(28992).to_parquet(place / "rd.parquet")
    (place / "text.gpkg").write_text("text")
    (place / "text.parquet").write_text("text")
    (place / "text.laz").write_text("text")
    (place / "empty").mkdir()
    (place / "file").write_text("a file")
    write_cloud(place / "rd.laz", crs=28992)
    write_cloud(place / "unstated.laz", crs=None)
    good.set_crs(None, allow_override=True).to_file(place / "unstated.gpkg")
    write_weights(place / "dvae.safetensors", "dvae")
    height = np.full((80, 80), 100.0, np.float32)
    write_terrain(place / "dtm.tif", Terrain(height, 651970.0, 6861050.0, 1.0), "EPSG:2154", {})
    write_terrain(place / "rd.tif", Terrain(height, 651970.0, 6861050.0, 1.0), "EPSG:28992", {})


# (cloud, footprints, options, message)
WRONG = [
    ("gone.laz", "footprints.gpkg", [], "gone.laz: no such file"),
    ("empty", "footprints.gpkg", [], "empty: has no LAS or LAZ file"),
    ("text.laz", "footprints.gpkg", [], "text.laz: not a readable LAS, LAZ or COPC file"),
    ("footprints.gpkg", "cloud.laz", [], "footprints.gpkg: is a vector file, no point cloud"),
    ("cloud.laz", "footprints.gpkg", ["--crs", "EPSG:28992"], "but --crs states Amersfoort / RD New"),
    ("unstated.laz", "degrees.gpkg", [], "degrees.gpkg is in degrees, which is unlikely for clouds"),
    ("cloud.laz", "gone.gpkg", [], "gone.gpkg: no such file"),
    ("cloud.laz", "none.gpkg", [], "none.gpkg: has no features"),
    ("cloud.laz", "none.fgb", [], "none.fgb: has no features"),
    ("cloud.laz", "lines.gpkg", [], "lines.gpkg: has no polygons; QGIS makes them of closed lines"),
    ("cloud.laz", "text.gpkg", [], "text.gpkg: not a readable vector file"),
    ("cloud.laz", "text.parquet", [], "text.parquet: not a readable vector file"),
    ("cloud.laz", "footprints.gpkg", ["--height-field", "h"], "has no column h; its columns are"),
    ("cloud.laz", "footprints.gpkg", ["--keep-columns", "k"], "has no column k; its columns are"),
    (
        "unstated.laz",
        "unstated.gpkg",
        [],
        "states its CRS; state it with --crs, such as EPSG:28992, or for local",
    ),
    ("unstated.laz", "unstated.gpkg", ["--crs", "EPSG:999999"], "--crs EPSG:999999: no such CRS"),
    ("cloud.laz", "footprints.gpkg", ["--id-field", "nr"], "has no column nr; its columns are cleabs"),
    ("cloud.laz", "footprints.gpkg", ["--tile", "x"], "'x' is not a tile name"),
    (
        "cloud.laz",
        "footprints.gpkg",
        ["--format", "obj,dwg"],
        "reconstruct.outputs.1: Input should be 'cityjsonseq'",
    ),
    ("cloud.laz", "footprints.gpkg", ["--config", '{"reconstruct": {"buffer": 1}}'], "buffer"),
    ("cloud.laz", "footprints.gpkg", ["--model", "gone"], "gone: no such file"),
    ("cloud.laz", "footprints.gpkg", ["--model", "file"], "file: not a readable safetensors file"),
    ("cloud.laz", "footprints.gpkg", ["--model", "dvae.safetensors"], "not a model of p2wss"),
    ("cloud.laz", "footprints.gpkg", ["--format", "glb", "--terrain", "gone.tif"], "gone.tif: no such file"),
    (
        "cloud.laz",
        "footprints.gpkg",
        ["--format", "glb", "--terrain", "text.laz"],
        "text.laz: not a readable raster",
    ),
    (
        "cloud.laz",
        "footprints.gpkg",
        ["--format", "glb", "--terrain", "rd.tif"],
        "rd.tif: is in Amersfoort / RD New",
    ),
    (
        "cloud.laz",
        "footprints.gpkg",
        ["--terrain", "dtm.tif", "--format", "cityjson,gpkg"],
        "cityjson, gpkg cannot hold a terrain; add a mesh format",
    ),
    ("cloud.laz", "footprints.gpkg", ["--outputs", "gbl"], "(did you mean glb?)"),
    ("cloud.laz", "footprints.gpkg", ["--outputs", "geopackage"], "(did you mean gpkg?)"),
    (
        "cloud.laz",
        "footprints.gpkg",
        ["--outputs", "glb", "obj"],
        "state a list as one word: --outputs glb,obj",
    ),
]


@pytest.mark.parametrize(("cloud", "vector", "options", "message"), WRONG)
def test_wrong_arguments_are_one_line_and_nothing_is_written(
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    cloud: str,
    vector: str,
    options: list[str],
    message: str,
) -> None:
    write_files(place)
    monkeypatch.chdir(place)
    capfd.readouterr()
    assert run(place, *options, cloud=cloud, footprints=vector) == 2
    (line,) = [text for text in capfd.readouterr().err.splitlines() if text]
    assert line.startswith("p2wss: error: ") and message in line
    assert not (place / "out").exists()


@pytest.mark.parametrize("name", ["degrees.gpkg", "degrees.parquet", "rd.parquet"])
def test_footprints_in_another_crs_give_the_same_buildings(
    place: Path, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    write_files(place)
    caplog.set_level(logging.INFO)
    assert run(place) == 0
    expected = gpd.read_file(place / "out" / "cloud.gpkg")
    caplog.clear()
    assert run(place, "--keep-columns", "cleabs", footprints=name) == 0
    assert f"{name}: reprojected from " in caplog.text and "to RGF93 v1 / Lambert-93, " in caplog.text
    result = gpd.read_file(place / "out" / "cloud.gpkg")
    assert result.crs == expected.crs and list(result["cleabs"]) == list(expected["cleabs"])
    for first, second in zip(result.geometry, expected.geometry, strict=True):
        assert first.hausdorff_distance(second) < (1.5 if "rd" in name else 0.001)


def test_wrong_arguments_are_refused_before_anything_slow_is_imported(place: Path) -> None:
    """Importing the networks and the compiled code takes longer than a user should wait for this."""
    write_files(place)
    arguments = [
        ["reconstruct", cloud, vector, "out", "--model", "m.safetensors", *options]
        for cloud, vector, options, _ in WRONG
    ]
    arguments.append(["reconstruct", "cloud.laz", "footprints.gpkg", "file", "--model", "m.safetensors"])
    code = (
        "import json, sys\n"
        "from p2wss import cli\n"
        f"status = [cli.main(each) for each in json.loads({json.dumps(json.dumps(arguments))})]\n"
        "print(json.dumps([status, [name for name in ('torch', 'numba') if name in sys.modules]]))\n"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    output = subprocess.run(
        [sys.executable, "-c", code], cwd=place, env=environment, check=True, capture_output=True, text=True
    )
    assert json.loads(output.stdout) == [[2] * len(arguments), []], output.stderr


def test_what_a_run_does_not_need_is_not_loaded(place: Path) -> None:
    """Loading these takes as long as reconstructing many houses, and much memory."""
    unused = {"pandas", "geopandas", "pyarrow", "scipy.spatial", "scipy.ndimage", "scipy.linalg", "scipy.fft"}
    arguments = ["reconstruct", "cloud.laz", "footprints.gpkg", "out", "--model", "none"]
    code = f"import sys; from p2wss.cli import main; assert not main({arguments}); print({unused} & set(sys.modules))"
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    output = subprocess.check_output([sys.executable, "-c", code], cwd=place, env=environment, text=True)
    assert output.splitlines()[-1] == "set()" and (place / "out" / "cloud.gpkg").exists()


def test_an_output_folder_that_is_named_as_a_file(tmp_path: Path) -> None:
    for name in ("town.city.jsonl", "town.OBJ"):
        with pytest.raises(InputError, match=f"{name}: results are several files; name a folder"):
            check_out(tmp_path / name, Config())
    # one that is there may have any name
    (tmp_path / "town.obj").mkdir()
    check_out(tmp_path / "town.obj", Config())


def test_an_output_folder_that_is_a_file_or_cannot_be_written(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "out").write_text("a file")
    assert run(place) == 2
    assert "out is a file; name a folder" in capsys.readouterr().err
    (place / "out").unlink()

    def refuse(dir: Path) -> None:
        raise PermissionError(13, "Permission denied", str(dir))

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    assert run(place) == 2
    assert "out: not written: Permission denied" in capsys.readouterr().err
    assert not (place / "out").exists()


def test_a_cloud_without_points_of_a_class_is_a_warning(
    place: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    for roof_class, ground_class, warnings in (
        (6, 2, []),
        (1, 2, ["class 6 (building)"]),
        (6, 1, ["class 2 (ground)"]),
        (1, 1, ["class 2 (ground)", "class 6 (building)"]),
    ):
        write_cloud(place / "cloud.laz", roof_class, ground_class)
        caplog.clear()
        assert run(place) == 0
        lines = [record.getMessage() for record in caplog.records]
        found = [line for line in lines if line.startswith("warning: ")]
        assert len(found) == len(warnings)
        assert all(text in line and "\n" not in line for text, line in zip(warnings, found, strict=True))
        # before the work
        assert all(lines.index(line) < len(lines) - 2 for line in found)


@pytest.mark.parametrize(
    ("columns", "ids", "warning"),
    [
        ({"id": ["a", "b", "c"]}, ["a", "b", "c"], None),
        ({"name": ["x", "x", "x"]}, ["1", "2", "3"], None),
        ({"id": ["a", "a", "c"]}, ["a", "a_2", "c"], "id column id: a occurs more than once; repeated ids get"),
        ({"id": ["a", None, "c"]}, ["a", "2", "c"], "id column id: 1 of 3 values are missing; repeated ids get"),
        ({"building_id": [7, 7, 8], "OSM_ID": [4, 5, 6]}, ["4", "5", "6"], "; ids are taken from column OSM_ID"),
    ],
)  # fmt: skip
def test_ids_that_cannot_be_used_are_a_warning(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    columns: dict[str, list[object]],
    ids: list[str],
    warning: str | None,
) -> None:
    gpd.GeoDataFrame(pd.DataFrame(columns), geometry=[BOX] * 3, crs=2154).to_file(tmp_path / "f.gpkg")
    frame = footprints.read_footprints(tmp_path / "f.gpkg")
    assert frame["building_id"].tolist() == ids
    lines = [record.getMessage() for record in caplog.records]
    if warning is None:
        assert lines == []
    else:
        (line,) = lines
        assert line.startswith("warning: ") and "f.gpkg" in line and warning in line


def test_a_folder_of_clouds_names_the_outputs_and_files_elsewhere_are_not_read(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = place / "survey"
    folder.mkdir()
    (place / "cloud.laz").rename(folder / "b.LAZ")
    write_cloud(folder / "a.las", ground_class=1)
    (folder / "notes.txt").write_text("no cloud")
    read: list[Path] = []
    read_in_chunks = clouds.read_in_chunks
    monkeypatch.setattr(
        clouds, "read_in_chunks", lambda paths, *more: read.extend(paths) or read_in_chunks(paths, *more)
    )
    assert run(place, cloud="survey") == 0
    assert read == [folder / "a.las", folder / "b.LAZ"]
    # the points of both are the same, and used once
    assert gpd.read_file(place / "out" / "survey.gpkg")["num_points"].tolist() == [450]
    # the same cloud, with footprints elsewhere: refused by the bounds in the headers
    good = gpd.read_file(place / "footprints.gpkg")
    good.set_geometry(good.translate(5000, 0)).to_file(place / "far.gpkg")
    read.clear()
    assert run(place, cloud="survey", footprints="far.gpkg") == 2
    assert "no point near any of the 1 footprints" in capsys.readouterr().err and read == []


def test_a_terrain_without_crs_is_in_that_of_the_clouds(
    place: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    caplog.set_level(logging.INFO)
    (place / "dtm.asc").write_text(
        "ncols 80\nnrows 80\nxllcorner 651970\nyllcorner 6860970\ncellsize 1\n" + "100 " * 6400
    )
    with rasterio.open(place / "dtm.asc") as raster:
        assert raster.crs is None
    assert run(place, "--terrain", str(place / "dtm.asc"), "--format", "glb") == 0
    assert "dtm.asc does not state its CRS; assuming RGF93 v1 / Lambert-93" in caplog.text
    assert "terrain" in trimesh.load_scene(place / "out" / "cloud.glb").geometry
    write_cloud(place / "cloud.laz", crs=None)
    good = gpd.read_file(place / "footprints.gpkg")
    good.set_crs(None, allow_override=True).to_file(place / "unstated.gpkg")
    options = ["--terrain", str(place / "dtm.asc"), "--format", "glb", "--crs", "EPSG:2154"]
    assert run(place, *options, footprints="unstated.gpkg") == 0
    # a terrain elsewhere
    content = (place / "dtm.asc").read_text().replace("651970", "951970")
    (place / "dtm.asc").write_text(content)
    assert run(place, *options) == 2
    assert "dtm.asc: is in RGF93 v1 / Lambert-93, and has no cell at" in capsys.readouterr().err


def test_files_per_building_of_formats_without_meshes_are_a_warning(
    place: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert run(place, "--per-building", "--format", "gpkg") == 0
    assert "warning: --per-building has no effect on files: none of gpkg is a mesh format" in caplog.text
    assert run(place, "--vegetation", "--format", "gpkg") == 0
    assert "warning: --vegetation has no effect on files: none of gpkg has plants" in caplog.text


def test_formats_hold_meshes_or_not() -> None:
    assert set(OUTPUT_SUFFIXES) - set(TABLES_AND_MODELS) == set(MESH_WRITERS)


def test_headers_without_bounds_are_read(tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.las")
    (header,) = clouds.read_headers([tmp_path / "a.las"])
    assert header.num_points == 450 and header.crs is not None and header.bounds is not None
    assert header.overlaps((652000, 6861000, 652001, 6861001))
    assert not header.overlaps((652020, 6861000, 652030, 6861001))
    unknown = clouds.CloudHeader(header.path, 450, header.crs, None)
    assert unknown.overlaps((652020, 6861000, 652030, 6861001))
    assert output_stem(tmp_path) == tmp_path.name
