"""Lines of roofs that a map knows: read, given to the buildings in which they lie, and counted."""

from __future__ import annotations

import json
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pyproj
import pytest
import shapely

import p2wss
from p2wss import cli
from p2wss.data.crs import metric_crs
from p2wss.reconstruction.roof_lines import LINES, read_lines, with_lines
from p2wss.storage.features import Features
from p2wss.storage.messages import InputError

ORIGIN = np.array([652_000.0, 6_862_000.0])
WEST, EAST = (shapely.box(*(ORIGIN + np.array([[x, 0], [x + 12, 8]])).ravel()) for x in (0, 12))
CRS = metric_crs(pyproj.CRS(2154), (*ORIGIN, *(ORIGIN + 30)), "cloud")[0]


def line(*xy_m: tuple[float, ...]) -> shapely.LineString:
    return shapely.LineString([(*(ORIGIN + place[:2]), *place[2:]) for place in xy_m])


def test_lines_are_read_from_any_vector_file_in_any_crs(tmp_path: Path) -> None:
    bent = line((1, 4, 9.0), (5, 4, 9.0), (8, 7, 6.0), (9, 8, 5.0))
    shapes = [bent, shapely.MultiLineString([line((20, 1), (20, 3)), line((21, 1), (21, 3))])]
    mixed = shapely.GeometryCollection([shapely.MultiLineString([line((22, 1), (22, 3))]), WEST])
    table = gpd.GeoDataFrame(geometry=[*shapes, mixed, None], crs=2154)
    table.to_crs(4326).to_file(tmp_path / "lines.geojson")
    # beside another layer, and without a CRS, which is then that of the clouds
    gpd.GeoDataFrame(geometry=[WEST], crs=2154).to_file(tmp_path / "a.gpkg", layer="houses")
    gpd.GeoDataFrame(geometry=shapes[:1]).set_crs(2154).to_file(tmp_path / "a.gpkg", layer="ridges")
    # straight pieces: a vertex within one is left out
    expected = [[1, 4, 5, 4], [5, 4, 9, 8], [20, 1, 20, 3], [21, 1, 21, 3], [22, 1, 22, 3]]
    for given, num in ((tmp_path / "lines.geojson", 5), (tmp_path / "a.gpkg", 2), (table, 5)):
        found = read_lines(given, CRS)
        assert (found - ORIGIN).reshape(-1, 4) == pytest.approx(np.array(expected[:num]), abs=0.02)
    with pytest.raises(InputError, match=r"b.gpkg: has no lines; lines of roofs must be LineStrings"):
        gpd.GeoDataFrame(geometry=[WEST], crs=2154).to_file(tmp_path / "b.gpkg")
        read_lines(tmp_path / "b.gpkg", CRS)


def test_a_footprint_gets_the_pieces_of_lines_within_it() -> None:
    lines = [
        line((-3, 4), (30, 4)),  # the ridge of the row
        line((0, 0), (12, 0)),  # along a wall
        line((12, 0), (12, 8)),
        line((20, -1), (20, 0.5)),  # too short within
        line((40, 40), (50, 40)),
    ]
    shapes = np.array([WEST, EAST, shapely.Polygon(), None], object)
    end_m = np.array([shapely.get_coordinates(each) for each in lines])
    rows = with_lines(Features(shapes, {}, None), end_m)[LINES]
    pieces = [np.round(each - ORIGIN, 3).reshape(-1, 4).tolist() for each in rows]
    assert pieces == [[[0.2, 4, 11.8, 4]], [[12.2, 4, 23.8, 4]], [], []]


def points(num: int) -> np.ndarray:
    """Two hip roofs of 40 degrees side by side, and the ground around them."""
    rng = np.random.default_rng(5)
    xy = rng.uniform((-8, -8), (32, 16), (num * 10, 2))
    on = (xy >= 0).all(axis=1) & (xy[:, 0] <= 24) & (xy[:, 1] <= 8)
    x, y = xy[:, 0] % 12, xy[:, 1]
    slope = np.minimum(np.minimum(x, 12 - x), np.minimum(y, 8 - y)) * np.tan(np.radians(40))
    z = np.where(on, 4 + slope, 0) + rng.normal(0, 0.05, len(xy))
    # of the roofs fewer
    keep = ~on | (np.cumsum(on) <= num)
    return np.column_stack([xy + ORIGIN, z, np.where(on, 6, 2)])[keep]


