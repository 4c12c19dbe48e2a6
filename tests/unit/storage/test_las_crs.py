"""What headers state of their CRS and of the unit of their heights, in every way that files do."""

from __future__ import annotations

import re
from pathlib import Path

import control_houses as houses
import laspy
import numpy as np
import pyproj
import pytest

from p2wss.clouds.reading import read_headers
from p2wss.storage.las_crs import same_crs, stated_crs, unit_m

UTM, PLANE = "EPSG:26910", pyproj.CRS("EPSG:26910")
FEET = "EPSG:26910+6360"
BEFORE = PLANE.to_wkt("WKT1_ESRI")
AFTER = pyproj.CRS(FEET).to_wkt("WKT1_ESRI").removeprefix(BEFORE).strip(",")
SURVEY_FOOT, FOOT = 9003, 9002


def stated(
    header: laspy.LasHeader, x: float = 500_000, y: float = 4_100_000
) -> tuple[str, float | None, int]:
    """(the plane, the length of the unit of heights, the number of doubts)."""
    header.mins = header.maxs = np.array([x, y, 0.0])
    found = stated_crs(header)
    assert found.crs is not None
    plane = found.crs.sub_crs_list[0] if found.crs.is_compound else found.crs
    return plane.name, found.heights and unit_m(found.heights), len(found.doubts)


@pytest.mark.parametrize(
    ("wkt", "keys"),
    [
        (None, {3072: 26910, 4096: 6360, 4099: SURVEY_FOOT}),
        (None, {3072: 26910, 3076: 9001, 4099: SURVEY_FOOT}),
        (None, {3072: 26910, 4096: 6360}),
        (PLANE.to_wkt("WKT1_GDAL"), {3072: 26910, 4099: SURVEY_FOOT}),
        (PLANE.to_wkt("WKT2_2019"), {4096: 6360}),
        *(
            (pyproj.CRS(FEET).to_wkt(kind), None)
            for kind in ("WKT1_GDAL", "WKT1_ESRI", "WKT2_2019", "WKT2_2015")
        ),
        (f"{BEFORE},{AFTER}", None),
        (f"{BEFORE}{AFTER}", None),
        (
            f'{BEFORE},VERT_CS["NAVD88",VERT_DATUM["NAVD88",2005],UNIT["US survey foot",0.304800609601219]]',
            None,
        ),
    ],
)
def test_heights_in_feet_however_they_are_stated(wkt: str | None, keys: dict[int, int] | None) -> None:
    name, length_m, num_doubts = stated(houses.header(wkt, keys))
    assert name.replace("_", " ").startswith(("NAD83 / UTM zone 10N", "NAD 1983 UTM Zone 10N"))
    assert length_m == pytest.approx(houses.SURVEY_FOOT_M, rel=1e-9) and num_doubts == 0


@pytest.mark.parametrize("kind", ["WKT1_GDAL", "WKT1_ESRI", "WKT2_2019"])
@pytest.mark.parametrize("code", [3006, 2193, 2180, 6677, 31467, 5845])
def test_a_plane_with_northings_first_is_that_of_epsg(code: int, kind: str) -> None:
    expected = pyproj.CRS.from_epsg(code)
    wkt = expected.to_wkt(kind)  # WKT 1 states eastings first
    found = stated_crs(houses.header(wkt)).crs
    assert found == expected and same_crs(pyproj.CRS(wkt), expected)


def test_with_a_shift_to_another_datum_too() -> None:
    plane = pyproj.CRS.from_epsg(3006)
    datum = ',AUTHORITY["EPSG","6619"]]'
    wkt = plane.to_wkt("WKT1_GDAL").replace(datum, f",TOWGS84[0,0,0,0,0,0,0]{datum}")
    assert pyproj.CRS(wkt).is_bound and stated_crs(houses.header(wkt)).crs == plane


def test_a_code_that_a_definition_contradicts_is_not_taken() -> None:
    wkt = pyproj.CRS.from_epsg(3006).to_wkt("WKT1_GDAL").replace("500000", "1500000")
    found = stated_crs(houses.header(wkt)).crs
    assert found == pyproj.CRS(wkt) and not same_crs(found, pyproj.CRS.from_epsg(3006))


def test_heights_without_a_unit_state_none() -> None:
    assert stated(houses.header(keys={3072: 26910})) == (PLANE.name, None, 0)
    # codes of ellipsoids in GeoTIFF 1.0 are no vertical CRS of EPSG
    assert stated(houses.header(keys={3072: 26910, 4096: 5030})) == (PLANE.name, None, 0)
    # in old files 5103 is NAVD88
    assert stated(houses.header(keys={3072: 26910, 4096: 5103})) == (PLANE.name, 1.0, 0)


