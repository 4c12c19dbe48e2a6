"""Ids and heights of the sources that users have."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from p2wss.footprints.schemas import (
    SCHEMAS,
    FootprintSchema,
    building_ids,
    detected,
    schema_of,
    stated_heights_m,
)
from p2wss.storage.features import Features, columns_of
from p2wss.storage.messages import InputError

# the columns of each source, and the id and height of its row
SOURCES = {
    "bdtopo": ({"cleabs": "BATIMENT1", "hauteur": 4.5, "nombre_d_etages": 2}, "BATIMENT1", 4.5),
    "overture": ({"id": "08b2", "sources": "[]", "height": None, "num_floors": 3.0}, "08b2", 9.0),
    "osm": ({"osm_id": "way/7", "height": None, "building:levels": "2"}, "way/7", 6.0),
    "bag": ({"identificatie": "0503", "bouwjaar": 1900}, "0503", np.nan),
    "3dbag": ({"identificatie": "N.1", "b3_h_maaiveld": -0.5, "b3_h_dak_70p": 7.25}, "N.1", 7.75),
    "swissbuildings": (
        {"UUID": "{1}", "OBJEKTART": "x", "DACH_MAX": 450.0, "GELAENDEPUNKT": 440.0},
        "{1}",
        10.0,
    ),
}


def features(table: pd.DataFrame) -> Features:
    return Features(np.full(len(table), None), columns_of(table))


def ids(table: pd.DataFrame, schema: FootprintSchema) -> list[str]:
    return building_ids(columns_of(table), table.index.to_numpy(), schema, None, "f")


@pytest.mark.parametrize("length", [None, 10], ids=["whole", "as of a shapefile"])
@pytest.mark.parametrize("name", SOURCES)
def test_each_source_is_known_by_its_columns(name: str, length: int | None) -> None:
    columns, building_id, height_m = SOURCES[name]
    table = pd.DataFrame([columns]).rename(columns=lambda column: column[:length])
    assert detected(list(table.columns)) == name
    for schema in (schema_of(list(table.columns)), SCHEMAS[name]):
        assert ids(table, schema) == [building_id]
        assert stated_heights_m(features(table), schema, None, "f") == pytest.approx([height_m], nan_ok=True)


def test_shapefiles_of_bd_topo() -> None:
    table = pd.DataFrame({"ID": ["B1", "B2"], "HAUTEUR": [0.0, 5.0], "NB_ETAGES": [2.0, np.nan]})
    assert detected(list(table.columns)) == "bdtopo"
    # 0 is no height
    assert list(stated_heights_m(features(table), SCHEMAS["bdtopo"], None, "f")) == [6.0, 5.0]


@pytest.mark.parametrize(("values", "is_told"), [(["brick", None], True), (["3 m", "high"], False)])
def test_a_column_of_heights_without_a_number_is_told(
    values: list[str | None], is_told: bool, caplog: pytest.LogCaptureFixture
) -> None:
    table = features(pd.DataFrame({"material": values}))
    stated_heights_m(table, schema_of([]), "material", "f")
    assert ("no height is used of column material, as none is a number: 'brick'" in caplog.text) == is_told


def test_names_of_which_a_shapefile_keeps_ten_characters() -> None:
    own = pd.DataFrame({"id": ["x", "x"], "building_i": ["a", "b"], "building_h": [8.0, 9.0]})
    assert ids(own, schema_of(own.columns)) == ["a", "b"]
    assert stated_heights_m(features(own), schema_of(own.columns), None, "x").tolist() == [8.0, 9.0]


def test_heights_as_text() -> None:
    table = pd.DataFrame({"height": ["12", "12.5 m", "40 ft", "40'", "3,5", "-4", "high", None, "5000"]})
    expected = [12, 12.5, 12.192, 12.192, 3.5, np.nan, np.nan, np.nan, np.nan]
    assert stated_heights_m(features(table), schema_of([]), None, "f") == pytest.approx(expected, nan_ok=True)
    with pytest.raises(InputError, match="f: has no column h; its columns are height"):
        stated_heights_m(features(table), schema_of([]), "h", "f")


def test_a_named_height_counts_before_those_of_the_schema() -> None:
    table = pd.DataFrame({"height": [5.0, 6.0], "measured": [7.0, np.nan]})
    assert list(stated_heights_m(features(table), schema_of([]), "measured", "f")) == [7.0, 6.0]


def test_without_ids_numbers_of_features() -> None:
    table = pd.DataFrame({"use": ["a", "b"]}, index=[41, 7])
    assert ids(table, schema_of(list(table.columns))) == ["41", "7"]


def test_whole_numbers_beside_missing_ones_stay_whole() -> None:
    table = pd.DataFrame({"id": [12.0, np.nan]}, index=[1, 2])
    assert ids(table, schema_of(list(table.columns))) == ["12", "2"]


def test_a_known_id_keeps_its_name_where_a_missing_one_has_the_same_number() -> None:
    table = pd.DataFrame({"id": [None, "1"]}, index=[1, 2])
    assert ids(table, schema_of(list(table.columns))) == ["1_2", "1"]
