"""Footprints in any CRS, clouds in feet or degrees: all in one CRS in metres."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import pyproj
import pytest
import shapely
from feature_tables import read_footprints
from places import SHARED
from toy_clouds import LAMBERT, RD, WGS84

from p2wss.clouds.reading import Cloud
from p2wss.data.crs import MetricCrs, metric_crs, reprojected
from p2wss.data.terrain import Terrain
from p2wss.storage.errors import InputError

FOOT = 1200 / 3937
NEW_YORK, NEW_YORK_FEET = pyproj.CRS.from_epsg(32118), pyproj.CRS.from_epsg(2263)
OLEMPS = SHARED / "data" / "olemps_bdtopo" / "BATIMENT.shp"


def cloud(crs: pyproj.CRS, *points: tuple[float, float, float]) -> Cloud:
    x, y, z = np.array(points, float).T
    return Cloud(x, y, z, np.full(len(x), 6, np.uint8), crs)


def test_metres_stay_as_they_are() -> None:
    for crs in (LAMBERT, RD, pyproj.CRS("EPSG:7415"), pyproj.CRS("EPSG:2154+5720")):
        metric, note = metric_crs(crs, None, "a.laz")
        assert note is None and metric.crs == crs and metric.is_source
        points = cloud(crs, (1, 2, 3))
        assert points.in_metres(metric) is points
        assert metric.window_of_clouds((0, 1, 2, 3)) == (0, 1, 2, 3)


def test_feet_become_metres_of_the_same_projection() -> None:
    metric, note = metric_crs(NEW_YORK_FEET, None, "a.laz")
    assert note is not None and "0.3048006096 m" in note and "heights assumed" in note
    assert metric.crs == NEW_YORK
    # the same place by PROJ's own transformation
    feet = 980_000.0, 200_000.0
    x_m, y_m = pyproj.Transformer.from_crs(NEW_YORK_FEET, NEW_YORK, always_xy=True).transform(*feet)
    converted = cloud(NEW_YORK_FEET, (*feet, 100.0)).in_metres(metric)
    assert (converted.x_m[0], converted.y_m[0]) == pytest.approx((x_m, y_m), abs=1e-6)
    assert converted.z_m[0] == pytest.approx(100 * FOOT) and converted.crs == NEW_YORK
    assert metric.window_of_clouds((x_m, y_m, x_m, y_m)) == pytest.approx(feet * 2)


@pytest.mark.parametrize(("heights", "unit_m"), [("6360", FOOT), ("8228", 0.3048), ("5703", 1.0)])
def test_heights_have_their_own_unit(heights: str, unit_m: float) -> None:
    metric, note = metric_crs(pyproj.CRS(f"EPSG:2263+{heights}"), None, "a.laz")
    assert metric.vertical_m == pytest.approx(unit_m) and "assumed" not in str(note)
    assert metric.crs.is_compound and metric.crs.sub_crs_list[0] == NEW_YORK
    assert metric.crs.sub_crs_list[1].axis_info[0].unit_conversion_factor == 1.0
    assert "NAVD88" in metric.crs.sub_crs_list[1].name
    # can be stated in files and read again
    assert pyproj.CRS.from_user_input(metric.crs.to_string()) == metric.crs


def test_metres_with_heights_in_feet() -> None:
    metric, _ = metric_crs(pyproj.CRS("EPSG:32118+6360"), None, "a.laz")
    assert (metric.horizontal_m, metric.vertical_m) == pytest.approx((1.0, FOOT))
    assert metric.crs.sub_crs_list[0] == NEW_YORK


def test_feet_without_a_twin_in_metres() -> None:
    stated = NEW_YORK_FEET.to_json_dict()
    stated.pop("id")
    stated["name"] = "city grid"
    stated["conversion"]["parameters"][-1]["value"] = 123_456.7
    metric, note = metric_crs(pyproj.CRS.from_json_dict(stated), None, "a.laz")
    assert metric.crs.name == "city grid (metres)" and "city grid (metres)" in str(note)
    place = (-74.0, 40.7)
    source, target = (
        pyproj.Transformer.from_crs(WGS84, crs, always_xy=True).transform(*place)
        for crs in (metric.source, metric.crs)
    )
    assert target == pytest.approx(np.multiply(source, FOOT), abs=1e-4)


def test_terrain_in_feet_or_metres() -> None:
    metric, _ = metric_crs(NEW_YORK_FEET, None, "a.laz")
    terrain = Terrain(np.array([[100.0]], np.float32), 1000.0, 2000.0, 10.0)
    scaled = metric.terrain(terrain, NEW_YORK_FEET, "t.tif")
    assert (scaled.x_min_m, scaled.y_max_m, scaled.cell_m) == pytest.approx(
        (1000 * FOOT, 2000 * FOOT, 10 * FOOT)
    )
    assert scaled.height_m[0, 0] == pytest.approx(100 * FOOT)
    assert metric.terrain(terrain, NEW_YORK, "t.tif") is terrain
    with pytest.raises(InputError, match=r"t\.tif: is in RGF93"):
        metric.terrain(terrain, LAMBERT, "t.tif")


def test_clouds_in_degrees_get_a_zone_of_utm() -> None:
    metric, note = metric_crs(WGS84, (2.3, 48.8, 2.4, 48.9), "a.laz")
    assert metric.crs.to_epsg() == 32631 and "UTM zone 31N" in str(note)
    converted = cloud(WGS84, (2.35, 48.85, 35.0)).in_metres(metric)
    x_m, y_m = float(converted.x_m[0]), float(converted.y_m[0])
    assert 450_000 < x_m < 460_000 and 5_400_000 < y_m < 5_420_000 and converted.z_m[0] == 35
    west, south, east, north = metric.window_of_clouds((x_m - 10, y_m - 10, x_m + 10, y_m + 10))
    assert west < 2.35 < east and south < 48.85 < north and east - west < 0.001


def test_what_cannot_be_transformed_is_refused() -> None:
    with pytest.raises(InputError, match="cannot be transformed to one in metres"):
        metric_crs(pyproj.CRS.from_epsg(4978), None, "a.laz")
    shapes = np.array([shapely.box(700_000, 6_600_000, 700_010, 6_600_010)])
    with pytest.raises(InputError, match=r"f\.gpkg: is in WGS 84, whose coordinates cannot be transformed"):
        reprojected(shapes, WGS84, LAMBERT, "f.gpkg")


def test_one_bad_feature_does_not_stop_the_others() -> None:
    shapes = [
        shapely.box(2.3, 48.8, 2.31, 48.81),
        shapely.box(2.3, 1e9, 2.31, 1e9 + 1),
        None,
        shapely.Polygon(),
    ]
    result = reprojected(np.array(shapes), WGS84, LAMBERT, "f.gpkg")
    assert np.isfinite(result[0].bounds).all()
    assert result[2] is None and result[3].is_empty


def test_reprojection_is_told_with_its_accuracy(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    lambert = gpd.GeoDataFrame(geometry=[shapely.box(652000, 6861000, 652010, 6861010)], crs=LAMBERT)
    # heights of vertices do not matter, not even if they are not finite
    degrees = shapely.force_3d(lambert.to_crs(4326).geometry.to_numpy(), float("inf"))
    (back,) = reprojected(degrees, WGS84, pyproj.CRS("EPSG:5698"), "f.geojson")
    assert shapely.hausdorff_distance(back, lambert.geometry.iloc[0]) < 1e-3
    assert "f.geojson: reprojected from WGS 84 to RGF93 v1 / Lambert-93, accuracy" in caplog.text
    assert reprojected(degrees, WGS84, WGS84, "f") is degrees


@pytest.mark.skipif(not OLEMPS.exists(), reason="no shared/data/olemps_bdtopo")
def test_footprints_written_in_degrees_come_back_to_the_centimetre(tmp_path: Path) -> None:
    metric = MetricCrs(LAMBERT, LAMBERT)
    before = read_footprints(OLEMPS, metric=metric)
    path = tmp_path / "f.geojson"
    gpd.read_file(OLEMPS).to_crs(4326).to_file(path, driver="GeoJSON", COORDINATE_PRECISION=9)
    after = read_footprints(path, metric=metric)
    assert list(after["building_id"]) == list(before["building_id"])
    assert list(after["stated_height_m"].fillna(-1)) == list(before["stated_height_m"].fillna(-1))
    first, second = (shapely.get_coordinates(frame.geometry.to_numpy()) for frame in (before, after))
    assert np.abs(first - second).max() < 0.001