@pytest.mark.parametrize("kind", ["WKT1_GDAL", "WKT1_ESRI", "WKT2_2019"])
def test_heights_in_feet_that_are_stated_alone(kind: str) -> None:
    alone = stated_crs(houses.header(pyproj.CRS("EPSG:6360").to_wkt(kind)))
    assert alone.crs is None and not alone.doubts and alone.heights is not None
    assert unit_m(alone.heights) == pytest.approx(houses.SURVEY_FOOT_M, rel=1e-9)
    beside = stated(houses.header(pyproj.CRS("EPSG:6360").to_wkt(kind), {3072: 26910}))
    assert beside == (PLANE.name, pytest.approx(houses.SURVEY_FOOT_M), 0)


def test_of_two_units_of_heights_one_is_taken_and_both_are_named() -> None:
    header = houses.header(keys={3072: 26910, 4096: 5703, 4099: FOOT})
    assert stated(header) == (PLANE.name, pytest.approx(0.3048), 1)
    assert "units of 1 m, but also units of 0.3048 m" in stated_crs(header).doubts[0]
    both = houses.header(pyproj.CRS(FEET).to_wkt(), {3072: 26910, 4099: FOOT})
    assert stated(both) == (PLANE.name, pytest.approx(houses.SURVEY_FOOT_M), 1)


def test_of_two_units_of_the_plane_the_bounds_tell() -> None:
    header = houses.header(keys={3072: 26910, 3076: SURVEY_FOOT})
    assert stated(header) == (PLANE.name, None, 1)
    metres = stated_crs(header).crs
    assert metres is not None and metres.axis_info[0].unit_conversion_factor == 1.0
    # 45° N in feet is far north of all zones in metres
    foot_m = houses.SURVEY_FOOT_M
    assert stated(header, 500_000 / foot_m, 4_983_000 / foot_m)[2] == 1
    feet = stated_crs(header).crs
    assert feet is not None and feet.axis_info[0].unit_conversion_factor == pytest.approx(foot_m)


def test_feet_that_are_metres_long_are_doubted() -> None:
    """As libLAS wrote them."""
    wkt = pyproj.CRS(FEET).to_wkt("WKT1_GDAL")
    (vertical,) = re.findall(r"VERT_CS.*", wkt)
    header = houses.header(wkt.replace(vertical, vertical.replace("0.304800609601219", "1.0")))
    assert stated(header) == (PLANE.name, 1.0, 1)
    assert "units of 1 m with the name US survey foot" in stated_crs(header).doubts[0]


def test_of_two_planes_the_bounds_tell() -> None:
    degrees, lambert = pyproj.CRS("EPSG:4326"), pyproj.CRS("EPSG:2154")
    for wkt, code in ((degrees, {3072: 2154}), (lambert, {2048: 4326})):
        header = houses.header(wkt.to_wkt(), code)
        assert stated(header, 652_000, 6_862_000) == (lambert.name, None, 1)
        assert stated(header, 2.35, 48.85)[0] == degrees.name
    assert stated(houses.header(lambert.to_wkt(), {3072: 2154}), 652_000, 6_862_000)[2] == 0


def test_keys_count_where_the_wkt_is_broken(tmp_path: Path) -> None:
    path = houses.write_cloud(tmp_path / "a.laz", UTM, stated=houses.header("PROJCS[", {3072: 26910}))
    (found,) = read_headers([path])
    assert found.crs == PLANE and "WKT is not used" in found.doubts[0]


def test_a_projection_without_a_code_is_that_of_liblas_or_told() -> None:
    header = houses.header(keys={3072: 32767, 3076: FOOT})
    (doubt,) = stated_crs(header).doubts
    assert "a projection without a code" in doubt and stated_crs(header).crs is None
    wkt = pyproj.CRS("EPSG:2992").to_wkt("WKT1_GDAL").encode()
    header.vlrs.append(laspy.VLR("liblas", 2112, "", wkt + b"\0"))
    assert stated(header) == ("NAD83 / Oregon GIC Lambert (ft)", None, 0)
    # keys with a code are newer
    header.vlrs[0].geo_keys[2].value_offset = 26910
    assert stated(header) == (PLANE.name, None, 1)


@pytest.mark.parametrize(
    "text", ["EPSG:26910", f"\ufeff{BEFORE}", PLANE.to_json(), "+proj=utm +zone=10 +datum=NAD83"]
)
def test_other_texts_in_the_place_of_wkt(text: str) -> None:
    header = houses.header()
    header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", text.encode() + b"\0"))
    crs = stated_crs(header).crs
    assert crs is not None and same_crs(crs, PLANE) and not stated_crs(header).doubts
