"""A disk that fills up during a write, simulated by a limit on the file size."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from places import ROOT

from p2wss.cli import main

MINI = ROOT / "tests" / "mini"
CONFIG = f"""
fetch: {{folder: {{footprints: {MINI}/bdtopo, dtm: {MINI}/rgealti, lidar: {MINI}/lidar}}}}
"""


@contextmanager
def limited(num_bytes: int) -> Iterator[None]:
    """No file of this process becomes longer; Python ignores the signal that says so."""
    before, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (before, most))


@pytest.mark.parametrize("what", ["footprints", "dtm --tile 0652_6862", "lidar --tile 0653_6861"])
def test_full_disk(tmp_path: Path, what: str, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "config.yaml").write_text(CONFIG)
    folder = tmp_path / "out"
    folder.mkdir()
    out = folder / "x.gpkg"
    out.write_text("what was there before")
    arguments = ["fetch", *what.split(), "--out", str(out), "--config", str(tmp_path / "config.yaml")]
    with limited(20_000):
        assert main(arguments) == 2
    assert f"p2wss: error: {out}: not written: File too large" in capsys.readouterr().err
    assert out.read_text() == "what was there before"
    assert list(folder.iterdir()) == [out]
