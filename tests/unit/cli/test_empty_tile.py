"""A tile without buildings, which ``region.tiles: [all]`` plans too: every stage writes a file without rows. And one
whose footprints are not all buildings: those that are left out are counted."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import geopandas as gpd
import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely

from p2wss.cli import main
from p2wss.data.terrain import Terrain, write_terrain

TILE, NEIGHBOUR, SIZE_M = "0652000_6862000", "0652200_6862000", 100
REGION = {"crs": "EPSG:2154", "tile_size_m": SIZE_M}
SECTIONS = {
    "region": REGION,
    "scenes": {"margin_m": 20, "max_failed_fraction": 1},
    "scans": {"density_per_m2": 5},
    "crops": {"split": "test", "guard_m": 2},
    "eval": {"num_samples": 64},
}


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def call(*words: object) -> None:
        config = json.dumps(SECTIONS)
        assert main([*map(str, words), "--config", config]) == 0, words

    houses = shapely.box([652220, 652240, 652260], 6861940, [652230, 652252, 652270], 6861952)
    frame = gpd.GeoDataFrame(
        {"building_id": ["a", "b", "c"], "hauteur_m": 6.0}, geometry=houses, crs="EPSG:2154"
    )
    frame.to_file("footprints.gpkg", driver="GPKG")
    flat = Terrain(np.full((240, 400), 40, np.float32), 651900, 6862100, 1.0)
    write_terrain(Path("dtm.tif"), flat, "EPSG:2154", {})
    return call


def simulate(run, tile: str) -> None:
    run(
        *("scenes", "cut", "--tile", tile, "--footprints", "footprints.gpkg", "--dtm", "dtm.tif"),
        *("--out", f"{tile}.scene.parquet", "--out-dtm", f"{tile}.tif"),
    )
    run("buildings", "--scene", f"{tile}.scene.parquet", "--out", f"{tile}.buildings.parquet")
    run(
        *("scans", "--scene", f"{tile}.scene.parquet", "--dtm", f"{tile}.tif"),
        *("--buildings", f"{tile}.buildings.parquet", "--out", f"{tile}.laz"),
        *("--out-survey", f"{tile}.json", "--picture", f"{tile}.png"),
    )
    simulated = ["--buildings", f"{tile}.buildings.parquet", "--scan", f"{tile}.laz"]
    run("crops", "simulated", *simulated, "--out", f"{tile}.simulated.parquet")
    real = ["--tile", tile, "--footprints", "footprints.gpkg", "--clouds", f"{tile}.laz"]
    run("crops", "real", *real, "--out", f"{tile}.real.parquet")


def rows(name: str) -> int:
    return pq.read_metadata(name).num_rows


def test_a_tile_without_buildings_goes_through_all_stages(run, monkeypatch):
    for tile in (TILE, NEIGHBOUR):
        simulate(run, tile)
    counts = [rows(f"{tile}.{name}.parquet") for tile in (TILE, NEIGHBOUR) for name in ("simulated", "real")]
    assert counts == [0, 0, 3, 3]
    assert rows(f"{TILE}.scene.parquet") == rows(f"{TILE}.buildings.parquet") == 0
    shards = {
        name: [f"{tile}.{name}.parquet" for tile in (TILE, NEIGHBOUR)] for name in ("simulated", "real")
    }
    run(
        "crops", "manifest", "--simulated", *shards["simulated"], "--real", *shards["real"], "--out", "m.json"
    )
    assert json.loads(Path("m.json").read_text(encoding="utf-8"))["num_rows"] == 6

    def evaluate(tile: str) -> None:
        group = ["--manifest", "m.json", "--shards", f"{tile}.simulated.parquet", f"{tile}.real.parquet"]
        methods = ("lod1", "constant", "fit")
        for name in methods:
            run("eval", "reconstruct", "--method", name, *group, "--out", f"{tile}/{name}.parquet")
        written = [f"{tile}/{name}.parquet" for name in methods]
        run("eval", "measure", *group, "--reconstructions", *written, "--out", f"{tile}/measures.parquet")

    # nor do the methods without a network import it
    monkeypatch.setitem(sys.modules, "torch", None)
    for tile in (TILE, NEIGHBOUR):
        evaluate(tile)
    assert rows(f"{TILE}/measures.parquet") == 0 and rows(f"{NEIGHBOUR}/measures.parquet") == 18
    run(
        *("reconstruct", f"{TILE}.laz", "footprints.gpkg", "out", "--tile", TILE, "--model", "none"),
        *("--format", "cityjsonseq,cityjson,glb,obj,ply,stl,gpkg,geoparquet"),
    )
    summary = json.loads(Path(f"out/{TILE}.json").read_text(encoding="utf-8"))
    assert summary["buildings"]["total"] == 0


def test_every_building_that_is_left_out_is_in_the_manifest_with_its_reason(run):
    star = np.random.default_rng(0).uniform((652205, 6861960), (652295, 6861990), (600, 2))
    odd = {
        "not-a-polygon": shapely.LineString([(652210, 6861910), (652220, 6861915)]),
        "too-small": shapely.box(652210, 6861920, 652211, 6861921),
        "empty": shapely.Polygon([(652230, 6861920), (652240, 6861920), (652235, 6861920)]),
        "implausible-size": shapely.box(652250, 6858950, 652251, 6864950),
        "too-many-crossings": shapely.Polygon(star),
    }
    frame = gpd.GeoDataFrame(
        {"building_id": list(odd), "hauteur_m": 6.0}, geometry=list(odd.values()), crs="EPSG:2154"
    )
    frame.to_file("footprints.gpkg", driver="GPKG", mode="a")
    simulate(run, NEIGHBOUR)
    simulated, real = f"{NEIGHBOUR}.simulated.parquet", f"{NEIGHBOUR}.real.parquet"
    run("crops", "manifest", "--simulated", simulated, "--real", real, "--out", "m.json")
    for shard in json.loads(Path("m.json").read_text(encoding="utf-8"))["shards"]:
        assert shard["num_rows"] == 3 and shard["num_excluded"] == dict.fromkeys(odd, 1), shard["dataset"]
