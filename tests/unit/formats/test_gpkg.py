"""GeoPackages with a style for QGIS."""

from __future__ import annotations

import re
import sqlite3
import time
import xml.etree.ElementTree as ET
from contextlib import closing
from pathlib import Path
from typing import Any

import geopandas as gpd
import pyogrio
import pytest
import shapely

import p2wss.formats
from p2wss.formats import gpkg
from p2wss.storage.features import Features

STATES = {"a": "ok", "b": "flagged", "c": "flagged", "d": "flat", "e": "none"}


@pytest.fixture
def features() -> Features:
    columns = {
        "building_id": [*STATES],
        "status": ["ok", "ok", "ok", "flat", "none"],
        "not_representable": [False, True, False, True, False],
        "footprint_flags": [None, None, "ground-inside", None, None],
    }
    return Features.of(gpd.GeoDataFrame(columns, geometry=[shapely.box(0, 0, 1, 1)] * 5, crs=2154))


def test_qgis_finds_the_style_of_the_layer_and_others_the_layers(features: Features, tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    gpkg.write(path, features, {}, more={"input_footprints": features}, style=gpkg.STYLE)
    layers = dict(pyogrio.list_layers(path))
    assert layers == {"buildings": "Polygon", "input_footprints": "Polygon", "layer_styles": None}
    assert gpd.read_file(path, layer="buildings")["building_id"].tolist() == [*STATES]
    with closing(sqlite3.connect(path)) as file:
        # as QGIS asks for it
        ((column,),) = file.execute(
            "SELECT column_name FROM gpkg_geometry_columns WHERE table_name = 'buildings'"
        )
        query = (
            "SELECT styleQML, useAsDefault FROM layer_styles WHERE f_table_schema = '' AND f_table_name = ?"
        )
        ((style, is_default),) = file.execute(f"{query} AND f_geometry_column = ?", ("buildings", column))
        assert file.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        root = ET.fromstring(style)
        expression = root.find("renderer-v2").get("attr")
        # an expression of QGIS that SQL has, too
        states = dict(file.execute(f"SELECT building_id, {expression} FROM buildings"))
    assert is_default and states == STATES and root.find("layerGeometryType").text == "2"
    assert {each.get("value") for each in root.iter("category")} == set(STATES.values())
    assert {each.get("symbol") for each in root.iter("category")} == {
        each.get("name") for each in root.iter("symbol")
    }


def test_the_colours_and_words_are_those_of_the_page() -> None:
    script = (Path(p2wss.formats.__file__).parent / "assets/viewer.js").read_text(encoding="utf-8")
    found = re.findall(r'^    (\w+): \["(#\w+)", "([^"]+)"\],$', script, re.M)
    assert {state: (color, text) for state, color, text in found} == gpkg.STATES


def test_a_style_has_the_same_bytes_whenever_it_is_written(features: Features, tmp_path: Path) -> None:
    for name in ("a.gpkg", "b.gpkg"):
        gpkg.write(tmp_path / name, features, {}, style=gpkg.STYLE)
        time.sleep(0.01)
    assert (tmp_path / "a.gpkg").read_bytes() == (tmp_path / "b.gpkg").read_bytes()


def test_sqlite_does_not_wait_for_the_disk_while_a_file_is_written(
    features: Features, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, add_layer, seen = "OGR_SQLITE_SYNCHRONOUS", gpkg._add_layer, []

    def add(*arguments: Any, **options: Any) -> None:
        seen.append(pyogrio.get_gdal_config_option(name))
        add_layer(*arguments, **options)

    monkeypatch.setattr(gpkg, "_add_layer", add)
    gpkg.write(tmp_path / "a.gpkg", features, {})
    # a program that writes files of its own may want them to be safe at each step
    assert seen == [False] and pyogrio.get_gdal_config_option(name) is None
    pyogrio.set_gdal_config_options({name: "FULL"})
    gpkg.write(tmp_path / "b.gpkg", features, {})
    kept = pyogrio.get_gdal_config_option(name)
    pyogrio.set_gdal_config_options({name: None})
    assert seen == [False, False] and kept == "FULL"
