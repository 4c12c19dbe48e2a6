"""How functions are compiled: a cache tied to all sources of the package, one notice."""

import gc
import os
import shutil
import subprocess
import sys
from pathlib import Path

from numba import njit
from numba.core import event

import p2wss.skeleton

NOTICE = "compiling for this computer"


def run(folder: Path, **more: str) -> tuple[int, str]:
    """What a process returns, and its log."""
    command = (
        "import logging; logging.basicConfig(level=logging.INFO, format='%(message)s')\n"
        "import p2wss.skeleton.probe as probe; print(probe.outer(1))"
    )
    done = subprocess.run(
        [sys.executable, "-c", command],
        env={**os.environ, "PYTHONPATH": str(folder), **more},
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
    )
    return int(done.stdout), done.stderr


def package(folder: Path) -> Path:
    """A copy of nothing but the decorators, with a function in one file that calls one in another."""
    skeleton = folder / "p2wss" / "skeleton"
    skeleton.mkdir(parents=True)
    (folder / "p2wss" / "__init__.py").touch()
    (skeleton / "__init__.py").touch()
    shutil.copy(Path(p2wss.skeleton.__file__).with_name("compiled.py"), skeleton)
    (skeleton / "called.py").write_text(
        "from p2wss.skeleton.compiled import inner\n@inner\ndef add(x):\n    return x + 1\n"
    )
    (skeleton / "probe.py").write_text(
        "from p2wss.skeleton.called import add\nfrom p2wss.skeleton.compiled import entry\n"
        "@entry\ndef outer(x):\n    return add(x)\n"
    )
    return skeleton


def test_an_edit_in_another_file_is_noticed(tmp_path):
    skeleton = package(tmp_path)
    cache = tmp_path / "cache"
    result, log = run(tmp_path, NUMBA_CACHE_DIR=str(cache))
    assert result == 2 and log.count(NOTICE) == 1  # for two functions
    before = {path.name for path in cache.rglob("*.nb?")}
    assert run(tmp_path, NUMBA_CACHE_DIR=str(cache)) == (2, "")
    assert {path.name for path in cache.rglob("*.nb?")} == before and len(before) == 4
    called = skeleton / "called.py"
    called.write_text(called.read_text().replace("x + 1", "x + 7"))
    result, log = run(tmp_path, NUMBA_CACHE_DIR=str(cache))
    assert result == 8 and NOTICE in log
    after = {path.name for path in cache.rglob("*.nb?")}
    assert len(after) == 4 and not after & before  # the outdated ones are gone


def test_no_folder_to_cache_in(tmp_path):
    package(tmp_path)
    # a file in place of every folder that numba could write to
    blocked = tmp_path / "blocked"
    blocked.touch()
    (tmp_path / "p2wss" / "skeleton" / "__pycache__").touch()
    more = {"HOME": str(blocked), "XDG_CACHE_HOME": str(blocked), "PYTHONDONTWRITEBYTECODE": "1"}
    for folder in (str(blocked), ""):
        result, log = run(tmp_path, NUMBA_CACHE_DIR=folder, **more)
        assert result == 2 and "set NUMBA_CACHE_DIR" in log


def test_the_garbage_collector_rests_while_numba_compiles() -> None:
    is_enabled = []

    class Listener(event.Listener):
        def on_start(self, event):
            is_enabled.append(gc.isenabled())

        def on_end(self, event):
            pass

    @njit  # not from a cache, where a second run of this test would find it
    def one(x):
        return x + 1

    with event.install_listener("numba:compile", Listener()):
        assert one(1) == 2
    assert is_enabled == [False] and gc.isenabled()
