"""Footprints in formats of every kind: read right, or refused in one line that says what to do."""

from __future__ import annotations

import gzip
import json
import re
import shutil
import sqlite3
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import control_houses as houses
import geopandas as gpd
import numpy as np
import osm_files
import pandas as pd
import pyogrio
import pytest
import shapely
from toy_clouds import LAMBERT

from p2wss.cli.inspection import describe
from p2wss.data.crs import MetricCrs
from p2wss.footprints.cleaning import read_footprints
from p2wss.footprints.vector_files import layer_info, read_attributes, read_vector
from p2wss.formats import gpkg
from p2wss.storage.features import Features
from p2wss.storage.messages import InputError

FOREST = shapely.box(-40, -40, 40, 40)


def _to_file(frame: gpd.GeoDataFrame, path: Path, driver: str) -> Path:
    frame.to_file(path, driver=driver)
    return path


def _table(frame: gpd.GeoDataFrame, path: Path, column: str, separator: str = ",") -> Path:
    table = pd.DataFrame(frame.drop(columns="geometry")).assign(**{column: frame.geometry.to_wkt()})
    table.to_csv(path, index=False, sep=separator)
    return path


def _moved(path: Path, to: str) -> Path:
    return Path(shutil.move(path, path.with_name(to)))


def _osm(frame: gpd.GeoDataFrame, path: Path, write: Callable[[Path, osm_files.Ways], Path]) -> Path:
    degrees = frame.to_crs(4326).geometry
    around = shapely.box(*shapely.buffer(shapely.box(*degrees.total_bounds), 0.001).bounds)
    tags = [{"building": "yes", "height": "8 m"}, {"building:part": "yes", "building:levels": "2"}]
    shapes = [*degrees, around]
    rings = [np.array(each.exterior.coords)[:-1] for each in shapes]
    return write(path, dict(enumerate(zip(rings, [*tags, {"landuse": "forest"}], strict=True), 1)))


WRITERS: dict[str, Callable[[gpd.GeoDataFrame, Path], Path]] = {
    "kml": lambda frame, folder: _to_file(frame, folder / "f.kml", "LIBKML"),
    "gml": lambda frame, folder: _to_file(frame, folder / "f.gml", "GML"),
    "fgb": lambda frame, folder: _moved(_to_file(frame, folder / "f.fgb", "FlatGeobuf"), "f.bin"),
    "gdb": lambda frame, folder: _to_file(frame, folder / "f.gdb", "OpenFileGDB"),
    "gpkg": lambda frame, folder: _moved(_to_file(frame, folder / "f.gpkg", "GPKG"), "f.db"),
    "csv": lambda frame, folder: _table(frame, folder / "f.csv", "WKT"),
    "csv geometry": lambda frame, folder: _table(frame, folder / "f.csv", "geometry", ";"),
    "osm": lambda frame, folder: _osm(frame, folder / "f.osm", osm_files.write_xml),
    "pbf": lambda frame, folder: _osm(frame, folder / "f.osm.pbf", osm_files.write_pbf),
}


@pytest.mark.parametrize("name", list(WRITERS))
def test_formats_are_read_without_a_word(name: str, tmp_path: Path) -> None:
    frame = houses.footprints()
    path = WRITERS[name](frame, tmp_path)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert layer_info(path)["geometry_type"] is not None
        features = read_footprints(path, needs_crs=False, metric=MetricCrs(frame.crs, frame.crs))
    # the text of a geometry is no attribute
    assert not said and not {"WKT", "geometry"} & set(features.columns)
    names = features["building_id"].tolist()
    assert sorted(names) == (["1", "2"] if name in ("osm", "pbf") else ["flat", "gable"])
    shapes = features.geometry[np.argsort(names)] if len(names[0]) > 1 else features.geometry[::-1]
    expected = frame.set_index("id").geometry[["flat", "gable"]].to_numpy()
    assert (shapely.hausdorff_distance(shapely.force_2d(shapes), expected) < 0.05).all()


