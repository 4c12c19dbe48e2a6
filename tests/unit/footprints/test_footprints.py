"""Cleaning of footprints: every row is kept, with a polygon that the kernel accepts or with a reason."""

from __future__ import annotations

from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest
import shapely
from feature_tables import clean_footprints, read_footprints, split_parts
from hypothesis import example, given, settings
from hypothesis import strategies as st
from places import SHARED

from p2wss.config import Scenes
from p2wss.data import polygon_arrays
from p2wss.footprints.coverage import kernel_status
from p2wss.storage.messages import InputError

CONFIG = Scenes()
DELFT = SHARED / "data" / "delft_ahn3" / "footprints.gpkg"


def frame(*shapes: object, crs: str = "EPSG:2154") -> gpd.GeoDataFrame:
    return gpd.GeoDataFrame(
        {"building_id": [f"B{i}" for i in range(len(shapes))]}, geometry=list(shapes), crs=crs
    )


def cleaned(*shapes: object) -> gpd.GeoDataFrame:
    return clean_footprints(frame(*shapes), CONFIG)


def test_defects_are_removed_and_the_shape_is_kept() -> None:
    """Z, a repeated and a near-collinear vertex and a 2 cm edge, clockwise: the result is a rectangle."""
    ring = [
        (0, 0, 5),
        (0, 8, 5),
        (0, 8, 5),
        (5, 8.01, -1000),
        (10, 8, 5),
        (10, 0.02, 5),
        (10, 0, 5),
        (4, 0, 5),
    ]
    row = cleaned(shapely.Polygon(ring)).iloc[0]
    assert row.status == "ok"
    assert row.geometry.exterior.is_ccw and not row.geometry.has_z
    assert len(row.geometry.exterior.coords) == 5
    assert row.geometry.symmetric_difference(shapely.box(0, 0, 10, 8)).area < 0.3


def test_multipolygons_are_split_and_slivers_dropped() -> None:
    parts = shapely.MultiPolygon(
        [shapely.box(0, 0, 5, 5), shapely.box(10, 0, 20, 5), shapely.box(30, 0, 30.5, 1)]
    )
    result = cleaned(shapely.box(50, 0, 60, 5), parts)
    assert list(result["building_id"]) == ["B0", "B1-1", "B1-2"]
    assert list(result["status"]) == ["ok"] * 3
    assert list(result.area) == pytest.approx([50, 25, 50])


def test_bow_tie_is_repaired() -> None:
    result = cleaned(shapely.Polygon([(0, 0), (10, 8), (10, 0), (0, 8)]))
    assert list(result["status"]) == ["ok", "ok"]
    assert result.area.sum() == pytest.approx(40)


def test_courtyards_become_clockwise() -> None:
    result = cleaned(shapely.box(0, 0, 30, 30).difference(shapely.box(10, 10, 20, 20)))
    polygon = result.geometry.iloc[0]
    assert result["status"].iloc[0] == "ok"
    assert polygon.exterior.is_ccw and not polygon.interiors[0].is_ccw
    assert polygon.area == pytest.approx(800)


def test_a_courtyard_that_touches_the_exterior_is_cut_apart() -> None:
    outside = shapely.box(0, 0, 30, 30)
    touching = shapely.Polygon(outside.exterior.coords, [[(0, 15), (10, 20), (10, 10)]])
    row = cleaned(touching).iloc[0]
    assert row.status == "ok"
    assert row.geometry.area == pytest.approx(touching.area, rel=0.01)


@pytest.mark.parametrize(
    ("shape", "reason"),
    [
        (None, "empty"),
        (shapely.Polygon(), "empty"),
        (shapely.Point(1, 1), "not-a-polygon"),
        (shapely.LineString([(0, 0), (5, 5)]), "not-a-polygon"),
        (shapely.Polygon([(0, 0), (9, 0), (9, np.nan), (0, 9)]), "non-finite"),
        (shapely.Polygon([(0, 0), (9, 0), (4, 0)]), "empty"),
        (shapely.box(0, 0, 1, 1), "too-small"),
        (shapely.Point(0, 0).buffer(400, quad_segs=64), "too-many-edges"),
    ],
)
def test_an_excluded_footprint_keeps_its_row(shape: object, reason: str) -> None:
    result = clean_footprints(frame(shapely.box(0, 0, 9, 9), shape), Scenes(simplify_m=0, max_edges=40))
    assert list(result["building_id"]) == ["B0", "B1"]
    assert list(result["status"]) == ["ok", reason]
    assert result.geometry.iloc[1].is_empty


def test_without_a_polygon_the_centre_is_that_of_the_geometry() -> None:
    result = split_parts(frame(shapely.LineString([(0, 0), (4, 8)]), shapely.Polygon()), 1)
    assert (result["centre_x_m"].iloc[0], result["centre_y_m"].iloc[0]) == (2, 4)
    assert np.isnan(result["centre_x_m"].iloc[1])


