"""Facts about files, compared with their contents."""

from __future__ import annotations

import json
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import control_houses as houses
import geopandas as gpd
import laspy
import numpy as np
import pyproj
import pytest
import rasterio
import torch
from drawn_towns.planes import mesh_of
from places import MINI, SHARED
from safetensors.torch import save_file

from p2wss.cli import main
from p2wss.cli.inspection import describe, text
from p2wss.data.terrain import Terrain, write_terrain
from p2wss.formats import gpkg
from p2wss.formats.glb import glb
from p2wss.formats.meshes import Body, frame_around
from p2wss.storage import files
from p2wss.storage.features import Features
from p2wss.storage.messages import InputError
from p2wss.storage.schemas.measures import MEASURES

DATA = SHARED / "data"
LAZ = MINI / "lidar" / "LHD_FXX_0653_6861_PTS_LAMB93_IGN69.laz"
GPKG = MINI / "bdtopo" / "BDTOPO_mini.gpkg"
ASC = MINI / "rgealti" / "RGEALTI_FXX_0652_6861_MNT_LAMB93_IGN69.asc"
FACTS = {"version": "1", "code": "abc", "config": json.dumps({"scans": {"seed": 3}})}
SHOWN = {"version": "1", "code": "abc", "config": {"scans": {"seed": 3}}}


def test_cloud() -> None:
    facts, cloud = describe(LAZ), laspy.read(LAZ)
    assert facts["num_points"] == len(cloud)
    assert facts["num_points by class"] == {c: int((cloud.classification == c).sum()) for c in (1, 2, 5, 6)}
    assert facts["crs"] == "RGF93 v1 / Lambert-93 (EPSG:2154)"
    assert facts["bounds"] == pytest.approx(
        [cloud.x.min(), cloud.y.min(), cloud.x.max(), cloud.y.max()], abs=0.011
    )
    (x_min, y_min, x_max, y_max) = facts["bounds"]
    density = len(cloud) / ((x_max - x_min) * (y_max - y_min))
    assert facts["points per m2 of the bounds"] == pytest.approx(density, abs=0.006)


@pytest.mark.parametrize("code", [2154, 2263, 4326, 3857])
def test_the_density_of_a_cloud_is_per_square_metre_on_the_ground(code: int, tmp_path: Path) -> None:
    """The same hectare with 400 points in metres, feet, degrees, and in a projection that makes it longer."""
    metric, x_m, y_m = (32118, 300_000.0, 60_000.0) if code == 2263 else (2154, 652_000.0, 6_862_000.0)
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0.0, 100.0, 20)] * 2))
    x, y = pyproj.Transformer.from_crs(metric, code, always_xy=True).transform(x_m + x, y_m + y)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = [x.min(), y.min(), 0.0], [1e-6, 1e-6, 0.01]
    header.add_crs(pyproj.CRS(code))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = x, y, np.zeros(len(x))
    cloud.write(tmp_path / "cloud.las")
    assert describe(tmp_path / "cloud.las")["points per m2 of the bounds"] == pytest.approx(0.04, rel=0.1)


@pytest.mark.skipif(not DATA.exists(), reason="no shared/data")
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "lidarhd_crops/77050_627755_LA93_IGN69.copc.laz",
            {"kind": "point cloud, COPC", "num_points": 73355},
        ),
        ("delft_ahn3/ahn3.laz", {"num_points": 190006, "crs": None}),
        ("delft_ahn3/roofer_lod22.city.jsonl", {"num_features": 74, "version": "2.0"}),
        (
            "olemps_bdtopo/dtm/RGEALTI_FXX_0664_6360_MNT_LAMB93_IGN69.asc",
            {"num_rows": 1000, "cell_m": [1, 1]},
        ),
        ("geoplateforme/batiment_one_feature.json", {"kind": "vector, GeoJSON"}),
    ],
)
def test_real_files(name: str, expected: dict[str, Any]) -> None:
    facts = describe(DATA / name)
    assert {key: facts[key] for key in expected} == expected


def test_vector() -> None:
    (layer,) = describe(GPKG)["layers"]
    frame = gpd.read_file(GPKG)
    assert layer["layer"] == "batiment" and layer["num_features"] == len(frame)
    assert layer["bounds"] == pytest.approx(frame.total_bounds.tolist())
    assert set(layer["columns"]) == set(frame.columns) - {"geometry"}


