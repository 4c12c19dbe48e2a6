"""``p2wss outlines`` and ``p2wss reconstruct --no-footprints``."""

from __future__ import annotations

import json
from pathlib import Path

import geopandas as gpd
import pytest

from p2wss.cli import main


def test_outlines_of_a_cloud(place: Path) -> None:
    out = place / "outlines.gpkg"
    assert main(["outlines", str(place / "cloud.laz"), str(out)]) == 0
    frame, truth = gpd.read_file(out), gpd.read_file(place / "footprints.gpkg")
    assert frame.crs.to_epsg() == 2154
    assert frame["building_id"].tolist() == ["1"]
    outline, footprint = frame.geometry.iloc[0], truth.geometry.iloc[0]
    assert outline.intersection(footprint).area / outline.union(footprint).area >= 0.9


@pytest.mark.parametrize("where", ["end", "middle"])
def test_reconstruct_without_footprints(place: Path, where: str) -> None:
    arguments = ["reconstruct", str(place / "cloud.laz"), str(place / "out"), "--model", "none"]
    arguments.insert(len(arguments) if where == "end" else 2, "--no-footprints")
    assert main(arguments) == 0
    lines = (place / "out" / "cloud.city.jsonl").read_text().splitlines()
    objects = [value for line in lines[1:] for value in json.loads(line)["CityObjects"].values()]
    assert any(geometry["type"] == "Solid" for value in objects for geometry in value.get("geometry", []))


def test_footprints_are_still_required(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", str(place / "cloud.laz"), str(place / "out")]) == 2
    assert "CLOUD, FOOTPRINTS or OUT is missing" in capsys.readouterr().err
    assert main(["reconstruct", str(place / "out"), "--no-footprints"]) == 2
    assert "Missing argument 'CLOUD .. FOOTPRINTS'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--tile", "0652_6862"], "--tile: has no effect with --no-footprints"),
        (["--id-field", "id"], "--id-field: has no effect"),
        (["--registration", "always"], "--registration: has no effect"),
    ],
)
def test_options_that_need_footprints(
    place: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    arguments = ["reconstruct", str(place / "cloud.laz"), str(place / "out"), "--no-footprints", *options]
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_name_of_the_file(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["outlines", str(place / "cloud.laz"), str(place / "outlines.shp")]) == 2
    assert "name a file that ends in .gpkg" in capsys.readouterr().err
