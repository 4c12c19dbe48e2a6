"""The regions of the project: valid, made of whole tiles, and without unnecessary keys."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from places import ROOT

from p2wss.config import load
from p2wss.data.tiling import tiles_of_bounds

REGIONS = sorted((ROOT / "config" / "regions").glob("*.yaml"))


@pytest.mark.parametrize("path", REGIONS, ids=lambda path: path.stem)
def test_region(path: Path) -> None:
    config = load(path)
    assert config.region.name == path.stem
    assert config.fetch.source == "geoplateforme"
    assert all(value % config.region.tile_size_m == 0 for value in config.region.bounds_m)
    inside = set(tiles_of_bounds(config.region.bounds_m, config.region.tile_size_m))
    assert config.region.lidar_tiles and set(config.region.lidar_tiles) <= inside
    assert set(yaml.safe_load(path.read_text(encoding="utf-8"))) == {"region", "fetch"}


def test_the_cities_of_the_paper_are_included() -> None:
    assert {"paris", "marseille", "bordeaux", "lyon"} < {path.stem for path in REGIONS}
