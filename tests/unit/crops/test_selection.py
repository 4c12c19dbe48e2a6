"""Which buildings of a data set are used: seeded, independent of any order, of no cloud for two purposes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from p2wss.config import Dataset
from p2wss.crops.manifest import choose
from p2wss.data.manifest import Manifest, building_ranks


def shard(tile: str, count: int, split: str) -> pa.Table:
    return pa.table(
        {"tile": [tile] * count, "building_id": [str(i) for i in range(count)], "split": [split] * count}
    )


def ranks_of(*tables: pa.Table, seed: int = 0) -> np.ndarray:
    return np.concatenate([building_ranks(table, seed) for table in tables])


def test_pairs_are_chosen_by_split_whatever_the_order() -> None:
    tables = {
        split: [shard(f"paris/{k}/0652_6862", 200, split) for k in (1, 2)]
        for split in ("train", "val", "test")
    }
    config = Dataset(num_pairs=100, seed=3)
    ranks = {("simulated", split): ranks_of(*parts, seed=3) for split, parts in tables.items()}
    backwards = {("simulated", split): ranks_of(*parts[::-1], seed=3) for split, parts in tables.items()}
    ranges = choose(ranks, config)
    assert choose(backwards, config) == ranges
    assert {split: counts["num_buildings"] for split, counts in ranges["simulated"].items()} == {
        "train": 80, "val": 10, "test": 10,
    }  # fmt: skip
    manifest = Manifest([], ranges, 3)
    masks = {
        split: [manifest.select(table, "simulated", [split]) for table in parts]
        for split, parts in tables.items()
    }
    assert {split: sum(int(mask.sum()) for mask in parts) for split, parts in masks.items()} == {
        "train": 80, "val": 10, "test": 10,
    }  # fmt: skip
    # both draws are used, and other buildings with another seed
    assert all(mask.any() for mask in masks["train"])
    other = Manifest(
        [], choose({k: ranks_of(*tables[k[1]], seed=4) for k in ranks}, Dataset(num_pairs=100)), 4
    )
    assert (other.select(tables["train"][0], "simulated", ["train"]) != masks["train"][0]).any()
    # a larger target keeps what a smaller one has chosen
    more = Manifest([], choose(ranks, Dataset(num_pairs=200, seed=3)), 3)
    assert more.select(tables["train"][0], "simulated", ["train"])[masks["train"][0]].all()


def test_no_real_cloud_is_both_learnt_from_and_tested_on() -> None:
    table = shard("paris/0652_6862", 100, "none")
    ranges = choose({("real", "none"): ranks_of(table)}, Dataset(num_lidar_dvae=30, num_lidar_test=50))
    manifest = Manifest([], ranges)
    dvae, test = (manifest.select(table, "real", [purpose]) for purpose in ("dvae", "test"))
    assert dvae.sum() == 30 and test.sum() == 50 and not (dvae & test).any()


def test_all_are_used_without_targets_and_as_many_as_there_are() -> None:
    table = shard("0652_6862", 40, "train")
    manifest = Manifest([])
    assert manifest.select(table, "simulated", ["train"]).all()
    assert not manifest.select(table, "simulated", ["test"]).any()
    assert manifest.select(table, "real", ["test"]).all() and manifest.select(table, "real", ["dvae"]).all()
    ranges = choose({("simulated", "train"): ranks_of(table)}, Dataset(num_pairs=1000))
    assert (
        ranges["simulated"]["train"]["num_buildings"] == 40
        and ranges["simulated"]["train"]["num_wanted"] == 800
    )
    assert Manifest([], ranges).select(table, "simulated", ["train"]).all()
    assert Manifest(shards=[Path("x")], selection=ranges).select(table, "real", ["dvae"]).all()


@pytest.mark.parametrize("seed", [0, 1])
def test_ranks_are_even(seed: int) -> None:
    share = building_ranks(shard("t", 4000, "train"), seed) / 2.0**63
    assert 0.47 < share.mean() < 0.53 and share.min() >= 0 and share.max() < 1
