"""The buildings to evaluate of a small manifest, all at once."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from p2wss.data.building import Reconstruction
from p2wss.data.manifest import read_manifest
from p2wss.eval import cases, methods
from p2wss.eval.cases import Case, Key


def all_test_cases(manifest: Path) -> list[Case]:
    """The cases of all shards of a manifest, in order."""
    return [case for of_shard in cases.test_cases(read_manifest(manifest)) for case in of_shard]


def reconstructed(
    method: str, every: Sequence[Case], inputs: methods.Inputs
) -> dict[str, dict[Key, Reconstruction]]:
    """The reconstructions by method and key; the cases of a data set are one shard."""
    result: dict[str, dict[Key, Reconstruction]] = {}
    for dataset, of_shard in groupby(every, key=lambda case: case.dataset):
        for row in methods.reconstruct(method, list(of_shard), inputs):
            result.setdefault(row.method, {})[dataset, row.tile, row.building_id] = row
    return result
