"""CPU time per building, of this process with all its threads and of the programs that it ran."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Mapping
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
            self.add({dataset: _cpu_s() - start}, {dataset: num_buildings})

    def has_timed(self, dataset: str) -> bool:
        """Whether any building of the data set was counted."""
        return dataset in self.seconds

    def add(self, seconds: Mapping[str, float], num_buildings: Mapping[str, int]) -> None:
        """Add the sums of another clock."""
        for dataset, count in num_buildings.items():
            self.seconds[dataset] = self.seconds.get(dataset, 0.0) + seconds[dataset]
            self.num_buildings[dataset] = self.num_buildings.get(dataset, 0) + count

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
