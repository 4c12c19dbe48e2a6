"""The table lists every source that a region of the project uses, with licence and attribution."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from places import ROOT

from p2wss.config import load
from p2wss.errors import InputError
from p2wss.eval import attribution

CONFIG = ROOT / "config"
TABLE = attribution.read(CONFIG / "sources.csv")


def test_table_is_complete() -> None:
    rows = list(csv.DictReader(TABLE.splitlines()))
    assert rows and all(all(row[name] for name in attribution.COLUMNS) for row in rows)
    assert len({row["layer"] for row in rows}) == len(rows)


@pytest.mark.parametrize("path", [None, *sorted(CONFIG.glob("regions/*.yaml"))], ids=str)
def test_every_source_of_every_region_is_named(path: Path | None) -> None:
    lines = attribution.attribution(load(path) if path else load(), TABLE)
    assert len(lines) == 3
    assert not any("add its licence" in line for line in lines)
    if path:
        assert all("IGN" in line and "Licence Ouverte" in line and "2026" in line for line in lines)


def test_only_sources_in_use_are_named_and_unknown_ones_marked() -> None:
    config = load({"region": {"lidar_tiles": []}, "fetch": {"folder": {"dtm": "my/dtm"}}})
    lines = attribution.attribution(config, TABLE)
    assert len(lines) == 2
    assert lines[1] == "my/dtm: add its licence and attribution to config/sources.csv"


def test_another_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected the columns product,vintage"):
        attribution.attribution(load(), "a,b\n1,2\n")
    with pytest.raises(InputError, match=r"none\.csv: No such file"):
        attribution.read(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("config", "name"),
    [
        ({}, "Real LiDAR (stand-in)"),
        ({"fetch": {"source": "geoplateforme"}}, "LiDAR HD"),
        ({"fetch": {"folder": {"lidar": "my/ahn3.laz"}}}, "Real LiDAR"),
        ({"fetch": {"source": "geoplateforme"}, "eval": {"lidar_name": "AHN3"}}, "AHN3"),
    ],
)
def test_real_lidar_has_the_name_of_its_product(config: dict[str, object], name: str) -> None:
    assert attribution.lidar_name(load(config), TABLE) == name


@pytest.mark.parametrize("file", sorted(CONFIG.glob("**/*.yaml")), ids=lambda path: path.stem)
def test_no_config_has_to_say_what_lidar_hd_is_called(file: Path) -> None:
    config = load(file)
    if config.fetch.source == "geoplateforme":
        assert attribution.lidar_name(config, TABLE) == "LiDAR HD"


def test_a_data_set_names_the_sources_of_all_its_members() -> None:
    config = load(
        {
            "region": {"vintage": "2026"},
            "dataset": {
                "members": [
                    {
                        "name": "city",
                        "region": {"lidar_tiles": ["all"]},
                        "fetch": {"source": "geoplateforme"},
                    },
                    {"name": "town", "fetch": {"folder": {"footprints": "resources/towns/1/bdtopo/x.gpkg"}}},
                    {"name": "mini", "region": {"lidar_tiles": ["0653_6861"]}},
                ]
            },
        }
    )
    assert attribution.lidar_name(config, TABLE) == "LiDAR HD, Real LiDAR (stand-in)"
    lines = attribution.attribution(config, TABLE)
    assert lines[:3] == [
        "IGN - BD TOPO (2026), Licence Ouverte / Open Licence 2.0 (Etalab)",
        "IGN - RGE ALTI (2026), Licence Ouverte / Open Licence 2.0 (Etalab)",
        "IGN - LiDAR HD (2026), Licence Ouverte / Open Licence 2.0 (Etalab)",
    ]
    assert any("Made-up towns" in line for line in lines) and any("stand-in" in line for line in lines)
    assert not any("add its licence" in line for line in lines)
