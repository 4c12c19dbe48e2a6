"""``p2wss evaluate`` and ``p2wss view`` measure in metres, whatever the units of clouds and buildings are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import control_houses as houses
import pandas as pd
import pyproj
import pytest

import p2wss
from p2wss import cli
from p2wss.storage.messages import InputError

PLACE, STATE_PLANE, US_FOOT = "EPSG:26910", "EPSG:2227", 1200 / 3937
HEIGHTS_FT = "EPSG:6360"


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both houses, from a cloud in metres."""
    folder = tmp_path_factory.mktemp("city")
    cloud = houses.write_cloud(folder / "c.laz", PLACE)
    houses.write_footprints(folder / "f.gpkg", PLACE)
    with p2wss.reconstruct(cloud, folder / "f.gpkg", progress=False, model="none") as scene:
        scene.write(folder, ["cityjson"])
    return folder / "c.city.json"


def in_feet(city: Path, path: Path) -> Path:
    """The same buildings in the State Plane in feet, as a program without conversion writes them."""
    document = json.loads(city.read_text(encoding="utf-8"))
    scale, start = (document["transform"][key] for key in ("scale", "translate"))
    metres = [
        [v * s + t for v, s, t in zip(each, scale, start, strict=True)] for each in document["vertices"]
    ]
    to_feet = pyproj.Transformer.from_crs(PLACE, STATE_PLANE, always_xy=True)
    feet = [[*to_feet.transform(x, y), z / US_FOOT] for x, y, z in metres]
    low = [min(column) for column in zip(*feet, strict=True)]
    document["transform"] = {"scale": [0.001] * 3, "translate": low}
    document["vertices"] = [[round((v - t) * 1000) for v, t in zip(each, low, strict=True)] for each in feet]
    document["metadata"] = {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/2227"}
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def cloud_in(tmp_path: Path, crs: Any, height_unit_m: float) -> Path:
    return houses.write_cloud(tmp_path / "d.laz", PLACE, crs, height_unit_m)


def assert_equal(table: pd.DataFrame, expected: pd.DataFrame) -> None:
    assert list(table["status"]) == ["ok", "ok"]
    for name in ("cd_m", "roof_cd_m", "points_to_mesh_m"):
        assert table[name].to_numpy() == pytest.approx(expected[name].to_numpy(), abs=0.02)


UNITS = [
    (f"{PLACE}+{HEIGHTS_FT}", US_FOOT),
    (STATE_PLANE, US_FOOT),
    ("EPSG:3857", 1.0),
    ("EPSG:4326", 1.0),
]


@pytest.mark.parametrize(("crs", "unit_m"), UNITS)
def test_measures_are_those_of_the_cloud_in_metres(
    city: Path, tmp_path: Path, crs: str, unit_m: float
) -> None:
    footprints = city.with_name("f.gpkg")
    expected = p2wss.evaluate(city, footprints, city.with_name("c.laz"))
    assert (expected["points_to_mesh_m"] < 0.1).all()
    cloud = cloud_in(tmp_path, crs, unit_m)
    if crs == STATE_PLANE:
        city = in_feet(city, tmp_path / "feet.city.json")
    assert_equal(p2wss.evaluate(city, footprints, cloud), expected)


def test_stated_feet_override_a_cloud(city: Path, tmp_path: Path) -> None:
    cloud = cloud_in(tmp_path, PLACE, houses.FOOT_M)
    footprints = city.with_name("f.gpkg")
    expected = p2wss.evaluate(city, footprints, city.with_name("c.laz"))
    assert_equal(
        p2wss.evaluate(city, footprints, cloud, config={"reconstruct": {"height_unit": "ft"}}), expected
    )
    assert (p2wss.evaluate(city, footprints, cloud)["points_to_mesh_m"] > 100).all()


@pytest.mark.parametrize(("crs", "unit_m"), UNITS)
def test_points_of_a_page_are_at_the_buildings(city: Path, tmp_path: Path, crs: str, unit_m: float) -> None:
    cloud, page = cloud_in(tmp_path, crs, unit_m), tmp_path / "page.html"
    document = json.loads(city.read_text(encoding="utf-8"))
    for building in document["CityObjects"].values():
        building["attributes"] = {}
    plain = tmp_path / "plain.city.json"
    plain.write_text(json.dumps(document), encoding="utf-8")
    if crs == STATE_PLANE:
        plain = in_feet(plain, tmp_path / "feet.city.json")
    assert cli.main(["view", str(plain), str(cloud), "--out", str(page)]) == 0
    text = page.read_text(encoding="utf-8").split('id="viewer-data">')[1].split("</script>")[0]
    shown = json.loads(text)["buildings"]
    assert len(shown) == 2 and all(each["attributes"]["residual_m"] < 0.1 for each in shown)


def test_clouds_of_another_crs_are_refused(city: Path, tmp_path: Path) -> None:
    cloud = houses.write_cloud(tmp_path / "d.laz", "EPSG:2154")
    with pytest.raises(InputError, match=r"d\.laz: is in RGF93 .* but .*c\.city\.json is in NAD83"):
        p2wss.evaluate(city, city.with_name("f.gpkg"), cloud)


def test_footprints_are_those_of_a_stated_layer(city: Path, tmp_path: Path) -> None:
    houses.footprints(PLACE).iloc[:1].to_file(tmp_path / "f.gpkg", layer="old")
    houses.footprints(PLACE).to_file(tmp_path / "f.gpkg", layer="new")
    config = {"reconstruct": {"footprint_layer": "new"}}
    table = p2wss.evaluate(city, tmp_path / "f.gpkg", city.with_name("c.laz"), config=config)
    assert sorted(table.index) == ["flat", "gable"] and list(table["status"]) == ["ok", "ok"]