def test_a_gpkg_of_p2wss_has_its_provenance(tmp_path: Path) -> None:
    gpkg.write(tmp_path / "a.gpkg", Features.of(gpd.read_file(GPKG).iloc[:3]), FACTS, style="<qgis/>")
    warnings.simplefilter("error")  # of several layers
    assert describe(tmp_path / "a.gpkg")["provenance"] == SHOWN


def test_a_gpkg_has_the_same_bytes_whenever_it_is_written(tmp_path: Path) -> None:
    features = Features.of(gpd.read_file(GPKG).iloc[:3])
    gpkg.write(tmp_path / "a.gpkg", features, FACTS)
    time.sleep(0.01)  # times in a GeoPackage have milliseconds
    gpkg.write(tmp_path / "b.gpkg", features, FACTS)
    assert (tmp_path / "a.gpkg").read_bytes() == (tmp_path / "b.gpkg").read_bytes()


def test_rasters(tmp_path: Path) -> None:
    facts = describe(ASC)
    heights = np.loadtxt(ASC, skiprows=6)
    assert (facts["num_rows"], facts["num_columns"], facts["crs"]) == (200, 200, None)
    assert facts["heights, m"]["highest"] == pytest.approx(heights.max())
    heights[0] = np.nan
    write_terrain(tmp_path / "a.tif", Terrain(heights, 652000, 6862000, 5.0), "EPSG:2154", FACTS)
    facts = describe(tmp_path / "a.tif")
    assert facts["share of cells with data"] == pytest.approx(199 / 200)
    assert facts["bounds"] == [652000, 6861000, 653000, 6862000] and facts["provenance"] == SHOWN
    with rasterio.open(tmp_path / "a.tif", "r+") as raster:
        raster.scales, raster.offsets, raster.units = [0.01], [5.0], ["ft"]
    expected = (np.nanmax(heights) * 0.01 + 5) * 0.3048
    assert describe(tmp_path / "a.tif")["heights, m"]["highest"] == pytest.approx(expected)


def test_tables(tmp_path: Path) -> None:
    columns = {name: [] for name in MEASURES.names}
    files.write_table(tmp_path / "a.parquet", columns, MEASURES, FACTS)
    facts = describe(tmp_path / "a.parquet")
    assert facts["num_rows"] == 0 and facts["provenance"] == SHOWN
    assert facts["columns"]["num_points"] == "int32 not null  points of the crop of the building"
    frame = gpd.read_file(GPKG).assign(status=lambda f: np.where(f.hauteur > 5, "ok", "low"))
    frame.to_parquet(tmp_path / "b.parquet")
    facts = describe(tmp_path / "b.parquet")
    assert facts["kind"] == "GeoParquet" and "EPSG:2154" in facts["crs"]
    assert facts["rows by status"]["ok"] == (frame["status"] == "ok").sum()


def test_weights(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    tensors = {"a": torch.zeros(3, 4), "b": torch.zeros(5, dtype=torch.int64)}
    save_file(tensors, path, {"p2wss": json.dumps(FACTS)})
    facts = describe(path)
    assert (facts["num_tensors"], facts["num_parameters"], facts["provenance"]) == (2, 17, SHOWN)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match=r"model\.safetensors: not readable as .safetensors, or truncated"):
        describe(path)


def test_json(tmp_path: Path) -> None:
    files.write_json(tmp_path / "manifest.json", {"num_rows": 2, "shards": [{"tile": "a"}]} | FACTS)
    facts = describe(tmp_path / "manifest.json")
    assert facts["num_rows"] == 2 and facts["provenance"] == SHOWN
    (tmp_path / "m.jsonl").write_text('{"step": 1}\n{"step": 2}\n')
    assert describe(tmp_path / "m.jsonl")["last"] == [{"step": 2}]