@st.composite
def dirty_polygons(draw: st.DrawFn) -> shapely.Polygon:
    """Rings of a few points on a coarse grid, which may cross, touch and collapse."""
    points = draw(st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), min_size=3, max_size=9))
    hole = draw(st.lists(st.tuples(st.integers(1, 7), st.integers(1, 7)), min_size=3, max_size=5))
    holes = [hole] if draw(st.booleans()) else []
    return shapely.Polygon(
        [(3 * x, 3 * y) for x, y in points], [[(3 * x, 3 * y) for x, y in h] for h in holes]
    )


# one that crosses itself around a courtyard of 1.8 m²
@example([shapely.Polygon([(21, 6), (15, 3), (6, 15), (12, 12), (0, 6), (0, 18), (18, 6), (0, 12)])])
# of the second, a line is left beside a narrow polygon
@example(
    [
        shapely.Polygon([(0, 0), (0, 6), (9, 18), (9, 0)]),
        shapely.Polygon([(0, 0), (6, 0), (9, 24), (21, 21)]),
        shapely.Polygon([(9, 24), (12, 21), (12, 24)]),
    ]
)
@settings(max_examples=60, deadline=None)
@given(st.lists(dirty_polygons(), min_size=1, max_size=4))
def test_all_accepted_footprints_pass_the_kernel(shapes: list[shapely.Polygon]) -> None:
    result = cleaned(*shapes)
    assert set(result["building_id"].str.split("-").str[0]) == {f"B{i}" for i in range(len(shapes))}
    assert result["building_id"].is_unique
    good = result[result["status"] == "ok"]
    assert good.is_valid.all() and (good.area >= CONFIG.min_area_m2).all()
    polygons = polygon_arrays.to_polygons(good.geometry.to_numpy())
    assert (kernel_status(polygons) == 0).all()
    # nothing is made up: each lies within the tolerances of its source, in which courtyards below the smallest area
    # of a footprint are closed
    for _, row in good.iterrows():
        source = shapes[int(row.building_id.split("-")[0][1:])]
        valid = shapely.make_valid(source, method="structure", keep_collapsed=False)
        small = [
            shapely.Polygon(ring)
            for part in shapely.get_parts(valid)
            for ring in part.interiors
            if shapely.Polygon(ring).area < CONFIG.min_area_m2
        ]
        assert row.geometry.difference(shapely.union_all([valid.buffer(0.5), *small])).area < 1e-6


def test_ids_from_common_columns_else_numbers(tmp_path: Path) -> None:
    boxes = [shapely.box(20 * i, 0, 20 * i + 9, 9) for i in range(3)]
    path = tmp_path / "f.gpkg"
    for columns, expected in [
        ({"CLEABS": ["a", "b", "c"]}, ["a", "b", "c"]),
        ({"building_id": ["a", "a", "c"], "ID": [7, 8, 9]}, ["7", "8", "9"]),
        ({"name": ["x", "y", "z"]}, ["1", "2", "3"]),
    ]:
        path.unlink(missing_ok=True)
        gpd.GeoDataFrame(columns, geometry=boxes, crs="EPSG:2154").to_file(path)
        assert list(read_footprints(path)["building_id"]) == expected
    assert list(read_footprints(path, id_field="name")["building_id"]) == ["x", "y", "z"]
    # numbers of features do not depend on what else is read
    assert list(read_footprints(path, bounds=(15, 0, 25, 5))["building_id"]) == ["2"]
    with pytest.raises(InputError, match=r"f\.gpkg: has no column pand; its columns are name"):
        read_footprints(path, id_field="pand")


