"""A disk that fills up during a write, simulated by a limit on the file size."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

MINI = ROOT / "tests" / "mini"
SCRIPT = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
from p2wss.cli import main
sys.exit(main(sys.argv[1:]))
"""
CONFIG = f"""
fetch: {{folder: {{footprints: {MINI}/bdtopo, dtm: {MINI}/rgealti, lidar: {MINI}/lidar}}}}
"""


@pytest.mark.parametrize("what", ["footprints", "dtm --tile 0652_6862", "lidar --tile 0653_6861"])
def test_full_disk(tmp_path: Path, what: str) -> None:
    (tmp_path / "config.yaml").write_text(CONFIG)
    folder = tmp_path / "out"
    folder.mkdir()
    out = folder / "x.gpkg"
    out.write_text("what was there before")
    arguments = ["fetch", *what.split(), "--out", str(out), "--config", str(tmp_path / "config.yaml")]
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert f"p2wss: error: {out}: not written: File too large" in done.stderr
    assert out.read_text() == "what was there before"
    assert list(folder.iterdir()) == [out]
