"""One setting for the classes of clouds, ``region.classes``: of crops, reconstructions and outlines."""

from __future__ import annotations

import json
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import pyproj
import pytest
import shapely

from p2wss import cli
from p2wss.fetching.bdtopo import normalise, write_footprints
from p2wss.storage import files
from p2wss.storage.schemas.crops import CROPS

HOUSE = shapely.box(652100, 6861100, 652110, 6861112)
TILE = "0652_6862"
# numbers of a producer: buildings, ground, and a class of artefacts far above both; 6 and 2 are something else here
BUILDING, GROUND, ARTEFACT = 20, 8, 77
CUSTOM = {"preset": "custom", "building": [BUILDING], "ground": [GROUND], "ignored": [ARTEFACT]}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """cloud.laz and footprints.gpkg of a flat house of 7 m."""
    folder = tmp_path_factory.mktemp("classes")
    draw = np.random.default_rng(0)
    x, y = draw.uniform(652085, 652125, 9000), draw.uniform(6861085, 6861127, 9000)
    inside = shapely.contains_xy(HOUSE, x, y)
    z, classes = np.where(inside, 107.0, 100.0), np.where(inside, BUILDING, GROUND).astype(np.uint8)
    z[::50], classes[::50] = 130.0, ARTEFACT
    z[1::50], classes[1::50] = 104.0, np.where(inside[1::50], 2, 6)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.01), np.array([652000, 6861000, 0])
    header.add_crs(pyproj.CRS.from_epsg(2154))
    las = laspy.LasData(header)
    las.x, las.y, las.z, las.classification = x, y, z, classes
    las.write(folder / "cloud.laz")
    features = gpd.GeoDataFrame({"cleabs": ["H"], "hauteur": [7.0]}, geometry=[HOUSE], crs=2154)
    write_footprints(folder / "footprints.gpkg", normalise(features, "EPSG:2154", "test"), {})
    return folder


def config(classes: dict[str, object]) -> str:
    return json.dumps({"region": {"classes": classes}})


def test_crops_and_reconstruct_read_the_same_classes(place: Path, tmp_path: Path) -> None:
    clouds, footprints = str(place / "cloud.laz"), str(place / "footprints.gpkg")
    las = laspy.read(clouds)
    expected = int((las.classification == BUILDING).sum())
    options = ["--tile", TILE, "--footprints", footprints, "--clouds", clouds]
    out = tmp_path / "crops.parquet"
    assert cli.main(["crops", "real", *options, "--out", str(out), "--config", config(CUSTOM)]) == 0
    row = files.read_table(out, CROPS).to_pylist()[0]
    assert row["num_roof_points"] == expected
    assert set(row["classification"]) == {1, 2, 6} and max(row["z_cm"]) <= 701
    # of the classes of LAS the same points are something else
    assert (
        cli.main(["crops", "real", *options, "--out", str(out), "--config", config({"preset": "las"})]) == 0
    )
    row = files.read_table(out, CROPS).to_pylist()[0]
    assert row["num_roof_points"] > expected and max(row["z_cm"]) > 2000
    result = str(tmp_path / "out")
    options = [clouds, footprints, result, "--model", "none", "--format", "gpkg", "--config", config(CUSTOM)]
    assert cli.main(["reconstruct", *options]) == 0
    building = gpd.read_file(tmp_path / "out" / "cloud.gpkg", layer="buildings").iloc[0]
    assert building["eave_height_m"] == pytest.approx(7, abs=0.02)
    assert building["ground_z_m"] == pytest.approx(100, abs=0.02)
    stated = json.loads((tmp_path / "out" / "cloud.json").read_text())["p2wss"]["config"]
    assert json.loads(stated)["region"] == {"classes": CUSTOM}
    outlines = tmp_path / "outlines.gpkg"
    assert cli.main(["outlines", clouds, str(outlines), "--config", config(CUSTOM)]) == 0
    assert gpd.read_file(outlines).area.sum() == pytest.approx(120, rel=0.1)
