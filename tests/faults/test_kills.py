"""Kills of the workflow: the rerun makes everything good. All trials: ``python tests/faults/kills.py``."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="processes are watched through /proc")
def test_a_rerun_after_a_kill_gives_the_same_results(tmp_path: Path) -> None:
    """A moment of every stage, each with the next of the signals, and a control without one."""
    script = [sys.executable, ROOT / "tests/faults/kills.py", "--work", tmp_path]
    for arguments in (["--one-signal-each", "--moments", "9"], ["--moments", "1", "--signals", "none"]):
        run = subprocess.run([*script, *arguments], capture_output=True, text=True, check=False)
        assert run.stdout, run.stderr[-5000:]
        figures = json.loads(run.stdout.splitlines()[-1])
        assert figures["survived, share"]["value"] == 1, run.stdout
        assert figures["jobs repeated per running job"]["ok"], run.stdout
        assert figures["trainings in one folder at once"]["ok"], run.stdout
