"""The buildings to evaluate of a small manifest, all at once."""

from __future__ import annotations

from pathlib import Path

from p2wss.eval import cases
from p2wss.eval.cases import Case
from p2wss.storage.schemas.manifest import read_manifest


def all_test_cases(manifest: Path) -> list[Case]:
    """The cases of all shards of a manifest, in order."""
    return [case for of_shard in cases.test_cases(read_manifest(manifest)) for case in of_shard]
