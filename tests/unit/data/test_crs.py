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
from p2wss.data.crs import (
    MetricCrs,
    common_crs,
    doubtful_place,
    metric_crs,
    odd_place,
    reprojected,
    same_crs,
)
from p2wss.data.terrain import Terrain
from p2wss.storage.messages import InputError

FOOT = 1200 / 3937
NEW_YORK, NEW_YORK_FEET = pyproj.CRS.from_epsg(32118), pyproj.CRS.from_epsg(2263)
MERCATOR = pyproj.CRS.from_epsg(3857)
OLEMPS = SHARED / "data" / "olemps_bdtopo" / "BATIMENT.shp"


def cloud(crs: pyproj.CRS, *points: tuple[float, float, float]) -> Cloud:
    x, y, z = np.array(points, float).T
    return Cloud(x, y, z, np.full(len(x), 6, np.uint8), crs)


@pytest.mark.parametrize(
    "code, why",
    [(4326, "in degrees, but its bounds are not"), (32631, "but its bounds are not on the Earth")],
)
def test_bounds_outside_the_earth(code: int, why: str) -> None:
    with pytest.raises(InputError, match=f"{why}; state its CRS with --crs"):
        metric_crs(pyproj.CRS(code), (-2_147_101_580, -2_147_101_580, 2_146_599_318, 2_146_599_318), "a.laz")


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


@pytest.mark.parametrize(
    ("plane", "bounds"),
    [("EPSG:4326", (2.34, 48.85, 2.35, 48.86)), ("EPSG:3857", (261_000, 6_250_000, 261_200, 6_250_200))],
)
def test_heights_keep_their_datum_in_another_plane(
    plane: str, bounds: tuple[float, float, float, float]
) -> None:
    for heights, name in (("5720", "NGF-IGN69 height"), ("6360", "NAVD88 height (ftUS) (metres)")):
        metric, _ = metric_crs(pyproj.CRS(f"{plane}+{heights}"), bounds, "a.laz")
        assert metric.crs.name == f"WGS 84 / UTM zone 31N + {name}"
        assert {axis.unit_name for axis in metric.crs.axis_info} == {"metre"}


def test_heights_above_the_ellipsoid_stay_so_in_another_plane() -> None:
    # the last one's ellipsoid is another than that of UTM
    for code, num_axes in ((4979, 3), (6319, 3), (9267, 2)):
        metric, note = metric_crs(pyproj.CRS.from_epsg(code), (14.34, 48.85, 14.35, 48.86), "a.laz")
        assert "with heights above the ellipsoid" in str(note)
        assert metric.crs.name == "WGS 84 / UTM zone 33N" and len(metric.crs.axis_info) == num_axes


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


@pytest.mark.parametrize("heights", ["", "+6360"])
def test_feet_with_a_shift_to_another_datum(heights: str) -> None:
    """WKT of version 1 with TOWGS84, as older programs write it, is a bound CRS, also within a compound one."""
    wkt = NEW_YORK_FEET.to_wkt("WKT1_GDAL").replace(
        '],AUTHORITY["EPSG","6269"]]', "],TOWGS84[1,2,3,0,0,0,0]]"
    )
    flat = pyproj.CRS.from_wkt(wkt)
    assert flat.is_bound
    source = pyproj.crs.CompoundCRS("city", [flat, pyproj.CRS("EPSG:6360")]) if heights else flat
    metric, _ = metric_crs(source, None, "a.laz")
    assert (metric.horizontal_m, metric.vertical_m) == pytest.approx((FOOT, FOOT))
    assert {axis.unit_name for axis in metric.crs.axis_info} == {"metre"}
    x, y = metric._transformer.transform(984_000.0, 200_000.0)
    assert (x, y) == pytest.approx((984_000 * FOOT, 200_000 * FOOT), abs=1e-4)


