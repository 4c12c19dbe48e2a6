"""``p2wss reconstruct`` with footprints that lie beside the cloud."""

from __future__ import annotations

import shutil
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pyogrio
import pyproj
import pytest
import shapely
from shapely import affinity

from p2wss import cli
from p2wss.reconstruction import area

# two houses that share a wall, on the line between two tiles, and a house by itself
TRUE = [
    shapely.box(652992, 6861100, 653000.5, 6861109),
    shapely.box(653000.5, 6861100, 653009, 6861109),
    shapely.box(653030, 6861100, 653040, 6861112),
]
SHIFT = (1.1, -0.8)


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """cloud.laz (Lambert-93) and footprints.gpkg, moved by ``SHIFT``."""
    draw = np.random.default_rng(0)
    roof = shapely.union_all(TRUE).buffer(0.3, join_style="mitre")
    x, y = draw.uniform(652980, 653052, 16000), draw.uniform(6861088, 6861124, 16000)
    on_roof = shapely.contains_xy(roof, x, y)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.01), np.array([652000, 6861000, 0])
    header.add_crs(pyproj.CRS.from_epsg(2154))
    las = laspy.LasData(header)
    las.x, las.y, las.z = x, y, np.where(on_roof, 107.0, 101.0)
    las.classification = np.where(on_roof, 6, 2).astype(np.uint8)
    las.write(tmp_path / "cloud.laz")
    moved = [affinity.translate(shape, *SHIFT) for shape in TRUE]
    gpd.GeoDataFrame({"cleabs": ["A", "B", "C"]}, geometry=moved, crs=2154).to_file(
        tmp_path / "footprints.gpkg"
    )
    return tmp_path


def reconstructed(
    place: Path, *options: str, stem: str = "cloud", cloud: str = "cloud.laz"
) -> gpd.GeoDataFrame:
    files = [str(place / name) for name in (cloud, "footprints.gpkg", "out")]
    options = ("--model", "none", "--format", "gpkg,geoparquet,cityjsonseq,report", *options)
    assert cli.main(["reconstruct", *files, *options]) == 0
    return gpd.read_file(place / "out" / f"{stem}.gpkg", layer="buildings").set_index("building_id")


def test_moved_by_default_and_kept_beside(place: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("DEBUG"):
        rows = reconstructed(place, "--verbose")
    assert "registration: 3 of 3 footprints moved, 1." in caplog.text
    for name, row in rows.iterrows():
        shift = f"footprint moved by {row['shift_x_m']:+.2f}, {row['shift_y_m']:+.2f} m"
        assert len([each for each in caplog.messages if each.startswith(f"{name}: ") and shift in each]) == 1
    for shape, true in zip(rows.geometry, TRUE, strict=True):
        assert shapely.hausdorff_distance(shape, true) < 0.1
    assert rows["shift_x_m"].to_numpy() == pytest.approx(-SHIFT[0], abs=0.1)
    assert rows["overhang_m"].to_numpy() == pytest.approx(0.3, abs=0.1)
    assert rows.loc["A", "shift_y_m"] == rows.loc["B", "shift_y_m"]
    before = gpd.read_file(place / "out" / "cloud.gpkg", layer="input_footprints")
    given = gpd.read_file(place / "footprints.gpkg")
    assert (before.geometry.hausdorff_distance(given.geometry) < 1e-6).all()
    with_columns = gpd.read_parquet(place / "out" / "cloud.parquet")
    assert (with_columns["input_geometry"].hausdorff_distance(before.geometry) < 1e-6).all()
    page = (place / "out" / "cloud.html").read_text()
    assert "3 of 3 footprints moved" in page
    assert f'"shift_x_m":{rows.loc["A", "shift_x_m"]:g}' in page
    assert '"shift_sd_m"' in (place / "out" / "cloud.city.jsonl").read_text()


def test_off_leaves_footprints_where_they_are(place: Path) -> None:
    # walls that do not move to where the roofs begin either
    off = '{"reconstruct": {"registration": "never", "max_wall_shift_m": 0}}'
    on = '{"reconstruct": {"max_wall_shift_m": 0}}'
    for options in (["--registration", "never", "--config", on], ["--config", off]):
        rows = reconstructed(place, *options)
        for shape, true in zip(rows.geometry, TRUE, strict=True):
            assert shapely.hausdorff_distance(shape, affinity.translate(true, *SHIFT)) < 1e-6
        assert rows["shift_x_m"].isna().all()
        page = (place / "out" / "cloud.html").read_text()
        assert "registration: off" in page and "marker-end" not in page
        assert pyogrio.list_layers(place / "out" / "cloud.gpkg")[:, 0].tolist() == [
            "buildings",
            "layer_styles",
        ]


def test_a_tile_gives_the_same_as_the_whole(place: Path) -> None:
    whole = reconstructed(place)
    west = reconstructed(place, "--tile", "0652_6862", stem="0652_6862")
    east = reconstructed(place, "--tile", "0653_6862", stem="0653_6862")
    assert west.index.tolist() == ["A"] and east.index.tolist() == ["B", "C"]
    for part in (west, east):
        expected = whole.loc[part.index]
        assert part.geometry.geom_equals_exact(expected.geometry, 0).all()
        assert part.drop(columns="geometry").equals(expected.drop(columns="geometry"))
        assert part["party_wall_area_m2"].max() > 40


def test_points_of_overlapping_files_count_once_in_a_tile_as_in_the_whole(place: Path) -> None:
    alone = reconstructed(place)
    las = laspy.read(place / "cloud.laz")
    (place / "tiles").mkdir()
    for name, inside in (("a", las.x < 653015), ("b", las.x > 652985)):
        part = laspy.LasData(las.header, las.points[inside])
        part.write(place / "tiles" / f"{name}.laz")
    whole = reconstructed(place, stem="tiles", cloud="tiles")
    west = reconstructed(place, "--tile", "0652_6862", stem="0652_6862", cloud="tiles")
    east = reconstructed(place, "--tile", "0653_6862", stem="0653_6862", cloud="tiles")
    assert whole["num_points"].equals(alone["num_points"]) and len(west) == 1 and len(east) == 2
    for part in (west, east):
        assert part.to_wkt().equals(whole.loc[part.index].to_wkt())


def test_batches_and_threads_change_no_byte(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of any file, as the GeoPackage, the page and the meshes of all buildings are written from stored results."""
    options = ("--format", "gpkg,geoparquet,cityjson,cityjsonseq,glb,ply,report", "--skin")
    contents = []
    for threads, limit in ((1, None), (1, 1), (2, 1), (2, None)):
        if limit is not None:
            monkeypatch.setattr(area, "MAX_FOOTPRINTS", limit)
        reconstructed(place, "--threads", str(threads), *options)
        contents.append({path.name: path.read_bytes() for path in (place / "out").iterdir()})
        shutil.rmtree(place / "out")
        monkeypatch.undo()
    assert {"cloud.gpkg", "cloud.city.json", "cloud.glb", "cloud.html"} < contents[0].keys()
    for other in contents[1:]:
        assert other.keys() == contents[0].keys()
        assert [name for name in other if other[name] != contents[0][name]] == []


def test_a_failure_leaves_no_temporary_file(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    before = sorted(path.name for path in place.rglob("*"))
    monkeypatch.setattr(area.Rows, "finish", fail)
    assert (
        cli.main(["reconstruct", *(str(place / name) for name in ("cloud.laz", "footprints.gpkg", "out"))])
        == 130
    )
    assert sorted(path.name for path in place.rglob("*")) == before
