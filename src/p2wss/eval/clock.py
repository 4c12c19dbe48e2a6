"""CPU time per building, of this process with all its threads and of the programs that it ran."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager


class CpuClock:
    """Sums CPU seconds and numbers of buildings by data set."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.num_buildings: dict[str, int] = {}

    @contextmanager
    def timed(self, dataset: str, num_buildings: int) -> Iterator[None]:
        """Add the CPU time of the block."""
        start = _cpu_s()
        try:
            yield
        finally:
            self.seconds[dataset] = self.seconds.get(dataset, 0.0) + _cpu_s() - start
            self.num_buildings[dataset] = self.num_buildings.get(dataset, 0) + num_buildings

    def ms_per_building(self) -> dict[str, float]:
        """Milliseconds per building of each data set."""
        return {
            dataset: 1e3 * seconds / self.num_buildings[dataset]
            for dataset, seconds in self.seconds.items()
            if self.num_buildings[dataset]
        }


def _cpu_s() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime
