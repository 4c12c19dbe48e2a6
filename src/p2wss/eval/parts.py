"""Parts: the files that the jobs of one group of shards write, and how they are merged.

A part is a folder with the reconstructions and the CPU times of each method, the measures of all methods, and the
errors of Table 1. Reconstructions stay in the parts; the rest is merged one part at a time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.compute as pc
from pydantic import ConfigDict
from typing_extensions import TypedDict

from p2wss.errors import reading
from p2wss.eval import parameters
from p2wss.eval.baselines import RECORDED
from p2wss.eval.clock import CpuClock
from p2wss.storage import files
from p2wss.storage.schemas.measures import MEASURES


class _CpuTime(TypedDict):
    seconds: dict[str, float]
    num_buildings: dict[str, int]


class Method(TypedDict):
    """A method in ``methods.json``, with more facts."""

    __pydantic_config__ = ConfigDict(extra="allow")  # type: ignore[misc]

    method: str
    status: str
    cpu_ms: dict[str, float]


class Methods(TypedDict):
    """The content of ``methods.json``."""

    methods: list[Method]


@dataclass(frozen=True)
class Part:
    """The files of one group of shards."""

    folder: Path

    def reconstructions(self, method: str) -> Path:
        """The reconstructions of a method."""
        return self.folder / f"{method}.parquet"

    def cpu(self, method: str) -> Path:
        """CPU times of a method."""
        return self.folder / "cpu" / f"{method}.json"

    @property
    def measures(self) -> Path:
        """The measures of all methods."""
        return self.folder / "measures.parquet"

    @property
    def masked_errors(self) -> Path:
        """Errors of the settings of Table 1 with masked parameters."""
        return self.folder / "masked_errors.json"

    @property
    def variant_errors(self) -> Path:
        """Errors of the settings of Table 1 that are variants of ours."""
        return self.folder / "variant_errors.json"


def merge_measures(
    parts: Sequence[Part], methods: Sequence[str], out: Path, metadata: Mapping[str, Any]
) -> int:
    """Write the measures of all parts to one file, method by method; returns the number of rows.

    The rows are in the same order for any division into parts.
    """
    num_rows = 0
    with files.table_writer(out, MEASURES) as writer:
        for method in methods:
            for part in parts:
                table = files.read_table(part.measures, MEASURES)
                table = table.filter(pc.equal(table["method"], method))
                writer.append_table(table.cast(MEASURES))
                num_rows += len(table)
        writer.metadata = metadata
    return num_rows


def merge_errors(parts: Sequence[Part]) -> dict[str, Any]:
    """The content of ``parameters.json``, over the buildings of all parts."""
    masked = parameters.merged(files.read_json(part.masked_errors, parameters.StoredErrors) for part in parts)
    variants = parameters.merged(
        files.read_json(part.variant_errors, parameters.StoredErrors) for part in parts
    )
    return {**masked, "settings": masked["settings"] | variants["settings"]}


def merge_methods(parts: Sequence[Part], methods: Sequence[str]) -> list[dict[str, Any]]:
    """Per method its facts (:func:`merge_facts`), with the CPU time per building by data set as ``cpu_ms``."""
    merged = []
    for method in methods:
        clock = CpuClock()
        for part in parts:
            stored = files.read_json(part.cpu(method), _CpuTime)
            with reading(part.cpu(method), "CPU times"):
                clock.add(stored["seconds"], stored["num_buildings"])
        facts = merge_facts([files.read_metadata(part.reconstructions(method)) for part in parts])
        merged.append({"method": method, "cpu_ms": clock.ms_per_building(), **facts})
    return merged


def merge_facts(facts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The facts of a method's run on all shards: of the first on which it was run, or else of the first."""
    return dict(next((each for each in facts if each["status"] in ("ok", RECORDED)), facts[0]))
