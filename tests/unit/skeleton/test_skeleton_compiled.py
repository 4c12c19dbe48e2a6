"""The cache of compiled code: tied to all sources of the package, and no condition of its use."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import p2wss.skeleton


def run(folder: Path, **more: str) -> int:
    environment = {**os.environ, "PYTHONPATH": str(folder), **more}
    done = subprocess.run(
        [sys.executable, "-c", "import p2wss.skeleton.probe as probe; print(probe.outer(1))"],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
    )
    return int(done.stdout)


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
    assert run(tmp_path, NUMBA_CACHE_DIR=str(cache)) == 2
    before = {path.name for path in cache.rglob("*.nb?")}
    assert run(tmp_path, NUMBA_CACHE_DIR=str(cache)) == 2
    assert {path.name for path in cache.rglob("*.nb?")} == before and len(before) == 4
    called = skeleton / "called.py"
    called.write_text(called.read_text().replace("x + 1", "x + 7"))
    assert run(tmp_path, NUMBA_CACHE_DIR=str(cache)) == 8
    after = {path.name for path in cache.rglob("*.nb?")}
    assert len(after) == 4 and not after & before  # the outdated ones are gone


def test_no_folder_to_cache_in(tmp_path):
    package(tmp_path)
    # a file in place of every folder that numba could write to
    blocked = tmp_path / "blocked"
    blocked.touch()
    (tmp_path / "p2wss" / "skeleton" / "__pycache__").touch()
    more = {"HOME": str(blocked), "XDG_CACHE_HOME": str(blocked), "PYTHONDONTWRITEBYTECODE": "1"}
    assert run(tmp_path, NUMBA_CACHE_DIR=str(blocked), **more) == 2
    assert run(tmp_path, **more) == 2
