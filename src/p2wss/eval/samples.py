"""The buildings that the report shows, read from the parts of the evaluation: a few, however many were measured."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from p2wss.data.building import Reconstruction
from p2wss.eval.cases import Case, Key, cases_of
from p2wss.eval.causes import Cause, cause_of_error
from p2wss.eval.methods import fit_parts
from p2wss.eval.parts import Part
from p2wss.storage import files
from p2wss.storage.schemas.manifest import Manifest
from p2wss.storage.schemas.reconstructions import read_reconstructions


@dataclass(frozen=True)
class Samples:
    """Cases by key, reconstructions by method and key, and rows of the measures by key and method."""

    cases: Mapping[Key, Case]
    reconstructions: Mapping[str, Mapping[Key, Reconstruction]]
    rows: Mapping[tuple[Key, str], Mapping[str, Any]]

    def cause(self, key: Key, method: str) -> Cause:
        """Why the mesh of a method is far from its points."""
        by_method = {name: by_key.get(key) for name, by_key in self.reconstructions.items()}
        return cause_of_error(self.cases[key], self.reconstructions[method][key], fit_parts(by_method))


def read_samples(
    keys: Collection[Key],
    manifest: Manifest,
    measures: pa.Table,
    parts: Sequence[Part],
    methods: Sequence[str],
) -> Samples:
    """The buildings with these keys. measures: of the schema ``MEASURES``.

    Raises :class:`InputError` if a file of the parts or a shard is missing or broken.
    """
    reconstructions: dict[str, dict[Key, Reconstruction]] = {name: {} for name in methods}
    for part in parts:
        for name in methods:
            reconstructions[name] |= read_reconstructions(part.reconstructions(name), keys)
    return Samples(cases_of(manifest, keys), reconstructions, rows_by_key(measures, keys))


def rows_by_key(measures: pa.Table, keys: Collection[Key]) -> dict[tuple[Key, str], dict[str, Any]]:
    """The rows of the buildings with these keys, by key and method."""
    mask = files.rows_with(["dataset", "tile", "building_id"], keys)(measures)
    rows = measures.take(np.flatnonzero(mask)).to_pylist()
    return {((row["dataset"], row["tile"], row["building_id"]), row["method"]): row for row in rows}
