"""The manifest of the crops: JSON that lists the shards (written by the stage crops)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from p2wss.data import files
from p2wss.errors import InputError


class Shard(NamedTuple):
    """A shard of crops. dataset: see :mod:`p2wss.data.schemas.crops`; sha256: None if the manifest has none."""

    path: Path
    dataset: str
    sha256: str | None = None


@dataclass(frozen=True)
class Manifest:
    """The shards of the stage crops, in the order of the manifest."""

    shards: Sequence[Shard]

    def crs(self) -> dict[str, str | None]:
        """CRS of each data set, from its first shard; None if that does not state one."""
        by_dataset: dict[str, str | None] = {}
        for shard in self.shards:
            if shard.dataset not in by_dataset:
                by_dataset[shard.dataset] = files.read_metadata(shard.path).get("crs")
        return by_dataset


def read_manifest(path: str | Path) -> Manifest:
    """The shards that a manifest lists; relative paths start at its folder, or else at the current folder.

    Raises :class:`InputError` if the manifest or a shard is missing.
    """
    content = files.read_json(path)
    shards = []
    try:
        for entry in content["shards"]:
            name = Path(entry["path"])
            beside = Path(path).parent / name
            shards.append(
                Shard(beside if beside.exists() else name, str(entry["dataset"]), entry.get("sha256"))
            )
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: not a manifest of crops: missing {error}") from error
    missing = [str(shard.path) for shard in shards if not shard.path.exists()]
    if missing:
        raise InputError(f"{path}: lists {missing[0]}, which does not exist; run the stage crops again")
    return Manifest(shards)
