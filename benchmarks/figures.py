"""Shared by the benchmarks: figures beside their bars, CPU time, peak memory."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np


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
    """CPU time of the fastest of a few calls, after one that is not measured."""
    call()
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        call()
        best = min(best, time.process_time() - start)
    return best


def peak_mib() -> float:
    """Peak memory of this process. getrusage is of no use: its figure begins with the parent's memory."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