def test_glb(tmp_path: Path) -> None:
    vertex_m = np.add([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [652000.0, 6861000.0, 100.0])
    triangle = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    body = Body.of_building("a", mesh_of(vertex_m, triangle))
    (tmp_path / "a.glb").write_bytes(glb([body], frame_around([body], "EPSG:2154"), dict(FACTS)))
    facts = describe(tmp_path / "a.glb")
    assert facts["kind"] == "meshes, binary glTF" and facts["provenance"] == SHOWN
    assert facts["crs"] == "RGF93 v1 / Lambert-93 (EPSG:2154)" and facts["origin_m"] == [652000, 6861000, 100]
    assert facts["num_meshes"] == 1 and facts["num_triangles"] == 4 and facts["materials"] == ["concrete"]


def test_text_has_one_fact_per_line() -> None:
    shown = text({"a": 1.5, "b": {"c": [1, 2], "d": None}, "e": [{"f": "g"}]})
    assert shown.splitlines() == ["a: 1.5", "b:", "  c:", "  - 1", "  - 2", "  d: null", "e:", "- f: g"]


@pytest.mark.parametrize(
    "suffix", ["laz", "gpkg", "tif", "asc", "parquet", "json", "jsonl", "safetensors", "glb"]
)
def test_a_broken_file_is_an_error_of_one_line(tmp_path: Path, suffix: str, capsys: Any) -> None:
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"<html>nothing of the kind</html>")
    assert main(["inspect", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"p2wss: error: {path}: ")


def test_command(tmp_path: Path, capsys: Any) -> None:
    assert main(["inspect", "--json", str(ASC), str(GPKG)]) == 0
    first, second = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert first["num_rows"] == 200 and second["layers"][0]["layer"] == "batiment"
    assert main(["inspect", str(tmp_path / "none.laz")]) == 2
    assert "none.laz: no such file" in capsys.readouterr().err
    (tmp_path / "a.xyz").write_text("1 2 3")
    assert main(["inspect", str(tmp_path / "a.xyz")]) == 2
    message = capsys.readouterr().err
    assert "unknown type of file" in message and "(E57, PLY, text) to LAZ" in message
    assert main(["inspect", str(tmp_path)]) == 2
    assert f"{tmp_path}: is a folder" in capsys.readouterr().err


def test_vector_files_of_any_kind(tmp_path: Path) -> None:
    frame = houses.footprints()
    for name, driver in {"a.gml": "GML", "a.gdb": "OpenFileGDB", "a.shz": "ESRI Shapefile"}.items():
        frame.to_file(tmp_path / name, driver=driver)
        facts = describe(tmp_path / name)
        assert facts["layers"][0]["num_features"] == 2 and facts["checksum"].startswith("none stated")


def test_a_city_model_whose_layers_cannot_be_read_says_so(tmp_path: Path) -> None:
    corners = "<gml:posList>0 0 0 1 0 0 1 1 0 0 0 0</gml:posList>"
    for name in [
        "LinearRing",
        "exterior",
        "Polygon",
        "surfaceMember",
        "CompositeSurface",
        "exterior",
        "Solid",
    ]:
        corners = f"<gml:{name}>{corners}</gml:{name}>"
    (tmp_path / "city.gml").write_text(
        '<core:CityModel xmlns:core="http://www.opengis.net/citygml/2.0" xmlns:gml="http://www.opengis.net/gml"'
        ' xmlns:bldg="http://www.opengis.net/citygml/building/2.0"><core:cityObjectMember><bldg:Building>'
        f"<bldg:lod1Solid>{corners}</bldg:lod1Solid></bldg:Building></core:cityObjectMember></core:CityModel>"
    )
    with pytest.raises(InputError, match="has layers of 3D geometries that cannot be read; save it as"):
        describe(tmp_path / "city.gml")


def test_a_reader_that_stops_ends_the_command_without_a_traceback() -> None:
    command = [sys.executable, "-c", "from p2wss.cli import main; raise SystemExit(main())", "inspect"]
    with subprocess.Popen([*command, GPKG], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        assert run.stdout is not None and run.stderr is not None
        run.stdout.close()
        assert run.stderr.read() == b"" and run.wait() == 141


@pytest.mark.parametrize(
    "stated", ["urn:ogc:def:crs:EPSG::7415", "https://www.opengis.net/def/crs/EPSG/0/7415", "EPSG:7415"]
)
def test_the_crs_of_cityjson_of_any_version(stated: str, tmp_path: Path) -> None:
    path = tmp_path / "a.city.json"
    document = {"type": "CityJSON", "version": "1.0", "CityObjects": {}, "vertices": []}
    path.write_text(json.dumps(document | {"metadata": {"referenceSystem": stated}}))
    assert describe(path)["crs"] == "Amersfoort / RD New + NAP height (EPSG:7415)"


def test_levels_of_detail_of_templates(tmp_path: Path) -> None:
    house = {"type": "Building", "geometry": [{"type": "GeometryInstance", "template": 0, "boundaries": [0]}]}
    template = {"type": "Solid", "lod": "2.2", "boundaries": []}
    document = {"type": "CityJSON", "CityObjects": {"a": house, "b": house}, "vertices": [[0, 0, 0]]}
    document["geometry-templates"] = {"templates": [template], "vertices-templates": []}
    (tmp_path / "x.city.json").write_text(json.dumps(document), encoding="utf-8")
    facts = describe(tmp_path / "x.city.json")
    assert facts["geometries by level of detail"] == {"Solid LoD2.2": 2}
