"""The manifest lists all shards of crops; :mod:`p2wss.data.manifest` reads it back. It also chooses which buildings of
a data set are used, so that there is a fixed number of pairs and of real clouds.

Each building has a rank that follows from the seed, its tile (with the place) and its id alone, whatever the order of
the shards and their other buildings. Of each split of the simulated buildings, the lowest ranks are used. Of the real
clouds, the lowest ranks are for the evaluation and the next ones for the training of the dvae: no cloud is in both.
"""

import os
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from p2wss.config import Dataset
from p2wss.data.manifest import building_ranks
from p2wss.storage import files
from p2wss.storage.messages import InputError
from p2wss.storage.schemas.crops import CROPS, REAL, SIMULATED

# 80 / 10 / 10 percent (paper, section 5.1)
SPLIT_SHARES = {"train": 0.8, "val": 0.1, "test": 0.1}


def choose(ranks: Mapping[tuple[str, str], np.ndarray], config: Dataset) -> dict[str, Any]:
    """The ranges of ranks to use, for the manifest, and how many buildings they hold.

    ranks: for each (dataset, split), the ranks of its buildings, uint64 (n,). Returns ``{dataset: {purpose: range}}``
    with the purposes of :meth:`p2wss.data.manifest.Manifest.select`. A range has the keys ``from`` and ``below``
    (ranks), ``num_buildings`` and ``num_wanted``. A dataset is absent if all its buildings are used.
    """
    selection: dict[str, Any] = {}
    if config.num_pairs:
        targets = {split: round(share * config.num_pairs) for split, share in SPLIT_SHARES.items()}
        targets["train"] += config.num_pairs - sum(targets.values())
        selection[SIMULATED] = {
            split: _range(np.sort(ranks.get((SIMULATED, split), np.zeros(0, np.uint64))), 0, target)
            for split, target in targets.items()
        }
    if config.num_lidar_test:
        real = np.sort(ranks.get((REAL, "none"), np.zeros(0, np.uint64)))
        selection[REAL] = {
            "test": _range(real, 0, config.num_lidar_test),
            "dvae": _range(real, config.num_lidar_test, config.num_lidar_dvae),
        }
    return selection


def _range(ranks: np.ndarray, first: int, count: int) -> dict[str, int]:
    """The range of the ``count`` ranks from index ``first`` on in the sorted ``ranks``; fewer if there are not so
    many."""
    last = min(first + count, len(ranks))
    end = 1 << 63  # above every rank
    start = int(ranks[first]) if first < len(ranks) else end
    stop = int(ranks[last]) if last < len(ranks) else end
    return {
        "from": start if first else 0,
        "below": stop,
        "num_buildings": max(last - first, 0),
        "num_wanted": count,
    }


def list_shards(shards: Sequence[tuple[Path, str]], folder: Path, config: Dataset) -> dict[str, Any]:
    """The manifest of ``shards``, pairs of a file and its dataset.

    For each shard it lists the path relative to ``folder``, dataset, tile, rows per split, exclusions per reason and
    SHA-256. config: how many buildings are used; the manifest holds the choice, the shards hold all buildings.

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
