"""The user's files: footprints, CRS, and outputs on real clouds with a stand-in for the network."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import geopandas as gpd
import numpy as np
import pyproj
import pytest
import shapely
import trimesh
from oracle_network import Oracle
from places import SHARED
from toy_clouds import LAMBERT, RD, WGS84, cleaned, cloud_over

import p2wss
from p2wss.clouds.reading import Cloud, read_clouds
from p2wss.config import Reconstruct, Scenes
from p2wss.data.crs import common_crs
from p2wss.footprints import cleaning
from p2wss.formats import gpkg
from p2wss.formats.glb import glb
from p2wss.formats.meshes import frame_around
from p2wss.reconstruction.area import window
from p2wss.reconstruction.outputs import exports
from p2wss.reconstruction.outputs.attributes import table
from p2wss.reconstruction.outputs.city import city_json
from p2wss.reconstruction.pipeline import run
from p2wss.reconstruction.result import summary as reconstruct_summary
from p2wss.storage.messages import InputError

NAMES = ("a.laz", "b.gpkg")
SQUARE = shapely.box(0, 0, 10, 10)
NETWORK_ALONE = Reconstruct()


def test_crs_from_the_cloud_the_user_or_the_footprints() -> None:
    assert common_crs(LAMBERT, None, None, NAMES) == (LAMBERT, None)
    assert common_crs(None, None, "EPSG:28992", NAMES)[0] == RD
    crs, note = common_crs(None, RD, None, NAMES)
    assert crs == RD and note is not None and "a.laz" in note
    with_heights = pyproj.CRS.from_user_input("EPSG:2154+5720")
    assert common_crs(with_heights, LAMBERT, None, NAMES)[0] == with_heights


@pytest.mark.parametrize(
    ("cloud", "frame", "stated", "message"),
    [
        (LAMBERT, LAMBERT, "EPSG:28992", "--crs states Amersfoort"),
        (None, None, None, "state it with --crs"),
        (None, None, "EPSG:999999", "no such CRS"),
        (None, WGS84, None, "b.gpkg is in degrees, which is unlikely for clouds"),
    ],
)
def test_other_crs_is_one_clear_line(cloud: object, frame: object, stated: str | None, message: str) -> None:
    with pytest.raises(InputError) as error:
        common_crs(cloud, frame, stated, NAMES, (652_000, 6_862_000, 652_100, 6_862_100))  # type: ignore[arg-type]
    assert message in str(error.value) and "\n" not in str(error.value)


def test_footprints_in_another_crs_leave_that_of_the_cloud() -> None:
    assert common_crs(LAMBERT, RD, None, NAMES) == (LAMBERT, None)
    assert common_crs(None, RD, "EPSG:2154", NAMES)[0] == LAMBERT


def test_every_footprint_gets_a_row_and_a_reason(tmp_path: Path) -> None:
    far, sliver = shapely.box(500, 0, 510, 10), shapely.box(30, 0, 30.02, 0.02)
    sparse = shapely.box(100, 0, 102, 2)
    frame = gpd.GeoDataFrame(
        {"building_id": ["near", "far", "sliver", "sparse"]},
        geometry=[SQUARE, far, sliver, sparse],
        crs=LAMBERT,
    )
    cloud = cloud_over(SQUARE)
    lone = Cloud(
        np.append(cloud.x_m, 100.5),
        np.append(cloud.y_m, 0.5),
        np.append(cloud.z_m, 6.0),
        np.append(cloud.classification, 6).astype(np.uint8),
        LAMBERT,
    )
    results = run(cleaned(frame), lone, Oracle(), "tile", NETWORK_ALONE)
    assert [r.status for r in results] == ["ok", "none", "none", "flat"]
    assert results[1].reason == "no-points" and results[3].reason == "too-few-points"
    assert "4 buildings: 1 ok, 1 flat (too-few-points: 1)" in reconstruct_summary(results)
    # eave at the median of the points above the ground, roof points are on the eave
    assert results[0].reconstruction.eave_height_m == pytest.approx(6.0)

    path = tmp_path / "out.gpkg"
    gpkg.write(path, table(results, LAMBERT), {"code": "x"})
    back = gpd.read_file(path)
    assert back.crs == LAMBERT and back["building_id"].tolist() == frame["building_id"].tolist()
    assert back["status"].tolist() == ["ok", "none", "none", "flat"]
    assert back["angle_deg"].iloc[0].split() == ["35"] * 4
    assert back.geometry.iloc[1].equals(far)

    header, *features = map(json.loads, "".join(city_json(results, LAMBERT)).splitlines())
    assert header["metadata"]["referenceSystem"].endswith("/2154")
    assert sorted(f["id"] for f in features) == sorted(frame["building_id"])
    with_mesh = {f["id"] for f in features if "geometry" in f["CityObjects"][f["id"]]}
    assert with_mesh == {"near", "sparse"}


def test_glb_is_y_up_around_a_stated_origin(tmp_path: Path) -> None:
    place = shapely.box(652000, 6861000, 652010, 6861010)
    frame = gpd.GeoDataFrame({"building_id": ["a"]}, geometry=[place], crs=LAMBERT)
    results = run(cleaned(frame), cloud_over(place), Oracle(), "tile", NETWORK_ALONE)
    path = tmp_path / "a.glb"
    meshes = [exports.mesh(result, Reconstruct()) for result in results]
    path.write_bytes(glb(meshes, frame_around(meshes, "EPSG:2154"), {"code": "x"}))
    scene = trimesh.load_scene(path)
    (mesh,) = scene.geometry.values()
    length = int.from_bytes(path.read_bytes()[12:16], "little")
    extras = json.loads(path.read_bytes()[20 : 20 + length])["asset"]["extras"]
    assert extras["origin_m"] == [652000, 6861000, 2] and extras["crs"] == "EPSG:2154"
    assert mesh.is_watertight and mesh.volume > 0
    assert mesh.bounds[:, 0] == pytest.approx([0, 10]) and mesh.bounds[:, 2] == pytest.approx([-10, 0])
    assert mesh.bounds[0, 1] == pytest.approx(0)


def test_nothing_at_all_can_be_written() -> None:
    frame = gpd.GeoDataFrame({"building_id": []}, geometry=[], crs=LAMBERT)
    empty = Cloud(*(np.zeros(0),) * 3, np.zeros(0, np.uint8), LAMBERT)
    results = run(cleaned(frame), empty, Oracle(), "tile", NETWORK_ALONE)
    assert results == []
    assert len("".join(city_json(results, LAMBERT)).splitlines()) == 1
    assert len(table(results, LAMBERT)) == 0


def test_no_overlap_is_one_clear_line() -> None:
    frame = gpd.GeoDataFrame({"building_id": ["a"]}, geometry=[shapely.box(900, 0, 910, 10)], crs=LAMBERT)
    with pytest.raises(InputError, match=r"cloud: no point near any of the 1 footprints of footprints"):
        p2wss.reconstruct(cloud_over(SQUARE), frame, model="none")


@pytest.mark.skipif(not SHARED.exists(), reason="no shared data")
@pytest.mark.parametrize(
    ("place", "cloud", "num_buildings", "num_meshes"),
    [("delft_ahn3", "ahn3.laz", 74, 74), ("bresse_ign", "lidar.laz", 40, 6)],
)
def test_real_clouds_give_watertight_buildings(
    place: str, cloud: str, num_buildings: int, num_meshes: int, tmp_path: Path
) -> None:
    folder = SHARED / "data" / place
    features = cleaning.clean_footprints(cleaning.read_footprints(folder / "footprints.gpkg"), Scenes())
    points = read_clouds([folder / cloud], window(features))
    crs, _ = common_crs(points.crs, features.crs, None, NAMES)
    results = run(features, points, Oracle(), place, NETWORK_ALONE)
    assert (len(results), sum(r.status == "ok" for r in results)) == (num_buildings, num_meshes)
    path = tmp_path / "out.city.jsonl"
    path.write_text("".join(city_json(results, crs)))
    judge = [sys.executable, SHARED / "tools" / "evaluate_cityjson.py", path, folder / "footprints.gpkg"]
    completed = subprocess.run([*judge, folder / cloud, "--json"], capture_output=True, text=True, check=True)
    summary = json.loads(completed.stdout)["summary"]
    assert summary["meshes"] == num_meshes and summary["watertight"] == 1.0
    # the oracle puts a hip roof on the median: no more than a few metres off, and light
    assert summary["p2m"]["mean"] < 1.5 and summary["tri"]["mean"] < 40