def test_terrain_in_feet_or_metres() -> None:
    metric, _ = metric_crs(NEW_YORK_FEET, None, "a.laz")
    terrain = Terrain(np.array([[100.0]], np.float32), 1000.0, 2000.0, 10.0)
    assert metric.unstated_m(NEW_YORK_FEET) == pytest.approx(FOOT) and metric.unstated_m(NEW_YORK) == 1.0
    scaled = metric.terrain(terrain, NEW_YORK_FEET, "t.tif")
    assert (scaled.x_min_m, scaled.y_max_m, scaled.cell_m) == pytest.approx(
        (1000 * FOOT, 2000 * FOOT, 10 * FOOT)
    )
    assert scaled.height_m is terrain.height_m
    assert metric.terrain(terrain, NEW_YORK, "t.tif") is terrain


def test_terrain_in_another_crs_is_reprojected(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    metric, _ = metric_crs(MERCATOR, (261_000, 6_250_000, 261_200, 6_250_200), "a.laz")
    row, column = np.mgrid[:100, :100]
    # a plane that rises by 1 in 10 to the north-east, in cells of 10 m, which are 6.6 m on the ground
    sloping = Terrain((50.0 + (column - row)).astype(np.float32), 260_600.0, 6_250_600.0, 10.0)
    there = metric.terrain(sloping, MERCATOR, "t.tif")
    assert there.cell_m == pytest.approx(6.57, abs=0.05) and "t.tif: reprojected from WGS 84" in caplog.text
    x, y = np.random.default_rng(0).uniform(-300, 300, (2, 50))
    to_utm = pyproj.Transformer.from_crs(MERCATOR, metric.crs, always_xy=True).transform
    height_m = there.interpolated(*to_utm(261_100 + x, 6_250_100 + y))
    assert height_m == pytest.approx(50 + (x + y) / 10, abs=0.1)


@pytest.mark.parametrize(
    ("code", "place", "zone"),
    [
        ("EPSG:3857", (2.35, 48.85), 32631),
        ("EPSG:6933", (2.35, 48.85), 32631),
        ("ESRI:54009", (-3.7, 40.4), 32630),
        ("EPSG:2154", (-60.0, 10.0), 32620),
        ("EPSG:2263", (-118.0, 55.0), 32611),
        ("EPSG:27572", (7.0, 38.0), 32632),  # counts in grads from Paris
    ],
)
def test_where_lengths_are_not_those_on_the_ground_work_is_in_utm(
    code: str, place: tuple[float, float], zone: int
) -> None:
    crs = pyproj.CRS(code)
    x, y = pyproj.Transformer.from_crs(WGS84, crs, always_xy=True).transform(*place)
    metric, note = metric_crs(crs, (x, y, x + 50, y + 50), "a.laz")
    assert metric.crs.to_epsg() == zone and "a metre on the ground" in str(note)
    # a square of 10 m on the ground, by geodesics
    east = pyproj.Geod(ellps="GRS80").fwd(*place, 90, 10)[:2]
    there = pyproj.Transformer.from_crs(WGS84, crs, always_xy=True).transform(*east)
    points = cloud(crs, (x, y, 1), (*there, 1)).in_metres(metric)
    assert np.hypot(np.diff(points.x_m), np.diff(points.y_m))[0] == pytest.approx(10, rel=0.002)


@pytest.mark.parametrize(
    ("epsg", "place", "axes"),
    [
        (5513, (14.42, 50.09), "south and west"),
        (2048, (18.42, -33.92), "west and south"),
        (3995, (20.0, 71.0), ""),
    ],
)
def test_axes_that_point_south_or_west_are_not_those_of_the_plane(
    epsg: int, place: tuple[float, float], axes: str
) -> None:
    """A scene in Krovak's southings and westings was mirrored."""
    crs = pyproj.CRS.from_epsg(epsg)
    x, y = pyproj.Transformer.from_crs(WGS84, crs, always_xy=True).transform(*place)
    metric, note = metric_crs(crs, (x, y, x + 50, y + 50), "a.laz")
    assert (f"whose axes point {axes}" in str(note)) == bool(axes)
    if axes:
        others = [(place[0] + 1e-3, place[1]), (place[0], place[1] + 1e-3)]
        east, north = (
            pyproj.Transformer.from_crs(WGS84, crs, always_xy=True).transform(*each) for each in others
        )
        points = cloud(crs, (x, y, 1), (*east, 1), (*north, 1)).in_metres(metric)
        assert points.x_m[1] - points.x_m[0] > 60 and points.y_m[2] - points.y_m[0] > 80


def test_national_grids_stay_to_their_borders() -> None:
    for code, place in (
        ("2154", (9.2, 41.5)),
        ("28992", (7.1, 53.0)),
        ("2056", (10.4, 46.6)),
        ("3035", (2.3, 48.9)),
        ("27572", (6.0, 47.3)),  # based on grads from Paris
    ):
        crs = pyproj.CRS.from_epsg(int(code))
        x, y = pyproj.Transformer.from_crs(WGS84, crs, always_xy=True).transform(*place)
        metric, note = metric_crs(crs, (x, y, x + 50, y + 50), "a.laz")
        assert metric.is_source and note is None


def test_the_unit_of_heights_that_the_user_states_counts() -> None:
    metric, note = metric_crs(pyproj.CRS("EPSG:2154+5720"), None, "a.laz", 0.3048)
    assert metric.vertical_m == 0.3048 and "0.3048 m for heights" in str(note)
    assert metric_crs(pyproj.CRS("EPSG:26910+6360"), None, "a.laz", 1.0)[0].is_source


def test_the_crs_that_the_user_states_overrides_the_file(caplog: pytest.LogCaptureFixture) -> None:
    assert common_crs(WGS84, None, "EPSG:2154", ("a.laz", "")) == (LAMBERT, None)
    assert "a.laz states that it is in WGS 84; --crs overrides that: RGF93" in caplog.text
    # heights of a file in the same plane stay, unless the user states others
    stated = pyproj.CRS("EPSG:2154+5720")
    assert common_crs(stated, None, "EPSG:2154", ("a.laz", ""))[0] == stated
    in_feet = pyproj.CRS("EPSG:2154+8228")
    assert common_crs(stated, None, "EPSG:2154+8228", ("a.laz", ""))[0] == in_feet
    above_ellipsoid = pyproj.CRS("EPSG:4979")
    assert common_crs(above_ellipsoid, None, "EPSG:4326", ("a.laz", ""))[0] == above_ellipsoid


def test_a_run_is_in_the_crs_of_epsg_whatever_states_it_in_wkt_1() -> None:
    expected = pyproj.CRS.from_epsg(3006)  # northings first, of which WKT 1 says nothing
    metric, note = metric_crs(pyproj.CRS(expected.to_wkt("WKT1_GDAL")), None, "a.laz")
    assert metric.crs == expected and metric.is_source and note is None


def test_clouds_in_degrees_get_a_zone_of_utm() -> None:
    metric, note = metric_crs(WGS84, (2.3, 48.8, 2.4, 48.9), "a.laz")
    assert metric.crs.to_epsg() == 32631 and "UTM zone 31N" in str(note)
    converted = cloud(WGS84, (2.35, 48.85, 35.0)).in_metres(metric)
    x_m, y_m = float(converted.x_m[0]), float(converted.y_m[0])
    assert 450_000 < x_m < 460_000 and 5_400_000 < y_m < 5_420_000 and converted.z_m[0] == 35
    west, south, east, north = metric.window_of_clouds((x_m - 10, y_m - 10, x_m + 10, y_m + 10))
    assert west < 2.35 < east and south < 48.85 < north and east - west < 0.001


def test_what_cannot_be_transformed_is_refused() -> None:
    with pytest.raises(InputError, match="in degrees, and has no points"):
        metric_crs(WGS84, None, "a.laz")
    with pytest.raises(InputError, match="cannot be transformed to one in metres"):
        metric_crs(pyproj.CRS.from_epsg(4978), None, "a.laz")
    shapes = np.array([shapely.box(700_000, 6_600_000, 700_010, 6_600_010)])
    with pytest.raises(
        InputError, match=r"f\.gpkg: is in WGS 84, whose .*; they are no degrees: save it with"
    ):
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


def test_a_crs_that_is_the_same_but_for_a_shift_of_nothing() -> None:
    """As GDAL wrote them: PROJ makes nothing of the transformation, and knows no last operation."""
    shift = pyproj.CRS.from_wkt(
        LAMBERT.to_wkt("WKT1_GDAL").replace('],AUTHORITY["EPSG","6171"]', "],TOWGS84[0,0,0,0,0,0,0]", 1)
    )
    assert shift.is_bound
    place = np.array([shapely.Point(652_000, 6_862_000)])
    assert reprojected(place, LAMBERT, shift, "f")[0].equals_exact(place[0], 1e-6)


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


@pytest.mark.parametrize(
    ("epsg", "x", "y", "words"),
    [
        (28992, 85_000, 447_000, ""),
        (28992, 85_000_000, 447_000_000, "x and y were in mm"),
        (25832, 5_772_000, 500_000, "x and y were swapped"),
        (31467, 5_530_000, 3_450_000, "x and y were swapped"),
        (31467, 3_450_000, 5_530_000, ""),
        (25832, 32_389_000, 5_800_000, "x did not begin with a zone"),
        (2263, 300_000, 60_000, "x and y were in m;"),
        (2048, -53_000, -3_755_000, "x and y had the other sign"),
        (5514, 1_043_000, 743_000, "x and y were southings and westings"),
        (32118, 984_250, 196_850, "x and y were in ft"),
        # of several faults, any may be
        (2991, 635_620, 848_900, "x and y were swapped or x and y were in ft"),
        # around an origin of its own, and where no such fault explains it
        (25832, 50, 80, ""),
        # where lengths depend on the place
        (3857, 50, 80, "is at latitude 0, longitude 0, in the sea; if its origin was moved"),
        (3857, 0, 6_800_000, ""),
        (2180, -501_000, 562_000, ""),
        (4326, 52.0, 4.36, ""),
    ],
)
def test_coordinates_that_lie_elsewhere_by_a_common_fault(epsg: int, x: float, y: float, words: str) -> None:
    crs = pyproj.CRS.from_epsg(epsg)
    # WKT 1 has no area of use
    for doubt in (
        odd_place(each, (x, y, x, y)) for each in (crs, pyproj.CRS.from_wkt(crs.to_wkt("WKT1_GDAL")))
    ):
        assert words in doubt and bool(doubt) == bool(words)


@pytest.mark.parametrize(
    ("epsg", "x", "y", "words"),
    [
        (3035, 3_934_189, 3_226_089, "is at latitude 52.01, longitude 4.36; if"),
        (3035, 3_226_089, 3_934_189, "latitude 57."),
        (4326, 52.01, 4.36, "is at latitude 4.36, longitude 52.01; if"),
        # swapped, they would be elsewhere; and eastings are first
        (31467, 3_450_000, 5_530_000, ""),
        (3007, 147_720, 6_398_557, ""),
        (28992, 85_000, 447_000, ""),
        (3857, 485_000, 6_800_000, ""),
        # the easting is of LV03, the northing of LV95; and Norway, by a zone beside its own
        (
            21781,
            674_500,
            1_206_700,
            "is at latitude 55.96, longitude 8.62; if that is another place, it is not in",
        ),
        (32633, -33_000, 6_730_000, ""),
        (28992, 85_000_000, 447_000_000, ""),
        (28992, 130, 520, "unless its coordinates are local"),
    ],
)
def test_where_only_the_place_tells_what_is_wrong(epsg: int, x: float, y: float, words: str) -> None:
    place = doubtful_place(pyproj.CRS.from_epsg(epsg), (x, y, x, y))
    assert words in place and bool(place) == bool(words)


def test_a_shift_does_not_make_another_crs_of_one_of_epsg() -> None:
    """Programs wrote TOWGS84 into the WKT of clouds; their coordinates are those of the CRS of EPSG."""
    shift = '],TOWGS84[565.237,50.0087,465.658,-0.406857,0.350733,-1.87035,4.0812],AUTHORITY["EPSG","6289"]]'
    bound = pyproj.CRS(RD.to_wkt("WKT1_GDAL").replace('],AUTHORITY["EPSG","6289"]]', shift))
    assert bound.is_bound and same_crs(bound, RD)
    metric, note = metric_crs(bound, None, "a.laz")
    assert metric.crs.to_epsg() == 28992 and metric.is_source and note is None
