"""The user's files of the tests of the command line."""

from __future__ import annotations

from pathlib import Path

import pytest
from oracle_network import Oracle
from toy_survey import write_survey

from p2wss.nets import predictor


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with cloud.laz (one building, Lambert-93), footprints.gpkg, and a network that answers."""
    write_survey(tmp_path)
    monkeypatch.setattr(predictor, "load_predictor", lambda path, device: Oracle())
    return tmp_path
