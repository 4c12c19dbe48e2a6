"""The manifest of the crops: JSON that lists the shards (written by the stage crops)."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NotRequired

import numpy as np
import pyarrow as pa
from pydantic import Field
from typing_extensions import TypedDict

from p2wss.data.seeds import derive_seed
from p2wss.storage import files, integrity
from p2wss.storage.messages import InputError, reading
from p2wss.storage.schemas.crops import SIMULATED

_Rank = Annotated[int, Field(ge=0, lt=2**64)]
_Range = TypedDict("_Range", {"from": _Rank, "below": _Rank})


class _Selection(TypedDict):
    ranges: NotRequired[dict[str, dict[str, _Range]]]
    seed: NotRequired[int]


@dataclass(frozen=True)
class Shard:
    """A shard of crops. dataset: see :mod:`p2wss.storage.schemas.crops`; sha256: None if the manifest has none."""

    path: Path
    dataset: str
    sha256: str | None = None

    def verified(self) -> Path:
        """The file, which has the content that the manifest lists. Raises :class:`InputError` otherwise."""
        integrity.verify(self.path)
        if self.sha256 is not None and files.sha256(self.path) != self.sha256:
            raise InputError(
                f"{self.path}: not the file that the manifest lists: its content differs; list the shards again"
                " (snakemake -R crops ..)"
            )
        return self.path


class _Listing(TypedDict):
    """What is read of a manifest."""

    shards: list[Shard]
    selection: NotRequired[_Selection]
    crs: NotRequired[dict[str, str | None]]


@dataclass(frozen=True)
class Manifest:
    """The shards of the stage crops, in the order of the manifest. crs: of each data set that states one."""

    shards: Sequence[Shard]
    # see p2wss.crops.manifest; a data set that is absent is used whole
    selection: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    crs: Mapping[str, str | None] = field(default_factory=dict)

    def select(self, table: pa.Table, dataset: str, purposes: Sequence[str]) -> np.ndarray:
        """Mask of the rows of a shard that are used for any of the purposes, bool (n,).

        table: with the columns ``split``, ``tile`` and ``building_id``. purposes: splits of simulated buildings; "test"
        or "dvae" of real clouds. Raises :class:`InputError` if the manifest does not state the range of a purpose.
        """
        split = table["split"].to_numpy(zero_copy_only=False).astype(str)
        ranges = self.selection.get(dataset)
        if ranges is None:
            return np.isin(split, list(purposes)) if dataset == SIMULATED else np.ones(len(table), bool)
        rank, mask = building_ranks(table, self.seed), np.zeros(len(table), bool)
        for purpose in purposes:
            if purpose not in ranges:
                raise InputError(
                    f"the manifest has no range of ranks for {dataset}, {purpose}; run the stage crops again"
                )
            first, end = np.uint64(ranges[purpose]["from"]), np.uint64(ranges[purpose]["below"])
            in_split = (split == purpose) | (dataset != SIMULATED)
            mask |= in_split & (rank >= first) & (rank < end)
        return mask


def building_ranks(table: pa.Table, seed: int) -> np.ndarray:
    """The rank of each building, uint64 (n,), evenly distributed below 2^63. It follows from the seed, tile and id."""
    tiles, names = table["tile"].to_pylist(), table["building_id"].to_pylist()
    ranks = [derive_seed(seed, "dataset", tile, name) for tile, name in zip(tiles, names, strict=True)]
    return np.array(ranks, np.uint64)


def read_manifest(path: str | Path, only: Sequence[Path] | None = None) -> Manifest:
    """The shards that a manifest lists; relative paths start at its folder, or else at the current folder.

    only: the shards to return, in the order of the manifest; other shards need not exist. Raises :class:`InputError` if
    the manifest or a shard is missing, or if the manifest does not list one of ``only``.
    """
    content = files.read_json(path, _Listing, "a manifest of crops")
    shards = []
    with reading(path, "a manifest of crops"):  # a name may be none that a file can have
        for shard in content["shards"]:
            beside = Path(path).parent / shard.path
            shards.append(replace(shard, path=beside) if beside.exists() else shard)
        if only is not None:
            listed = {os.path.abspath(shard.path): shard for shard in shards}
            wanted = {os.path.abspath(name) for name in only}
            for place in wanted - set(listed):
                raise InputError(f"{path}: does not list {place}; run the stage crops again")
            shards = [shard for place, shard in listed.items() if place in wanted]
        for shard in shards:
            if not shard.path.exists():
                raise InputError(
                    f"{path}: lists {shard.path}, which does not exist; run the stage crops again"
                )
    selection = content.get("selection", {})
    return Manifest(shards, selection.get("ranges", {}), selection.get("seed", 0), content.get("crs", {}))
