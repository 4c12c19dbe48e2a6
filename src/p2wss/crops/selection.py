"""Choose which buildings of a data set are used: a fixed number of pairs, and of real clouds.

Each building has a rank that follows from the seed, its tile (with the place) and its id alone: neither the order of
the shards nor what else is in them changes who has a lower rank. Of each split the lowest ranks are used. Of the real
clouds the lowest ranks are for the evaluation and the next ones for the training of the dvae: no cloud is in both.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from p2wss.config import Dataset
from p2wss.storage.schemas.crops import REAL, SIMULATED

# 80 / 10 / 10 percent (paper, section 5.1)
SPLIT_SHARES = {"train": 0.8, "val": 0.1, "test": 0.1}


def choose(ranks: Mapping[tuple[str, str], np.ndarray], config: Dataset) -> dict[str, Any]:
    """The ranges of ranks to use, for the manifest, and how many buildings they hold.

    ranks: (dataset, split) to the ranks of its buildings, uint64 (n,). Returns ``{dataset: {purpose: range}}``
    with the purposes of :meth:`p2wss.data.manifest.Manifest.select`. A range has the ranks ``from`` and
    ``below``, ``num_buildings`` and ``num_wanted``. A dataset of which all buildings are used is absent.
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
    """Ranks number ``first`` to ``first + count`` of the sorted ones."""
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