HOUSES = gpd.GeoDataFrame({"id": ["west", "east"]}, geometry=[WEST, EAST], crs=2154)
HIPS = [((0, 0), (4, 4)), ((0, 8), (4, 4)), ((4, 4), (8, 4)), ((8, 4), (12, 0)), ((8, 4), (12, 8))]
LINES_OF_WEST = gpd.GeoSeries([line(*ends) for ends in HIPS], crs=2154)


def test_lines_of_a_map_in_a_run(tmp_path: Path) -> None:
    cloud = points(100)
    bare = p2wss.reconstruct(cloud, HOUSES, model="none", progress=False)
    scene = p2wss.reconstruct(cloud, HOUSES, lines=LINES_OF_WEST, model="none", progress=False)
    west, east = scene["west"], scene["east"]
    assert (west.attributes["lines_given"], west.attributes["lines_used"]) == (5, 5)
    assert (east.attributes["lines_given"], east.attributes["lines_used"]) == (0, 0)
    assert scene.summary == bare.summary + "; of 5 lines 5 used, 0 unused"

    assert "lines_given" not in bare["west"].attributes
    assert np.array_equal(east.mesh.vertices, bare["east"].mesh.vertices)
    scene.write(tmp_path, ["cityjsonseq", "gpkg"], name="a")
    table = gpd.read_file(tmp_path / "a.gpkg", layer="buildings")
    assert table["lines_used"].tolist() == [5, 0] and not any(LINES in name for name in table)


def test_lines_move_with_their_footprint() -> None:
    """Footprints and lines of one map, a metre beside the points."""
    cloud, moved = points(2000), HOUSES.set_geometry(HOUSES.translate(0.8, 0.6))
    config = {"reconstruct": {"registration": "always"}}
    lines = LINES_OF_WEST.translate(0.8, 0.6)
    scene = p2wss.reconstruct(cloud, moved, lines=lines, model="none", config=config, progress=False)
    west = scene["west"].attributes
    assert (west["shift_x_m"], west["shift_y_m"]) == pytest.approx((-0.8, -0.6), abs=0.15)
    assert west["lines_used"] == 5


def test_the_option_of_the_command(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    caplog.set_level("INFO")
    las = laspy.create(point_format=6, file_version="1.4")
    x, y, z, classification = points(100).T
    las.header.offsets, las.header.scales = np.array([*ORIGIN, 0.0]), np.full(3, 0.001)
    las.x, las.y, las.z, las.classification = x, y, z, classification.astype(np.uint8)
    las.write(tmp_path / "cloud.laz")
    HOUSES.to_file(tmp_path / "houses.gpkg")
    LINES_OF_WEST.to_file(tmp_path / "ridges.geojson")
    command = [
        "reconstruct",
        str(tmp_path / "cloud.laz"),
        str(tmp_path / "houses.gpkg"),
        str(tmp_path / "out"),
    ]
    command += ["--model", "none", "--lines"]
    assert cli.main([*command, str(tmp_path / "ridges.geojson")]) == 0
    assert "5 straight pieces of lines in 1 of 2 footprints" in caplog.text
    assert "2 buildings: 2 ok; of 5 lines 5 used, 0 unused" in caplog.text
    facts = json.loads((tmp_path / "out/cloud.json").read_text())["p2wss"]
    assert facts["lines"] == "ridges.geojson"
    assert cli.main([*command, str(tmp_path / "gone.geojson")]) == 2
    assert "gone.geojson: no such file" in capsys.readouterr().err
    assert cli.main([*command, str(tmp_path / "houses.gpkg")]) == 2
    assert "houses.gpkg: has no lines" in capsys.readouterr().err
