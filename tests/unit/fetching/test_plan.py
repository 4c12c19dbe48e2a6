"""Estimates for a region, the file of a new region, and the download of a whole region."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import pytest
import requests
import yaml
from places import ROOT
from pytest_httpserver import HTTPServer
from werkzeug import Response

from p2wss.cli import main
from p2wss.config import load
from p2wss.fetching.plan import download, estimate_downloads, format_estimates, region_yaml
from p2wss.storage import integrity
from p2wss.storage.messages import InputError

from .service import building, laz, serve_features, serve_terrain, tile_feature

REGIONS = sorted((ROOT / "config" / "regions").glob("*.yaml"))


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> None:
        pytest.fail("a request was sent")

    monkeypatch.setattr(requests.Session, "send", refuse)


@pytest.mark.parametrize("path", REGIONS, ids=lambda path: path.stem)
def test_a_dry_run_of_every_region_sends_no_request_and_writes_no_file(
    path: Path, no_network: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    (tmp_path / "config" / "regions").mkdir(parents=True)
    (tmp_path / "config" / "regions" / path.name).write_text(path.read_text(encoding="utf-8"))
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    assert main(["fetch", "--region", path.stem, "--dry-run"]) == 0
    shown = capsys.readouterr().out
    region = load(path).region
    x_min, y_min, x_max, y_max = region.bounds_m
    num_tiles = round((x_max - x_min) * (y_max - y_min) / 1e6)
    assert f"region {path.stem}: {num_tiles} tiles of 1000 m" in shown
    (terrain,) = (line.split() for line in shown.splitlines() if line.startswith("terrain"))
    # 1201 x 1201 cells of 4 bytes per tile, one request per second
    assert terrain[1:3] == [str(num_tiles), str(num_tiles)]
    assert float(terrain[3]) == pytest.approx(num_tiles * 1201**2 * 4 / 1e6, abs=0.5)
    assert int(terrain[4]) == num_tiles
    (lidar,) = (line.split() for line in shown.splitlines() if line.startswith("LiDAR"))
    assert int(lidar[1]) == len(region.lidar_tiles)
    assert sorted(tmp_path.rglob("*")) == before


def test_seconds_follow_the_request_rate(no_network: None) -> None:
    config = load(REGIONS[0], {"fetch": {"geoplateforme": {"requests_per_s": 0.5}}})
    estimates = estimate_downloads(config)
    lines = format_estimates(config, estimates).splitlines()
    (line,) = (line for line in lines if line.startswith("total"))
    assert float(line.split()[3]) == 2 * sum(estimate.num_requests for estimate in estimates)


def test_files_on_disk_need_no_download() -> None:
    assert estimate_downloads(load()) == []
    assert "nothing to download" in format_estimates(load(), [])


def test_a_new_region_is_rounded_to_whole_tiles(tmp_path: Path) -> None:
    text = region_yaml("old-town", [652100.5, 6861200, 653000, 6861999], "2026", "EPSG:2154", ["0652_6862"])
    region = load(yaml.safe_load(text)).region
    assert region.bounds_m == (652000, 6861000, 653000, 6862000)
    assert (region.name, region.tiles, region.lidar_tiles) == ("old-town", [], ["0652_6862"])
    with pytest.raises(InputError, match=r"region\.name"):
        region_yaml("no good", [0, 0, 1, 1], "", "EPSG:2154", [])
    with pytest.raises(InputError, match=r"bounds_m must be x_min, y_min, x_max, y_max"):
        region_yaml("x", [653000, 6861000, 652000, 6862000], "", "EPSG:2154", [])


def test_a_download_of_a_region_is_complete_and_not_repeated(httpserver: HTTPServer, tmp_path: Path) -> None:
    features = [building(i) for i in range(30)]
    tile = tile_feature(652, 6862, url_npl=httpserver.url_for("/t.laz"))
    cloud = laz(tmp_path)

    def features_of(request: Any) -> Response:
        return serve_features(features if "batiment" in request.args["TYPENAMES"] else [tile])(request)

    httpserver.expect_request("/wfs/ows").respond_with_handler(features_of)
    httpserver.expect_request("/wms-r").respond_with_handler(serve_terrain)
    httpserver.expect_request("/t.laz").respond_with_data(cloud)
    text = region_yaml("x", [652000, 6861000, 653000, 6862000], "2026", "EPSG:2154", ["0652_6862"])
    service = {
        "wfs_url": httpserver.url_for("/wfs/ows"),
        "wms_url": httpserver.url_for("/wms-r"),
        "requests_per_s": 1e6,
        "page_size": 20,
    }
    config = load(yaml.safe_load(text), {"fetch": {"geoplateforme": service}})
    downloads = tmp_path / "downloads"
    assert [estimate.num_files for estimate in estimate_downloads(config)] == [1, 1, 1]
    download(config, downloads, logging.getLogger())
    assert len(httpserver.log) == 2 + 1 + 2

    # the commands of the workflow find everything in the downloads
    sections = json.dumps(
        {"region": config.region.model_dump(mode="json"), "fetch": config.fetch.model_dump(mode="json")}
    )
    for part, name in [("footprints", "f.gpkg"), ("dtm", "0652_6862.tif"), ("lidar", "0652_6862.laz")]:
        tile_name = [] if part == "footprints" else ["--tile", "0652_6862"]
        out = [
            "--out",
            str(tmp_path / name),
            "--downloads",
            str(downloads),
            "--config",
            sections,
        ]
        assert main(["fetch", part, *tile_name, *out]) == 0
    assert len(httpserver.log) == 5
    assert (tmp_path / "0652_6862.laz").read_bytes()[: -len(integrity.TRAILER)] == cloud


def test_an_existing_region_is_not_overwritten(
    no_network: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    (tmp_path / "config" / "regions").mkdir(parents=True)
    path = tmp_path / "config" / "regions" / "x.yaml"
    path.write_text("region: {name: x}\n")
    monkeypatch.chdir(tmp_path)
    bbox = ["--bbox", "652000", "6861000", "653000", "6862000"]
    assert main(["fetch", "--region", "x", *bbox]) == 2
    assert "already exists; choose another name" in capsys.readouterr().err
    assert path.read_text() == "region: {name: x}\n"
    for tile in ("paris", "0653_6862"):
        assert main(["fetch", "--region", "y", *bbox, "--lidar", f"0652_6862,{tile}"]) == 2
        assert f"--lidar: not a tile of the region: {tile}\n" in capsys.readouterr().err
    assert main(["fetch", "--dry-run"]) == 2 and "give --region NAME" in capsys.readouterr().err
