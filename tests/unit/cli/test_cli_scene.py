"""``p2wss scene``: from a place to a scene, with the files of the miniature on a local server in place of IGN's."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import pyproj
import pytest
import requests
import trimesh
from fetching.service import serve_miniature
from pytest_httpserver import HTTPServer

from p2wss.cli import main
from p2wss.fetching.area import bounds_around, bounds_of_bbox
from p2wss.storage.messages import InputError

# 40 m around a middle in metres; its corner is in degrees, too
MIDDLE = (653150.0, 6860760.0)
FRANCE = "EPSG:2154"


def scene(config: dict[str, object], *words: object) -> int:
    return main(["scene", *map(str, words), "--config", json.dumps({"fetch": config}), "--threads", "1"])


def test_a_place_becomes_a_scene_and_nothing_is_fetched_twice(
    httpserver: HTTPServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = serve_miniature(httpserver)
    words = ["--around", "{:.0f} {:.0f}".format(*MIDDLE), "--radius", "30", tmp_path]
    assert scene(config, *words, "--dry-run") == 0
    (estimate,) = (row.split() for row in capsys.readouterr().out.splitlines() if row[:5] == "LiDAR")
    assert estimate[:2] == ["LiDAR", "1"]
    assert not httpserver.log and not list(tmp_path.iterdir())
    assert scene(config, *words) == 0
    num_requests = len(httpserver.log)
    # pages of footprints and of the index of tiles, terrain, tile
    assert num_requests == 4
    names = {"scene.city.json", "scene.glb", "scene.html", "scene.json", "scene_sionna", "data"}
    assert {path.name for path in tmp_path.iterdir()} == names
    ids = set(json.loads((tmp_path / "scene.city.json").read_text())["CityObjects"])
    assert len(ids) > 4
    shapes = ElementTree.parse(tmp_path / "scene_sionna" / "scene.xml").getroot().findall("shape")
    assert {"mesh-terrain"} < {shape.get("id") for shape in shapes}
    assert len(shapes) - 1 < len(ids)  # blocks
    assert (tmp_path / "scene_sionna" / "terrain_top.ply").exists()
    assert "terrain" in trimesh.load_scene(tmp_path / "scene.glb").geometry

    before = (tmp_path / "scene.city.json").read_bytes()
    west, south = (value - 30 for value in MIDDLE)
    assert scene(config, "--bbox", west, south, west + 60, south + 60, tmp_path, "--format", "cityjson") == 0
    assert len(httpserver.log) == num_requests
    assert (tmp_path / "scene.city.json").read_bytes() == before


def test_after_an_interruption_only_the_rest_is_fetched(
    httpserver: HTTPServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tries: list[int] = []
    config = serve_miniature(httpserver, lambda: bool(tries))
    words = ["--around", *map(str, MIDDLE), "--radius", "20", tmp_path, "--format", "obj", "--quiet"]
    assert scene(config, *words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("p2wss: error: ") and ": HTTP 403 " in line
    assert not list(tmp_path.glob("scene*")) and not list(tmp_path.rglob("*.laz"))
    num_requests = len(httpserver.log)
    tries.append(1)
    assert scene(config, *words) == 0
    assert [request.path[-4:] for request, _ in httpserver.log[num_requests:]] == [".laz"]
    assert (tmp_path / "scene.obj").exists()


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object, **kwargs: object) -> None:
        reason = "Failed to resolve 'data.geopf.fr' ([Errno -2] Name or service not known)"
        raise requests.exceptions.ConnectionError(reason)

    monkeypatch.setattr(requests.Session, "send", refuse)


def test_without_network_one_line_names_the_files_to_give(
    no_network: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert scene({}, "--around", "48.85 2.35", tmp_path / "out") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "no network" in line
    assert all(f"fetch.folder.{name}" in line for name in ("footprints", "dtm", "lidar"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "name a place: --bbox or --around"),
        (["--around", "48.85 2.35", "--bbox", "0", "0", "1", "1"], "name a place: --bbox or --around"),
        (["--around", "Paris", "out"], "'Paris' is not a valid float"),
        (["--around", "2.35 48.85"], "degrees (longitude, latitude) outside France"),
        (["--around", "52.0", "4.36"], "IGN's services are of France: elsewhere use p2wss reconstruct"),
        (["--bbox", "48.85", "2.35", "48.86", "2.36"], "degrees (longitude, latitude) outside France"),
        (["--bbox", "653000", "6861000", "652000", "6862000"], "is empty"),
        (["--bbox", "0", "0", "1000", "1000"], "metres outside France"),
        (["--around", "0 1000"], "metres outside France"),
    ],
)
def test_a_place_that_cannot_be_meant_is_refused(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert scene({}, *words, tmp_path) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_degrees_and_metres_are_told_apart() -> None:
    to_degrees = pyproj.Transformer.from_crs(FRANCE, 4326, always_xy=True)
    longitude, latitude = to_degrees.transform(*MIDDLE)
    in_metres = bounds_around(MIDDLE, 100, FRANCE)
    assert in_metres == (653050, 6860660, 653250, 6860860)
    assert bounds_around((latitude, longitude), 100, FRANCE) == pytest.approx(in_metres, abs=0.01)
    corners = *to_degrees.transform(*in_metres[:2]), *to_degrees.transform(*in_metres[2:])
    # the box in degrees is turned against the grid by the convergence of meridians
    assert bounds_of_bbox(corners, FRANCE) == pytest.approx(in_metres, abs=3)
    with pytest.raises(InputError, match="outside"):
        bounds_around((longitude, latitude), 100, FRANCE)
