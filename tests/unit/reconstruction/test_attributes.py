"""Attributes: measures of known buildings, names of 3DBAG, columns of the input, dates, blocks, reference systems."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import date, datetime
from pathlib import Path
from typing import Any

import cityjson_rules
import laspy
import numpy as np
import pandas as pd
import pyproj
import pytest
import solid_rules
from toy_clouds import LAMBERT
from yard_house import HOUSE_M2, SLOPE_DEG, YARD_M, YARD_M2, yard_house

from p2wss import skeleton
from p2wss.clouds.reading import GPS_EPOCH, read_clouds
from p2wss.config import Reconstruct
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.data.crs import common_crs
from p2wss.data.las_classes import BUILDING_CLASS, GROUND_CLASS
from p2wss.fit import fitting
from p2wss.mesh import Mesh
from p2wss.reconstruction.outputs import measures
from p2wss.reconstruction.outputs.attributes import TO_3DBAG, attributes
from p2wss.reconstruction.outputs.city import city_json, epsg_of
from p2wss.reconstruction.result import Result, Row, result_of
from p2wss.skeleton.types import Polygons

BOX = np.array([[0, 0], [12, 0], [12, 8], [0, 8]], float)
L_SHAPE = np.array([[0, 0], [12, 0], [12, 8], [6, 8], [6, 16], [0, 16]], float)
GABLE = [45.0, 90, 45, 90]


def building(
    name: str, ring: np.ndarray, angle_deg: list[float], eave_m: float = 5.0, x_m: float = 0.0
) -> Reconstruction:
    meshes = skeleton.build(Polygons.from_rings([[ring]]), np.array(angle_deg), np.array([eave_m]))
    assert meshes.status[0] == 0
    return Reconstruction(
        name, "t", "fit", reasons.OK, (652000.0 + x_m, 6861000.0), 100.0, [ring], eave_m, np.array(angle_deg),
        Mesh.of_kernel(meshes, 0),
    )  # fmt: skip


def result(reconstruction: Reconstruction, **values: Any) -> Result:
    if reconstruction.has_mesh:
        values.setdefault("measures", measures.measure(reconstruction.placed_mesh))
    return Result(reconstruction, "ok", None, 50, 0.05, 1.0, False, **values)


def measure(name: str, ring: np.ndarray, angle_deg: list[float]) -> measures.MeshMeasures:
    return measures.measure(building(name, ring, angle_deg).placed_mesh)


def test_measures_of_a_gable_roof() -> None:
    measured = measure("gable", BOX, GABLE)
    assert measured.roof_type == measures.GABLE
    assert (measured.roof_z_min_m, measured.roof_z_max_m) == pytest.approx((105, 109))
    assert measured.ridge_z_m == pytest.approx(109)
    # heights over a plane are uniform in plan
    assert (measured.roof_z_p50_m, measured.roof_z_p70_m) == pytest.approx((107, 107.8), abs=1e-6)
    assert measured.volume_m3 == pytest.approx(12 * 8 * 5 + 12 * 8 * 4 / 2)
    assert (measured.ground_area_m2, measured.flat_roof_area_m2) == pytest.approx((96, 0))
    assert measured.sloped_roof_area_m2 == pytest.approx(96 * np.sqrt(2))
    assert measured.wall_area_m2 == pytest.approx(2 * 12 * 5 + 2 * (8 * 5 + 8 * 4 / 2))


def test_measures_of_other_roofs() -> None:
    flat = measure("flat", BOX, [0.0] * 4)
    assert flat.roof_type == measures.FLAT and flat.ridge_z_m is None
    assert {flat.roof_z_min_m, flat.roof_z_p50_m, flat.roof_z_p70_m, flat.roof_z_max_m} == {105.0}
    assert (flat.flat_roof_area_m2, flat.sloped_roof_area_m2) == pytest.approx((96, 0))
    shed = measure("shed", BOX, [20.0, 90, 90, 90])
    assert shed.roof_type == measures.SHED and shed.ridge_z_m is None
    assert shed.roof_z_max_m == pytest.approx(105 + 8 * np.tan(np.radians(20)))
    hip = measure("hip", L_SHAPE, [40.0] * 6)
    # the valley is no ridge, the wings are equally wide up to 2 m
    assert hip.roof_type == measures.SLOPES and hip.ridge_z_m == pytest.approx(hip.roof_z_max_m)
    assert 105 < hip.roof_z_p50_m < hip.roof_z_p70_m < hip.roof_z_max_m


@pytest.mark.parametrize(
    ("ring", "angle_deg", "name"),
    [
        (BOX, [30, 90, 50, 90], "gable"),
        (BOX, [40, 40, 40, 40], "hip"),
        (BOX, [30, 50, 30, 50], "hip"),
        (BOX * [5, 1], [45, 45, 45, 45], "hip"),
        (BOX * [1, 1.5], [40, 40, 40, 40], "pyramid"),
        (BOX * [1, 1.49], [40, 40, 40, 40], "pyramid"),
        # one end is a gable; slopes round a corner; a valley between two wings
        (BOX, [40, 40, 40, 90], "several-slopes"),
        (BOX, [40, 40, 90, 90], "several-slopes"),
        (L_SHAPE, [40, 90, 40, 40, 90, 40], "several-slopes"),
        (L_SHAPE, [40] * 6, "several-slopes"),
    ],
)
def test_roofs_have_the_names_of_the_field(ring: np.ndarray, angle_deg: list[float], name: str) -> None:
    assert measure("any", ring, angle_deg).roof_type == name
    turn = np.radians(33)
    turned = ring @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    assert measure("turned", turned, angle_deg).roof_type == name


def test_a_roof_of_many_planes_has_several_slopes() -> None:
    house = building("a", BOX, [40, 90, 40, 90]).mesh
    assert house is not None
    hall = Mesh.joined([house.translated([50.0 * number, 0, 0]) for number in range(60)])
    assert measures.measure(hall).roof_type == measures.SLOPES


def test_open_ground_is_no_roof() -> None:
    row = yard_house()
    measured = measures.measure(row.placed_mesh)
    without = measure("house", np.array([[0, 0], [8, 0], [8, 8], [0, 8.0]]), [SLOPE_DEG, 90, SLOPE_DEG, 90])
    assert measured.outer_floor_area_m2 == pytest.approx(YARD_M2) and without.outer_floor_area_m2 == 0
    assert measured.ground_area_m2 == pytest.approx(HOUSE_M2 + YARD_M2)
    assert measured.flat_roof_area_m2 == 0 and measured.roof_type == measures.GABLE
    for name in (
        "sloped_roof_area_m2",
        "roof_z_min_m",
        "roof_z_p50_m",
        "roof_z_p70_m",
        "roof_z_max_m",
        "ridge_z_m",
    ):
        assert getattr(measured, name) == pytest.approx(getattr(without, name), abs=1e-3), name
    assert measured.volume_m3 == pytest.approx(without.volume_m3 + YARD_M2 * YARD_M, rel=1e-4)
    assert attributes(result(row))["outer_floor_area_m2"] == pytest.approx(YARD_M2)


def test_open_ground_is_outside_the_building() -> None:
    """A yard without points on a roof is most of the footprint, and the roof ends before it: of the house, a strip of
    2 m has no points."""
    x_m, y_m = (each.ravel() for each in np.meshgrid(np.arange(0.25, 20, 0.5), np.arange(0.25, 8, 0.5)))
    is_house, is_seen = x_m < 8, (x_m < 3) | (x_m > 5)
    point_m = np.column_stack([x_m, y_m, np.where(is_house, 5.0, 0.0)])[is_seen]
    classes = np.where(is_house, BUILDING_CLASS, GROUND_CLASS)[is_seen].astype(np.uint8)
    footprint = np.array([[0, 0], [20, 0], [20, 8], [0, 8.0]])
    house = Building("a", "t", (652000.0, 6861000.0), [footprint], point_m, classes, 100.0)
    row = result_of(Row(0, house, "ok"), fitting.fit([house], Reconstruct())[0], Reconstruct())
    values = attributes(row)
    assert values["ground_area_m2"] == pytest.approx(8 * 8, abs=4) and values["visible_share"] < 0.4
    assert values["extrapolated_area_m2"] == pytest.approx(2 * 8, abs=1)
    # nor is it in the block of LoD 1.2
    _, feature = map(json.loads, "".join(city_json([row], LAMBERT, lods=["1.2"])).splitlines())
    assert 1e-5 * np.ptp(feature["vertices"], axis=0) == pytest.approx([8, 8, 5], abs=0.3)


def test_quantiles_are_those_of_a_fine_raster() -> None:
    mesh = building("hip", L_SHAPE, [30, 50, 40, 35, 25, 45])
    measured = measures.measure(mesh.placed_mesh)
    x, y = np.meshgrid(np.arange(0.02, 12, 0.04), np.arange(0.02, 16, 0.04))
    xy = np.column_stack([x.ravel(), y.ravel()])
    xy = xy[(xy[:, 0] < 6) | (xy[:, 1] < 8)]
    z = np.full(len(xy), np.nan)
    for t in mesh.mesh.triangle[np.isin(mesh.mesh.kind, [2, 3])]:
        a, b, c = mesh.mesh.vertex_m[t]
        share = np.linalg.solve(np.column_stack([b[:2] - a[:2], c[:2] - a[:2]]), (xy - a[:2]).T)
        inside = (share >= -1e-9).all(axis=0) & (share.sum(axis=0) <= 1 + 1e-9)
        z[inside] = a[2] + share[0, inside] * (b[2] - a[2]) + share[1, inside] * (c[2] - a[2])
    assert np.isfinite(z).all()
    expected = np.quantile(z, [0.5, 0.7]) + 100
    assert (measured.roof_z_p50_m, measured.roof_z_p70_m) == pytest.approx(tuple(expected), abs=0.005)


def test_party_walls_are_where_neighbours_overlap() -> None:
    """Two gables side by side, the second one lower and 4 m further back, and one 5 m away."""
    lower = building("b", BOX + np.array([0, 4]), [0.0] * 4, 3.0, x_m=12.05)
    rows = [building("a", BOX, GABLE), lower, building("c", BOX, GABLE, x_m=30)]
    areas = measures.party_wall_areas_m2([row.placed_mesh for row in rows])
    assert areas == pytest.approx([4 * 3, 4 * 3, 0], abs=1e-6)
    assert measures.party_wall_areas_m2([]).shape == (0,)
    values = attributes(result(rows[1], party_wall_area_m2=float(areas[1])))
    assert values["party_wall_area_m2"] == 12 and values["outer_wall_area_m2"] == 2 * (12 + 8) * 3 - 12


def test_names_of_3dbag() -> None:
    gable = result(building("a", BOX, GABLE), dates=(date(2020, 12, 30), date(2021, 2, 3)), is_reliable=True)
    ours, theirs = (attributes(gable, {"clouds": ["ahn.laz"]}, names) for names in ("p2wss", "3dbag"))
    assert ours["points_date"] == "2021-02-03"
    assert theirs["b3_pw_datum"] == 2021 and theirs["b3_pw_bron"] == "ahn.laz"
    assert theirs["b3_h_nok"] == ours["ridge_z_m"] == 109
    assert (ours["roof_type"], theirs["b3_dak_type"]) == ("gable", "slanted")
    assert theirs["b3_kwaliteitsindicator"] is True and theirs["b3_val3dity_lod22"] == "[]"
    assert set(ours) - set(theirs) == {name for name in TO_3DBAG if name in ours}
    flat = replace(gable, status="flat", reason=reasons.NO_ROOF)
    assert attributes(flat, names="3dbag")["b3_dak_type"] == "no planes"
    none = Result(
        replace(gable.reconstruction, mesh=None), "none", reasons.NO_POINTS, 0,
        float("nan"), float("nan"), False,
    )  # fmt: skip
    values = attributes(none, names="3dbag")
    assert values["b3_dak_type"] == "no points" and values["b3_volume_lod22"] is None
    assert values["b3_val3dity_lod22"] is None and values["b3_pw_datum"] is None


def test_columns_of_the_input_come_first_and_keep_their_names() -> None:
    columns = {
        "usage": "Annexe",
        "STATUS": "En service",
        "height": np.float64(4.5),
        "gap": np.float64("nan"),
        "built": pd.Timestamp(1931, 5, 1),
        "day": datetime(2020, 1, 2, 3),
        "etages": np.int32(2),
        "codes": np.arange(2000),
        "geometry": "none",
        "geom": "none",
        "Usage": "Garage",
        "input_status": "old",
    }
    values = attributes(result(building("a", BOX, GABLE), columns=columns))
    assert list(values)[:3] == ["usage", "input_STATUS", "height"]
    assert values["status"] == "ok" and values["input_STATUS"] == "En service"
    assert values["gap"] is None and values["etages"] == 2 and values["height"] == 4.5
    assert values["built"] == "1931-05-01T00:00:00" and values["day"] == "2020-01-02T03:00:00"
    # whole, and not as numpy shortens it
    assert json.loads(values["codes"]) == list(range(2000)) and values["input_geometry"] == "none"
    # names that SQL, and so GeoPackage, does not tell apart
    assert values["input_geom"] == "none" and values["input_Usage"] == "Garage"
    assert values["input_input_status"] == "old" and len({name.lower() for name in values}) == len(values)
    json.dumps(values)


def test_a_block_of_lod_1_2_stands_beside_the_roof() -> None:
    results = [result(building("a", BOX, GABLE)), result(building("b", L_SHAPE, [40.0] * 6, x_m=20))]
    facts = {"clouds": ["a.laz", "b.laz", "c.laz", "d.laz"]}
    results[0] = replace(results[0], dates=(date(2021, 3, 1), date(2021, 3, 1)))
    for lods, expected in ((["1.2", "2.0"], ["1.2", "2.0"]), (["1.2"], ["1.2"]), (["2.0"], ["2.0"])):
        text = "".join(city_json(results, LAMBERT, "cityjsonseq", facts, lods))
        header, *features = map(json.loads, text.splitlines())
        assert header["metadata"]["title"].endswith(
            "from a.laz, b.laz, c.laz and 1 more, points of 2021-03-01"
        )
        assert header["metadata"]["referenceDate"] == "2021-03-01"
        for feature in features:
            geometries = feature["CityObjects"][feature["id"]]["geometry"]
            assert [geometry["lod"] for geometry in geometries] == expected
        assert not any(solid_rules.codes_of_text(text).values())
        assert cityjson_rules.assert_sequence([header, *features]) == 2 * len(lods)
    document = json.loads("".join(city_json(results, LAMBERT, "cityjson", facts, ["1.2", "2.0"])))
    assert cityjson_rules.assert_document(document) == 4
    block, _ = document["CityObjects"]["a"]["geometry"]
    used = {v for rings in block["boundaries"][0] for ring in rings for v in ring}
    z = [
        document["vertices"][v][2] * document["transform"]["scale"][2] + document["transform"]["translate"][2]
        for v in used
    ]
    # 70 % of the height of the gable
    assert sorted({round(value, 3) for value in z}) == [100, 107.8]


def test_slopes_have_the_names_of_3dbag_too() -> None:
    text = "".join(city_json([result(building("a", BOX, GABLE))], LAMBERT, names="3dbag"))
    (geometry,) = json.loads(text.splitlines()[1])["CityObjects"]["a"]["geometry"]
    roofs = [s for s in geometry["semantics"]["surfaces"] if s["type"] == "RoofSurface"]
    assert sorted(roof["b3_azimut"] for roof in roofs) == [0, 180]
    assert [roof["b3_hellingshoek"] for roof in roofs] == [45, 45]


@pytest.mark.parametrize(
    ("crs", "expected"),
    [
        ("EPSG:28992", 28992),
        ("EPSG:7415", 7415),
        ("EPSG:28992+5709", 7415),
        ("EPSG:2154+5720", 5698),
        ("EPSG:5698", 5698),
        # there is no such pair
        ("EPSG:2154+5709", 2154),
        # nor one of heights above the ellipsoid
        (pyproj.CRS("EPSG:32631").to_3d().to_wkt(), 32631),
        ("+proj=tmerc +lat_0=1 +ellps=GRS80", None),
    ],
)
def test_the_reference_system_has_heights_where_they_are_known(crs: str, expected: int | None) -> None:
    assert epsg_of(pyproj.CRS(crs)) == expected
    # as files state it
    assert epsg_of(pyproj.CRS(pyproj.CRS(crs).to_wkt())) == expected


def test_heights_that_the_user_states_belong_to_the_reference_system() -> None:
    names = ("a.laz", "b.gpkg")
    assert common_crs(LAMBERT, LAMBERT, "EPSG:5698", names)[0] == pyproj.CRS(5698)
    with_heights = pyproj.CRS(5698)
    assert common_crs(with_heights, LAMBERT, "EPSG:2154", names)[0] == with_heights


def test_days_of_points(tmp_path: Path) -> None:
    """Adjusted standard time where it is one, whatever the header says; else the day of the file."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.creation_date = date(2022, 6, 1)
    las = laspy.LasData(header)
    las.x = las.y = las.z = np.arange(5.0)
    day = (date(2021, 2, 17) - GPS_EPOCH).days
    raw_s, unix_s = day * 86_400.0, pd.Timestamp(2021, 2, 17).timestamp()
    las.gps_time = np.array([raw_s - 1e9 + 5, 1000.0, raw_s + 86_400 - 1e9 - 5, raw_s, unix_s])
    las.write(tmp_path / "a.laz")
    cloud = read_clouds([tmp_path / "a.laz"])
    assert cloud.day is not None
    days = [GPS_EPOCH + pd.Timedelta(int(value), "D") for value in cloud.day]
    assert days == [
        date(2021, 2, 17),
        date(2022, 6, 1),
        date(2021, 2, 17),
        date(2022, 6, 1),
        date(2022, 6, 1),
    ]


def test_a_rejected_footprint_has_no_measures() -> None:
    gable = building("a", BOX, GABLE)
    empty = Building("a", "t", (0.0, 0.0), [], np.zeros((0, 3)), np.zeros(0, np.uint8), float("nan"))
    values = attributes(
        Result(
            no_mesh(empty, "fit", reasons.EMPTY), "none", reasons.EMPTY, 0, float("nan"), float("nan"), False
        )
    )
    expected = attributes(result(gable))
    assert list(values) == list(expected)
    assert values["roof_type"] is None and values["volume_m3"] is None and values["is_reliable"] is False