def test_repeated_ids_become_unique_one_by_one(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "f.gpkg"
    boxes = [shapely.box(20 * i, 0, 20 * i + 9, 9) for i in range(6)]
    names = ["x", "y", "x", None, "x_2", "x"]
    gpd.GeoDataFrame({"name": names}, geometry=boxes, crs="EPSG:2154").to_file(path)
    expected = ["x", "y", "x_3", "4", "x_2", "x_4"]
    assert list(read_footprints(path, id_field="name")["building_id"]) == expected
    assert "1 of 6 values are missing, x occurs more than once (as do 1 more)" in caplog.text
    # the same ids whatever is read
    for i, name in enumerate(expected):
        window = (20 * i + 1, 1, 20 * i + 2, 2)
        assert list(read_footprints(path, "name", window)["building_id"]) == [name]


def test_a_bad_file_is_an_error_of_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.gpkg: no such file"):
        read_footprints(tmp_path / "gone.gpkg")
    (tmp_path / "f.gpkg").write_text("<html>")
    with pytest.raises(InputError, match=r"f\.gpkg: not a readable vector file"):
        read_footprints(tmp_path / "f.gpkg")
    gpd.GeoDataFrame(geometry=[shapely.box(4, 45, 4.1, 45.1)], crs="EPSG:4326").to_file(tmp_path / "d.gpkg")
    # without a CRS to reproject to
    with pytest.raises(InputError, match=r"d\.gpkg: is in WGS 84, in degrees"):
        read_footprints(tmp_path / "d.gpkg")
    line = shapely.LineString([(0, 0), (1, 1)])
    gpd.GeoDataFrame(geometry=[line], crs="EPSG:2154").to_file(tmp_path / "l.gpkg")
    with pytest.raises(InputError, match=r"l\.gpkg: has no polygons; QGIS makes"):
        read_footprints(tmp_path / "l.gpkg")


@pytest.mark.skipif(not DELFT.exists(), reason="no shared/data/delft_ahn3")
def test_all_footprints_of_delft_are_accepted() -> None:
    result = clean_footprints(read_footprints(DELFT), CONFIG)
    assert list(result["status"]) == ["ok"] * 74
    assert result["building_id"].str.startswith("b").all()


def test_parts_never_get_the_id_of_another_feature() -> None:
    squares = [shapely.box(20 * i, 0, 20 * i + 10, 10) for i in range(4)]
    frame = gpd.GeoDataFrame(
        {"building_id": ["A-1", "A", "A-3"]},
        geometry=[squares[0], shapely.MultiPolygon(squares[1:3]), squares[3]],
        crs=2154,
    )
    assert split_parts(frame, 1.0)["building_id"].tolist() == ["A-1", "A-2", "A-4", "A-3"]


def test_parts_have_names_of_their_own_in_every_window(tmp_path: Path) -> None:
    """What one window does not show has a name too: a part that got it would be there twice in the whole."""
    squares = [shapely.box(100 * i, 0, 100 * i + 10, 10) for i in range(8)]
    shapes = [
        shapely.MultiPolygon(squares[0:2]),
        shapely.MultiPolygon(squares[2:4]),
        squares[4],
        squares[5],
        shapely.MultiPolygon(squares[6:8]),
    ]
    ids = ["A", "A-1", "A-2", "A-1-1", "A-02"]
    path = tmp_path / "parts.gpkg"
    gpd.GeoDataFrame({"building_id": ids}, geometry=shapes, crs=2154).to_file(path)
    whole = split_parts(read_footprints(path), 1.0)
    expected = ["A-3", "A-4", "A-1-2", "A-1-3", "A-2", "A-1-1", "A-02-1", "A-02-2"]
    assert whole["building_id"].tolist() == expected
    windows = [(0.0, -5.0, 150.0, 15.0), (190.0, -5.0, 350.0, 15.0), (390.0, -5.0, 800.0, 15.0)]
    by_window = [split_parts(read_footprints(path, bounds=bounds), 1.0) for bounds in windows]
    assert [name for frame in by_window for name in frame["building_id"]] == expected
    assert list(whole.columns) == list(by_window[0].columns)
    assert not [name for name in whole.columns if "taken" in name]


def test_of_several_layers_it_is_said_which_is_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "layers.gpkg"
    gpd.GeoDataFrame({"a": [1]}, geometry=[shapely.Point(0, 0)], crs="EPSG:2154").to_file(path, layer="trees")
    frame(shapely.box(0, 0, 9, 9)).to_file(path, layer="houses")
    with caplog.at_level("INFO", logger="p2wss"):
        features = read_footprints(path)
    assert len(features) == 1
    assert (
        "layer houses, the first that may have polygons, is read; --layer reads another: trees" in caplog.text
    )


def test_a_stated_layer_is_read_by_name(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "layers.gpkg"
    frame(shapely.box(0, 0, 9, 9)).to_file(path, layer="houses")
    both = frame(shapely.box(0, 0, 9, 9), shapely.box(20, 0, 29, 9))
    both.to_file(path, layer="sheds")
    with caplog.at_level("INFO", logger="p2wss"):
        assert len(read_footprints(path, layer="sheds")) == 2
        # ids do not depend on the window, nor on the layer that comes first
        assert list(read_footprints(path, layer="sheds", bounds=(19, 0, 30, 9))["building_id"]) == [
            list(read_footprints(path, layer="sheds")["building_id"])[1]
        ]
    assert "layer" not in caplog.text
    with pytest.raises(InputError, match=r"has no layer barns; its layers are houses, sheds"):
        read_footprints(path, layer="barns")
    both.to_parquet(tmp_path / "f.parquet")
    with pytest.raises(InputError, match="has no layers; omit --layer"):
        read_footprints(tmp_path / "f.parquet", layer="sheds")