@pytest.mark.parametrize("name", ["f.gml", "f.xml"])
def test_columns_of_gml_are_its_own(tmp_path: Path, name: str) -> None:
    """GDAL keeps the columns of a GML without schema in a file beside it, and believes that of another, too."""
    frame = houses.footprints()
    path = _moved(WRITERS["gml"](frame, tmp_path), name)
    path.with_suffix(".xsd").unlink()
    other = _to_file(frame.drop(columns="id"), tmp_path / "other.gml", "GML")
    other.with_suffix(".xsd").unlink()
    pyogrio.list_layers(other)
    _moved(tmp_path / "other.gfs", "f.gfs")
    assert "id" in layer_info(path)["fields"] and "id" in describe(path)["layers"][0]["columns"]
    (tmp_path / "f.gfs").unlink()
    names = read_footprints(path, metric=MetricCrs(frame.crs, frame.crs))["building_id"]
    assert sorted(names) == ["flat", "gable"]
    assert not [*tmp_path.glob("*.gfs")]


# an extract of the BAG with a building
BAG = (
    "<sl-bag-extract:bagStand xmlns:Objecten='www.kadaster.nl/schemas/lvbag/imbag/objecten/v20200601'"
    " xmlns:gml='http://www.opengis.net/gml/3.2' xmlns:sl='http://www.kadaster.nl/schemas/standlevering-generiek/1.0'"
    " xmlns:sl-bag-extract='http://www.kadaster.nl/schemas/lvbag/extract-deelbestand-lvc/v20200601'><sl:standBestand><sl:inhoud>"
    "<sl:objectTypen><sl:objectType>PND</sl:objectType></sl:objectTypen></sl:inhoud><sl:stand><sl-bag-extract:bagObject>"
    "<Objecten:Pand><Objecten:identificatie>0106</Objecten:identificatie><Objecten:geometrie>"
    "<gml:Polygon srsName='urn:ogc:def:crs:EPSG::28992'><gml:exterior><gml:LinearRing>"
    "<gml:posList>9 0 20 0 20 9 9 9 9 0</gml:posList></gml:LinearRing></gml:exterior></gml:Polygon>"
    "</Objecten:geometrie></Objecten:Pand></sl-bag-extract:bagObject></sl:stand></sl:standBestand></sl-bag-extract:bagStand>"
)


def test_xml_of_the_dutch_cadastre_is_no_gml(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "bag.xml").write_text(BAG)
    (shape,) = read_vector(tmp_path / "bag.xml")[0].geometry
    assert shapely.area(shape) == 99 and not caplog.text


@pytest.mark.parametrize("name", ["osm", "pbf"])
def test_tags_of_a_file_of_openstreetmap_are_heights(name: str, tmp_path: Path) -> None:
    path = WRITERS[name](houses.footprints(), tmp_path)
    features = read_footprints(path, metric=MetricCrs(*[houses.footprints().crs] * 2))
    assert features["stated_height_m"].tolist() == [8.0, 6.0]


def test_what_an_editor_of_openstreetmap_has_not_uploaded_is_read(tmp_path: Path) -> None:
    path = WRITERS["osm"](houses.footprints(), tmp_path)
    path.write_text(re.sub(r'\b(id|ref)="', r'\1="-', path.read_text()))
    features = read_footprints(path, metric=MetricCrs(*[houses.footprints().crs] * 2))
    assert sorted(features["building_id"]) == ["-1", "-2"]


def test_rare_tags_in_one_column_are_heights_and_parts(tmp_path: Path) -> None:
    """As ogr2ogr writes areas of OpenStreetMap."""
    frame = houses.footprints().drop(columns="id")
    frame = pd.concat([frame, frame.iloc[:1].set_geometry([FOREST], crs=frame.crs)], ignore_index=True)
    frame["osm_id"], frame["osm_way_id"] = None, ["7", "8", "9"]
    frame["building"] = ["yes", None, None]
    frame["other_tags"] = [
        '"height"=>"8 m","note"=>"a ""b"""',
        '{"building:part":"yes","building:levels":"2"}',
        '"leaf_type"=>"mixed"',
    ]
    frame.to_file(tmp_path / "f.gpkg")
    features = read_footprints(tmp_path / "f.gpkg")
    assert dict(zip(features["building_id"], features["stated_height_m"], strict=True)) == {
        "7": 8.0,
        "8": 6.0,
    }


def test_files_that_cannot_be_read_say_what_to_do(tmp_path: Path) -> None:
    frame = houses.footprints()
    plain = pd.DataFrame(frame.drop(columns="geometry"))
    frame.to_feather(tmp_path / "f.feather")
    plain.to_csv(tmp_path / "f.csv", index=False)
    plain.to_parquet(tmp_path / "f.parquet")
    (tmp_path / "empty.gdb").mkdir()
    for name, words in {
        "f.feather": "not a readable vector file; save it as GeoPackage",
        "f.csv": "has no geometry; a table needs WKT in a column WKT, geometry, ",
        "f.parquet": "has no geometry; a Parquet file needs the metadata of GeoParquet",
        "empty.gdb": "not a readable vector file; save it as GeoPackage",
    }.items():
        with pytest.raises(InputError, match=words) as error:
            read_footprints(tmp_path / name)
        assert "\n" not in str(error.value) and name in str(error.value)


