"""Shared by the benchmarks: figures beside their bars, CPU time, peak memory."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

# CPU seconds of the reference kernel on the idle machine on which most figures were measured
REFERENCE_S = 0.205


class Figures:
    """Measured values and the bars that they must reach."""

    def __init__(self) -> None:
        self._measured: dict[str, dict[str, object]] = {}
        self._rows: dict[str, dict[str, object]] = {}

    def at_least(self, name: str, value: float | None, bar: float) -> None:
        """Add a value that must not be less than ``bar``; None if it cannot be measured here."""
        self._add(name, value, bar, lambda value: value >= bar)

    def at_most(self, name: str, value: float | None, bar: float) -> None:
        """Add a value that must not be more than ``bar``; None if it cannot be measured here."""
        self._add(name, value, bar, lambda value: value <= bar)

    def row(self, name: str, values: Mapping[str, object]) -> None:
        """Add values without a bar, which appear in the JSON only."""
        self._rows[name] = dict(values)

    def _add(self, name: str, value: float | None, bar: float, met: Callable[[float], bool]) -> None:
        if value is not None:
            self._measured[name] = {"value": round(float(value), 5), "bar": bar, "ok": bool(met(value))}

    def end(self) -> int:
        """Print all as a table and as one line of JSON; returns the exit status, 0 if all bars are met."""
        width = max(map(len, self._measured), default=0)
        print()
        for name, figure in self._measured.items():
            verdict = "met" if figure["ok"] else "MISSED"
            print(f"{name:<{width}}  {figure['value']:>12g}  bar {figure['bar']:<8g} {verdict}")
        print(json.dumps(self._rows | self._measured))
        return 0 if all(figure["ok"] for figure in self._measured.values()) else 1


def cpu_seconds(call: Callable[[], object], repeats: int = 3) -> float:
    """CPU time of the fastest of ``repeats`` calls, after one that is not measured."""
    call()
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        call()
        best = min(best, time.process_time() - start)
    return best


def peak_mib() -> float:
    """Peak memory of this process. getrusage does not tell it: its figure starts with the memory of the parent."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


class Run(NamedTuple):
    """What a program needed: CPU seconds, seconds, peak memory in MiB; and what it wrote to its standard output."""

    cpu_s: float
    wall_s: float
    peak_mib: float
    output: str


def run(command: Sequence[object], limit_s: float | None = None, **environment: str) -> Run:
    """Run a program to its end; bytecode of the sources is written, as after an installation. CPU time counts all its
    processes, memory the largest one. The memory is at least the peak of this process, which should therefore stay
    small. Raises ``SystemExit`` with the messages of the program if it fails, ``TimeoutError`` after ``limit_s``."""
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    words = [str(word) for word in command]
    start = time.perf_counter()
    process = subprocess.Popen(
        words,
        env=inherited | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=limit_s is not None,
    )
    assert process.stdout is not None
    is_late = threading.Event()

    def stop() -> None:
        is_late.set()
        os.killpg(process.pid, signal.SIGKILL)

    timer = threading.Timer(limit_s or 0.0, stop)
    if limit_s is not None:
        timer.start()
    try:
        output = process.stdout.read()
    except KeyboardInterrupt:  # its session does not get it
        process.kill()
        raise
    finally:
        timer.cancel()
    _, status, usage = os.wait4(process.pid, 0)
    if is_late.is_set():
        raise TimeoutError(f"not done after {limit_s:g} s: {' '.join(words)}")
    if status:
        raise SystemExit(f"{' '.join(words)}:\n{output}")
    wall_s = time.perf_counter() - start
    return Run(usage.ru_utime + usage.ru_stime, wall_s, usage.ru_maxrss / 1024, output)


def slowness() -> float:
    """How much slower than usual this machine is at the moment: CPU time of a kernel of Python and numpy, relative to
    :data:`REFERENCE_S`. Other work on the same cores and caches takes a third and more.

    The sort is a stable one: numpy's others take a fifth of the time where a processor has AVX-512, and the command
    does not.
    """
    values = np.random.default_rng(0).random(400_000)

    def kernel() -> None:
        np.argsort(values, kind="stable")
        table: dict[int, list[int]] = {}
        for number in range(1_600_000):
            table.setdefault(number % 1000, []).append(number)

    return cpu_seconds(kernel) / REFERENCE_S
