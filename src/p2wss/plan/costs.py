"""The table of measured costs per unit, ``config/costs.csv``, which ``benchmarks/costs.py`` writes."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from p2wss.errors import InputError


@dataclass(frozen=True)
class Cost:
    """What one unit costs in a stage.

    stage: as the files below logs/<region>/benchmarks. unit: a key of :attr:`p2wss.plan.work.Work.amounts`. cpu_s,
    gpu_s: seconds of a core, and of a GPU instead where there is one. disk_mb: results. peak_mb: largest memory of a
    job. source: where the figures are from.
    """

    stage: str
    unit: str
    cpu_s: float
    gpu_s: float
    disk_mb: float
    peak_mb: float
    source: str


COLUMNS = [field.name for field in fields(Cost)]


def read_costs(path: Path) -> list[Cost]:
    """The rows of the table. Raises :class:`InputError` if it cannot be read."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [
                Cost(
                    row["stage"],
                    row["unit"],
                    float(row["cpu_s"]),
                    float(row["gpu_s"]),
                    float(row["disk_mb"]),
                    float(row["peak_mb"]),
                    row["source"],
                )
                for row in csv.DictReader(file)
            ]
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not a table of costs with the columns {', '.join(COLUMNS)}") from error


def write_costs(path: Path, costs: Sequence[Cost]) -> None:
    """Write the table, with three digits per figure."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for cost in costs:
            values = (getattr(cost, name) for name in COLUMNS)
            writer.writerow([f"{value:.3g}" if isinstance(value, float) else value for value in values])