@pytest.mark.parametrize("stated", [None, "UTF-8", "ISO-8859-1"])
@pytest.mark.parametrize("written", ["UTF-8", "ISO-8859-1"])
def test_text_of_shapefiles_whatever_their_cpg(
    written: str, stated: str | None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, frame = tmp_path / "f.shp", houses.footprints()
    frame["id"] = ["Größe", "Ä1"]
    frame.to_file(path, encoding=written)
    path.with_suffix(".cpg").unlink()
    if stated is not None:
        path.with_suffix(".cpg").write_text(stated)
    assert layer_info(path)["fields"].tolist() == frame.columns[:-1].tolist()
    ids = read_footprints(path, id_field="id")["building_id"].tolist()
    assert (ids == frame["id"].tolist()) == ((written, stated) != ("UTF-8", "ISO-8859-1"))
    assert ("ISO-8859-1 is taken" in caplog.text) == ((written, stated) == ("ISO-8859-1", "UTF-8"))


def _packed(path: Path, files: dict[Path, str]) -> Path:
    with zipfile.ZipFile(path, "w") as packed:
        for file, name in files.items():
            packed.write(file, name)
    return path


@pytest.mark.parametrize("folder", ["", "delivery/Gebäude 2024/"])
@pytest.mark.parametrize("kind", ["shp", "gpkg", "gdb"])
def test_archives_are_read_as_portals_deliver_them(kind: str, folder: str, tmp_path: Path) -> None:
    frame = houses.footprints().assign(id=["Größe", "b"])
    frame.to_file(tmp_path / f"f.{kind}", **({"driver": "OpenFileGDB"} if kind == "gdb" else {}))
    (tmp_path / "f.cpg").unlink(missing_ok=True)
    (tmp_path / "__MACOSX").mkdir()
    (tmp_path / "__MACOSX" / f"._f.{kind}").write_bytes(b"\0\5")
    (tmp_path / "f.txt").write_text("a licence")
    files = [each for each in tmp_path.rglob("*") if each.is_file()]
    names = {file: str(file.relative_to(tmp_path)) for file in files}
    names = {file: name if name.startswith("__") else folder + name for file, name in names.items()}
    path = _packed(tmp_path / "f.ZIP", names)
    assert layer_info(path)["fields"].tolist() == ["id"]
    assert read_footprints(path, layer="f")["building_id"].tolist() == ["Größe", "b"]
    window = (*houses.PLACES["EPSG:2154"], 653_000.0, 6_863_000.0)
    assert read_footprints(path, bounds=window)["building_id"].tolist() == ["Größe", "b"]


@pytest.mark.parametrize("folder", ["", "x/", "{}/"])
def test_of_several_files_in_an_archive_one_is_to_be_named(folder: str, tmp_path: Path) -> None:
    for name in ("houses", "barns"):
        houses.footprints().assign(id=[name, "b"]).to_file(tmp_path / f"{name}.shp")
    files = {each: folder.format(each.stem) + each.name for each in tmp_path.glob("*.*")}
    path = _packed(tmp_path / "f.zip", files)
    with pytest.raises(InputError, match=r"state a layer with --layer, or unpack it: barns, houses"):
        read_footprints(path)
    assert read_footprints(path, layer="houses")["building_id"].tolist() == ["houses", "b"]
    with pytest.raises(InputError, match="unpack it"):
        read_footprints(_packed(tmp_path / "nothing.zip", {next(iter(files)): "a.txt"}))
    (tmp_path / "houses.csv.gz").write_bytes(gzip.compress(b"WKT\nPOINT (0 0)\n"))
    with pytest.raises(InputError, match="unpack it"):
        read_footprints(tmp_path / "houses.csv.gz")


@pytest.mark.parametrize("num_bytes", [0, 40])
def test_a_shapefile_without_its_table_is_told(
    num_bytes: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    houses.write_footprints(path := tmp_path / "f.shp")
    table = path.with_suffix(".dbf")
    table.write_bytes(table.read_bytes()[:num_bytes])
    if not num_bytes:
        table.unlink()
    assert read_footprints(path)["building_id"].tolist() == ["0", "1"]
    assert "f.shp: has no .dbf, or a damaged one" in caplog.text
    with pytest.raises(InputError, match="has no column id; its columns are none"):
        read_footprints(path, id_field="id")


@pytest.mark.parametrize("kind", ["GEOMETRY", "POLYHEDRALSURFACE"])
def test_layers_of_3d_geometries_say_what_to_do(kind: str, tmp_path: Path) -> None:
    """As databases and CityGML have them."""
    houses.write_footprints(path := tmp_path / "f.gpkg")
    with sqlite3.connect(path) as database:
        database.execute("UPDATE gpkg_geometry_columns SET geometry_type_name = ?, z = 1", (kind,))
    for read in (read_footprints, layer_info, describe):
        with pytest.raises(InputError, match="save it as GeoPackage with geometries MultiPolygon"):
            read(path)


@pytest.mark.parametrize("column", ["geom", "WKT"])
def test_extended_wkt_is_told_once(column: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """As PostGIS writes it: GDAL may warn of each feature, with a line of the code that warned."""
    frame = pd.DataFrame({"id": range(9), column: [f"SRID=2154;POINT({n} 0)" for n in range(9)]})
    frame.to_csv(path := tmp_path / "f.csv", index=False)
    words = r"has no geometry; a table needs WKT .*without SRID"
    with warnings.catch_warnings(record=True) as said, pytest.raises(InputError, match=words):
        read_footprints(path)
    assert not said and [each.getMessage() for each in caplog.records] == [
        f"warning: {path}: Ignoring invalid WKT: SRID=2154;POINT(0 0) (9 in all)"
    ] * (column == "WKT")


@pytest.mark.parametrize("version", ["0.1.0", "0.4.0"])
def test_geoparquet_before_version_1(version: str, tmp_path: Path) -> None:
    frame = gpd.GeoDataFrame({"id": ["a"]}, geometry=[shapely.box(0, 0, 9, 9)], crs=28992)
    frame.to_parquet(path := tmp_path / "f.parquet", schema_version=version)
    assert layer_info(path)["geometry_type"] == "Polygon" and len(read_vector(path)[0]) == 1


@pytest.mark.parametrize("kind", ["gpkg", "geojson", "parquet"])
def test_whole_numbers_and_truths_beside_missing_ones_stay_what_they_are(tmp_path: Path, kind: str) -> None:
    columns = {
        "floors": [2, None, 0],
        "is_listed": [True, None, False],
        "key": [2**53 + 1, -(2**53) - 1, None],
    }
    stored = {name: np.array(values, object) for name, values in columns.items()}
    features = Features(np.array([shapely.box(k, 0, k + 1, 1) for k in range(3)]), stored, LAMBERT)
    path = tmp_path / f"f.{kind}"
    frame = features.to_frame().convert_dtypes()
    if kind == "gpkg":
        gpkg.write(path, features, {})
    else:
        (frame.to_parquet if kind == "parquet" else frame.to_file)(path)
    read = read_vector(path)[0].columns
    assert {name: values.tolist() for name, values in read.items()} == columns
    assert [list(map(type, values.tolist())) for values in read.values()] == [
        list(map(type, values)) for values in columns.values()
    ]
    assert read_attributes(path, ("key",))[0]["key"].tolist() == columns["key"]


def test_columns_of_lists_are_read(tmp_path: Path) -> None:
    """As those of GeoJSON and GML, whose types numpy does not know."""
    properties = [{"id": 1, "uses": ["barn", "house"], "floors": [2, 3]}, {"id": None, "uses": None}]
    square = shapely.geometry.mapping(shapely.box(0, 0, 1, 1))
    features = [{"type": "Feature", "properties": each, "geometry": square} for each in properties]
    path = tmp_path / "f.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    columns = read_vector(path)[0].columns
    assert columns["uses"][0].tolist() == ["barn", "house"] and columns["uses"][1] is None
    assert columns["floors"][0].tolist() == [2, 3] and columns["id"].tolist() == [1, None]


def test_a_file_without_layers_is_said_to_have_none(tmp_path: Path) -> None:
    path = tmp_path / "a.gml"
    path.write_text('<gml:FeatureCollection xmlns:gml="http://www.opengis.net/gml"></gml:FeatureCollection>')
    with pytest.raises(InputError, match=r"a\.gml: has no layers$"):
        read_vector(path)
