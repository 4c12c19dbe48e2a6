"""manifold3d without threads: a fork lacks them, and may wait for them forever."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

_THREADS = Path("/proc/self/task")


@pytest.mark.skipif(not _THREADS.is_dir(), reason="threads are counted in /proc")
def test_a_union_starts_no_threads() -> None:
    """``Shared`` forks processes that unite solids, too."""
    code = f"""
import os
from pathlib import Path
import p2wss.mesh  # with it numpy, which has threads
processors = os.sched_getaffinity(0)
before = len(list(Path("{_THREADS}").iterdir()))
from p2wss.mesh.booleans import manifold3d
ball = manifold3d.Manifold.sphere(1.0, 100)
assert (ball - ball.translate((0.3, 0.2, 0.1))).num_tri() > 1000
assert len(list(Path("{_THREADS}").iterdir())) == before
assert os.sched_getaffinity(0) == processors
"""
    subprocess.run([sys.executable, "-c", code], check=True)
