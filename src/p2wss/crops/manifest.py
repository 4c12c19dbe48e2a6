"""The manifest: the list of all shards of crops, which :mod:`p2wss.data.manifest` reads back."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from p2wss.config import Dataset
from p2wss.crops.selection import choose
from p2wss.data.manifest import building_ranks
from p2wss.storage import files
from p2wss.storage.errors import InputError
from p2wss.storage.schemas.crops import CROPS


def list_shards(shards: Sequence[tuple[Path, str]], folder: Path, config: Dataset) -> dict[str, Any]:
    """The manifest of ``shards``, pairs of a file and its dataset.

    It lists for each shard the path relative to ``folder``, dataset, tile, rows per split, exclusions per reason
    and SHA-256. config: how many buildings are used; the manifest holds the choice, the shards hold all buildings.

    Raises :class:`InputError` if no shard has a row, or if shards of one dataset differ in CRS.
    """
    entries: list[dict[str, Any]] = []
    total: Counter[str] = Counter()
    crs: dict[str, Any] = {}
    ranks: defaultdict[tuple[str, str], list[np.ndarray]] = defaultdict(list)
    for path, dataset in shards:
        table = files.read_table(path, CROPS, columns=["split", "tile", "building_id"])
        split = table["split"].to_pylist()
        if config.num_pairs or config.num_lidar_test:
            names, rank = np.array(split, dtype=object), building_ranks(table, config.seed)
            for name in set(split):
                ranks[dataset, name].append(rank[names == name])
        metadata = files.read_metadata(path)
        if crs.setdefault(dataset, metadata.get("crs")) != metadata.get("crs"):
            raise InputError(
                f"{path}: is in {metadata.get('crs')}, but other {dataset} shards are in {crs[dataset]}"
            )
        total.update(split)
        entries.append(
            {
                "path": Path(os.path.relpath(path, folder)).as_posix(),
                "dataset": dataset,
                "tile": metadata.get("tile"),
                "num_rows": len(split),
                "splits": dict(sorted(Counter(split).items())),
                "num_excluded": metadata.get("num_excluded", {}),
                "sha256": files.sha256(path),
            }
        )
    if not total:
        raise InputError("no building in any shard; the logs of the stage crops list the reasons")
    ranges = choose({key: np.concatenate(parts) for key, parts in ranks.items()}, config)
    return {
        **({"selection": {"seed": config.seed, "ranges": ranges}} if ranges else {}),
        "num_rows": sum(total.values()),
        "splits": dict(sorted(total.items())),
        "crs": crs,
        "shards": entries,
    }
