"""Files are complete or absent, and hold their provenance."""

import errno
import io
import os

import geopandas as gpd
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely

from p2wss.fetching.folder import read_footprint_window
from p2wss.footprints.vector_files import read_attributes, read_vector
from p2wss.storage import files
from p2wss.storage.messages import InputError
from p2wss.storage.schemas.columns import field
from p2wss.storage.schemas.scene import read_scene, write_scene

SCHEMA = pa.schema([field("a", pa.int32(), "a number"), field("b", pa.list_(pa.float64()), "numbers", True)])
COLUMNS = {"a": [1, 2, 3], "b": [[1.0, 2.0], [], None]}


def test_table_and_metadata_survive_a_round_trip(tmp_path):
    path = tmp_path / "folder" / "t.parquet"
    files.write_table(path, COLUMNS, SCHEMA, {"crs": "EPSG:2154"})
    assert files.read_table(path, SCHEMA).to_pydict() == COLUMNS
    assert files.read_metadata(path) == {"crs": "EPSG:2154"}
    assert pq.read_schema(path).field("a").metadata == {b"about": b"a number"}


def test_list_columns_survive_a_round_trip():
    values, offsets = files.list_column(pa.table({"b": COLUMNS["b"]}), "b")
    assert values.tolist() == [1, 2] and offsets.tolist() == [0, 2, 2, 2]
    assert files.ragged(values, offsets).to_pylist() == [[1, 2], [], []]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "no such file"),
        (lambda path: path.write_bytes(b"PAR1 and nothing more"), "not a readable Parquet file"),
        (lambda path: pq.write_table(pa.table({"a": [1]}), path), "has no columns b;"),
    ],
)
def test_an_unreadable_file_is_an_error_of_one_line_with_the_path(tmp_path, make, message):
    path = tmp_path / "t.parquet"
    make(path)
    with pytest.raises(InputError) as error:
        files.read_table(path, SCHEMA)
    assert str(path) in str(error.value) and message in str(error.value) and "\n" not in str(error.value)


def test_a_failed_write_leaves_only_the_old_file(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), files.atomic(path) as temporary:
        temporary.write_text("half of the new")
        _ = 1 / 0
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["t.txt"]


def test_a_full_disk_is_an_error_of_one_line_with_the_path(tmp_path):
    path = tmp_path / "t.city.jsonl"
    with pytest.raises(InputError, match="not written: No space left"), files.atomic(path) as temporary:
        assert temporary.suffixes == [".city", ".jsonl"] and temporary.parent == path.parent
        temporary.write_text("half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert os.listdir(tmp_path) == []


def test_a_really_full_disk(tmp_path):
    """/dev/full refuses every byte, like a full disk."""
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full on this system")
    path = tmp_path / "t.parquet"
    with pytest.raises(InputError, match="not written"), files.atomic(path) as temporary:
        temporary.unlink()
        temporary.symlink_to("/dev/full")
        pq.write_table(pa.table({"a": np.arange(100_000)}), temporary)
    assert os.listdir(tmp_path) == []


def test_a_scene_has_the_metadata_of_p2wss_and_of_geoparquet(tmp_path):
    scene = gpd.GeoDataFrame(
        {
            "building_id": ["A"],
            "tile": ["0652_6862"],
            "in_tile": [True],
            "status": ["ok"],
            "eave_height_m": np.array([5], np.float32),
            "eave_height_source": ["hauteur"],
            "terrain_z_m": [40.0],
            "base_z_m": [39.0],
            "roof_type": ["gable"],
            "angle_deg": [[0.0, 90.0, 30.0]],
        },
        geometry=[shapely.Polygon([(0, 0), (1, 0), (0, 1)])],
        crs="EPSG:2154",
    )
    path = tmp_path / "s.parquet"
    write_scene(path, scene, {"tile": "0652_6862"})
    back, metadata = read_scene(path)
    assert metadata == {"tile": "0652_6862"} and back.crs == "EPSG:2154"
    assert back.geometry.iloc[0].equals(scene.geometry.iloc[0]) and list(back["angle_deg"].iloc[0]) == [
        0,
        90,
        30,
    ]


def test_arrow_reads_no_file_of_python(tmp_path, monkeypatch):
    """Its threads may let go of one when Python ends already, which aborts the process after all is done."""
    sources = []

    def seen(function, place):
        def called(*args, **options):
            sources.append(args[place])
            return function(*args, **options)

        return called

    monkeypatch.setattr(pq.ParquetFile, "__init__", seen(pq.ParquetFile.__init__, 1))
    monkeypatch.setattr(pq.ParquetDataset, "__init__", seen(pq.ParquetDataset.__init__, 1))
    monkeypatch.setattr(pq, "read_table", seen(pq.read_table, 0))
    path, box = tmp_path / "a.parquet", shapely.box(0, 0, 9, 9)
    frame = gpd.GeoDataFrame({"id": ["a"]}, geometry=[box], crs="EPSG:2154")
    for use in (
        lambda: files.write_geoparquet(path, frame, {}),
        lambda: read_vector(path),
        lambda: read_attributes(path, ("id",)),
        lambda: read_footprint_window(path, "", box.bounds, "EPSG:2154"),
    ):
        sources.clear()
        use()
        assert sources and not any(isinstance(each, io.BytesIO | io.BufferedReader) for each in sources)
