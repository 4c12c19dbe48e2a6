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
