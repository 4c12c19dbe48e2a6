"""What ``p2wss warm-up`` compiles is what ``p2wss reconstruct`` calls."""

from __future__ import annotations

import importlib
import os
import pkgutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numba.core.registry import CPUDispatcher

import p2wss.fit
from p2wss.clouds import cropping
from p2wss.config import Reconstruct
from p2wss.nets import supposed
from p2wss.reconstruction import compiled, warm_up
from p2wss.reconstruction.pipeline import run

# called from Python by tests only
NOT_CALLED = {"inherited_angles"}


def entries() -> Iterator[CPUDispatcher]:
    """The compiled functions of the fit and of the cropping that Python calls."""
    names = [module.name for module in pkgutil.walk_packages(p2wss.fit.__path__, "p2wss.fit.")]
    for module in (*map(importlib.import_module, names), cropping, supposed):
        for function in vars(module).values():
            if isinstance(function, CPUDispatcher) and function.py_func.__module__ == module.__name__:
                options = function.targetoptions
                if not options.get("no_cpython_wrapper") and options.get("inline") != "always":
                    yield function


def test_everything_that_is_called_from_python_gets_compiled() -> None:
    warm_up.warm_product()
    missing = {each.py_func.__name__ for each in entries() if not each.signatures}
    assert missing <= NOT_CALLED


def test_the_sample_has_a_step_a_dormer_and_a_courtyard() -> None:
    frame, cloud = warm_up.sample()
    any_shape, parametric = (
        [result.reconstruction for result in run(frame, cloud, None, "sample", Reconstruct(roofs=roofs))]
        for roofs in ("planes", "parametric")
    )
    assert any_shape[0].num_parts == 2
    assert len(any_shape[1].mesh.triangle) > len(parametric[1].mesh.triangle)
    assert len(any_shape[2].rings) == 2 and np.isfinite(any_shape[2].mesh.vertex_m).all()


def test_several_processes_compile_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def part(name: str) -> None:
        (tmp_path / name).write_text(str(os.getpid()))
        deadline = time.monotonic() + 20
        while name == "_fit" and not (tmp_path / "more").exists() and time.monotonic() < deadline:
            time.sleep(0.01)

    for name in ("_fit", "_parametric", "_labelling", "_whole"):
        monkeypatch.setattr(warm_up, name, partial(part, name))
    warm_up.warm_product(2, [partial(part, "more")])
    by = {path.name: path.read_text() for path in tmp_path.iterdir()}
    first = by.pop("_fit")
    assert set(by) == {"_parametric", "_labelling", "_whole", "more"}
    assert len(set(by.values())) == 1 and {first, str(os.getpid())}.isdisjoint(by.values())


def test_a_first_run_compiles_by_all_cores_and_goes_on_where_that_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    called: list[int] = []

    def fails(num_processes: int) -> None:
        called.append(num_processes)
        raise ChildProcessError("killed")

    monkeypatch.setattr(warm_up, "warm_product", fails)
    monkeypatch.setattr(compiled, "num_processes", lambda: 3)
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    compiled.compile_once()
    assert called == []  # all is compiled
    monkeypatch.setattr(compiled, "is_stored", lambda _: False)
    ahead = (
        "from p2wss.skeleton.compiled import alone_ahead\n"
        "with alone_ahead() as is_alone:\n"
        "    print(is_alone, flush=True)\n"
        "    input()"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", ahead], text=True, **pipes) as other:  # type: ignore[call-overload]
        assert other.stdout.readline() == "True\n"
        compiled.compile_once()
        assert called == []  # another process does
        other.communicate("\n")
    compiled.compile_once()
    assert called == [3]
    monkeypatch.setattr(threading, "active_count", lambda: 2)
    compiled.compile_once()
    assert called == [3]  # a fork would lack the other thread
