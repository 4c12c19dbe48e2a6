"""How functions are compiled: a cache tied to all sources of the package, one notice."""

import gc
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import config, njit
from numba.core import event

import p2wss.skeleton
from p2wss.skeleton.compiled import both, entry
from p2wss.storage import messages, progress, sources

NOTICE = "compiling for this computer"


def run(folder: Path, before: str = "", after: str = "", **more: str) -> tuple[int, str]:
    """What a process returns, and its log. before, after: what it does before and after the call."""
    done = subprocess.run(
        [sys.executable, "-c", script(before, after)],
        env={**os.environ, "PYTHONPATH": str(folder), **more},
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
    )
    assert not done.returncode, done.stderr
    return int(done.stdout), done.stderr


def script(before: str, after: str) -> str:
    return (
        "import logging; logging.basicConfig(level=logging.INFO, format='%(message)s')\n"
        "import p2wss.storage.progress; p2wss.storage.progress.INTERVAL_S = 0\n"
        f"import p2wss.skeleton.probe as probe; {before}\nprint(probe.outer(1)); {after}"
    )


def package(folder: Path) -> Path:
    """A copy of the decorators and of what shows their progress, with a function in one file that calls one in
    another."""
    skeleton = folder / "p2wss" / "skeleton"
    skeleton.mkdir(parents=True)
    shutil.copy(Path(p2wss.skeleton.__file__).with_name("compiled.py"), skeleton)
    storage = folder / "p2wss" / "storage"
    storage.mkdir()
    for each in (skeleton.parent, skeleton, storage):
        (each / "__init__.py").touch()
    for module in (progress, messages, sources):
        shutil.copy(module.__file__, storage)
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
    assert result == 2 and log == f"{NOTICE}, once: 1 of 2 functions\n"
    before = {path.name for path in cache.rglob("*.nb?")}
    assert run(tmp_path, NUMBA_CACHE_DIR=str(cache)) == (2, "")
    assert {path.name for path in cache.rglob("*.nb?")} == before and len(before) == 4
    called = skeleton / "called.py"
    # of another size: Python itself tells edits of one size apart by whole seconds alone
    called.write_text(called.read_text().replace("x + 1", "x + 10"))
    result, log = run(tmp_path, NUMBA_CACHE_DIR=str(cache))
    assert result == 11 and NOTICE in log
    after = {path.name for path in cache.rglob("*.nb?")}
    assert len(after) == 4 and not after & before  # the outdated ones are gone


def test_what_was_edited_between_import_and_call_is_compiled_again(tmp_path):
    called, cache = package(tmp_path) / "called.py", str(tmp_path / "cache")
    edit = f"import pathlib; path = pathlib.Path({str(called)!r}); path.write_text(path.read_text().replace('1', '17'))"
    assert run(tmp_path, edit, NUMBA_CACHE_DIR=cache)[0] == 2
    result, log = run(tmp_path, NUMBA_CACHE_DIR=cache)
    assert result == 18 and NOTICE in log


@pytest.mark.skipif(sys.platform == "win32", reason="nothing is locked there")
def test_of_two_processes_at_once_one_compiles(tmp_path):
    package(tmp_path)
    count = (
        "from numba.core import event; num_compiled = 0\n"
        "class Count(event.Listener):\n"
        "    def on_end(self, ended): pass\n"
        "    def on_start(self, begun):\n"
        "        global num_compiled; num_compiled += 1\n"
    )
    also = "event.register('numba:compile', Count())"
    second = script(count + also, "print(num_compiled)")
    # the first one, compiling, starts the second, and goes on once that waits
    start = (
        "        if num_compiled == 1:\n"
        "            import subprocess, sys; global other; other = subprocess.Popen(\n"
        f"                [sys.executable, '-c', {second!r}], stdout=-1, stderr=-1, text=True)\n"
        "            assert 'another process' in other.stderr.readline()\n"
    )
    check = "assert (found := (num_compiled, *other.communicate())) == (2, '2\\n0\\n', ''), found"
    assert run(tmp_path, count + start + also, check, NUMBA_CACHE_DIR=str(tmp_path / "cache"))[0] == 2


def test_what_does_not_compile_is_locked_no_longer(tmp_path):
    package(tmp_path)
    wrong = "\ntry: probe.outer('a')\nexcept Exception: pass"
    other = f"[sys.executable, '-c', {script(wrong, '')!r}], check=True, stdout=-1"
    before = f"{wrong}\nimport subprocess, sys; subprocess.run({other})"
    assert run(tmp_path, before, NUMBA_CACHE_DIR=str(tmp_path / "cache"))[0] == 2


def test_cached_code_is_loaded_without_the_compiler(tmp_path):
    package(tmp_path)
    more = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    names = "numba.cpython.listobj", "numba.np.linalg"
    is_loaded = f"import sys; assert all((name in sys.modules) == {{}} for name in {names})"
    assert run(tmp_path, after=is_loaded.format(True), **more)[0] == 2
    assert run(tmp_path, after=is_loaded.format(False), **more) == (2, "")


def test_functions_of_other_programs_get_their_extensions_of_numba(tmp_path):
    """Functions of this package, loaded, leave them to the first function that needs them."""
    package(tmp_path)
    more = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    assert run(tmp_path, **more)[0] == 2
    after = (
        "from numba import njit; from numba.core import entrypoints; assert not entrypoints._already_initialized; "
        "njit(lambda x: x)(1); assert entrypoints._already_initialized"
    )
    assert run(tmp_path, after=after, **more) == (2, "")


def test_what_only_python_calls_is_no_part_of_compiled_code() -> None:
    @entry
    def one() -> int:
        return 1

    @both
    def two() -> int:
        return 2

    @entry
    def wrong() -> int:
        return one()

    @entry
    def right() -> int:
        return two()

    assert one() == 1 and right() == two() == 2  # all of which may come from the cache
    with pytest.raises(TypeError, match="decorated with entry"):
        wrong()


def test_functions_of_numba_that_code_of_ours_called_first_work_in_other_programs(
    tmp_path, monkeypatch
) -> None:
    """They have no machine code of their own; what other programs compile has."""
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    is_callable = {}

    class Listener(event.Listener):
        def on_start(self, event):
            function = event.data["dispatcher"]
            is_callable[function.py_func.__name__] = "no_cfunc_wrapper" not in function.targetoptions

        def on_end(self, event):
            pass

    @entry
    def ours(values: np.ndarray) -> float:
        return np.sort(values)[0]

    @njit
    def helper(values):
        return np.sort(values)[-1]

    @njit
    def theirs(values):
        return helper(values) + np.sort(values)[0]

    values = np.array([3, 1, 2], np.int8)  # of which nothing else sorts any
    with event.install_listener("numba:compile", Listener()):
        assert ours(values) == 1 and theirs(values) == 4 and helper(values) == 3
    assert is_callable["helper"] and not is_callable["run_quicksort"]


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


def test_all_machine_code_of_the_package_is_cached_by_its_own_rules() -> None:
    """numba's cache raises an error at import where no folder can be written, and keeps the code of older sources."""
    folder = Path(p2wss.skeleton.__file__).parents[1]
    files = [path for path in folder.rglob("*.py") if "njit(" in path.read_text(encoding="utf-8")]
    assert [path.name for path in files] == ["compiled.py"]
