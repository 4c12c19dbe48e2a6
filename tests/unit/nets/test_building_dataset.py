"""From shards to batches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
import toy_crops

from p2wss.errors import InputError
from p2wss.nets import dataset, patch_cache, shards
from p2wss.nets.batch import UNKNOWN_PATCHES
from p2wss.nets.dataset import BatchSampler, TrainingLimits
from p2wss.nets.patch_cache import PatchSettings, precompute_patches
from p2wss.nets.patches import patch_index
from p2wss.nets.shards import describe, load_dataset
from p2wss.storage import files
from p2wss.storage.schemas.crops import CROPS

LIMITS = TrainingLimits(min_points=64, max_vertices=8, max_length_m=70)


@pytest.fixture(scope="module")
def manifest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy_crops.make(tmp_path_factory.mktemp("crops"), {"train": 30, "val": 6, "test": 4}, lidar=5)


def rewrite(manifest: Path, tmp_path: Path, change: dict[int, dict[str, object]]) -> Path:
    """A copy of the data with some rows changed; row 0 to 29 are the train split."""
    table = pq.read_table(manifest.parent / "0001_0001.parquet")
    rows = table.to_pylist()
    for row, values in change.items():
        rows[row].update(values)
    columns = {field.name: [row[field.name] for row in rows] for field in CROPS}
    files.write_table(tmp_path / "s.parquet", columns, CROPS, {})
    files.write_json(tmp_path / "m.json", {"shards": [{"path": "s.parquet", "dataset": "simulated"}]})
    return tmp_path / "m.json"


def test_splits_labels_and_real_lidar(manifest: Path) -> None:
    train = load_dataset(manifest, ["train"], LIMITS, labelled=True, include_real=True)
    assert len(train) == 30 and train.num_excluded == {}  # no labels on LiDAR: not among the labelled
    assert (train.num_vertices == 4).all()
    unlabelled = load_dataset(manifest, ["train"], LIMITS, labelled=False, include_real=True)
    assert len(unlabelled) == 35 and np.isnan(unlabelled.height_m).all()
    assert len(load_dataset(manifest, ["val", "test"], LIMITS, labelled=True, include_real=False)) == 10


def test_heights_are_above_the_ground_that_the_cloud_shows(manifest: Path, tmp_path: Path) -> None:
    row = pq.read_table(manifest.parent / "0001_0001.parquet").slice(0, 1).to_pylist()[0]
    label_z = row["eave_height_m"] + row["label_terrain_z_m"]
    loaded = load_dataset(manifest, ["train"], LIMITS, labelled=True, include_real=False)
    assert loaded.height_m[0] == pytest.approx(label_z - row["ground_z_m"], abs=1e-4)
    assert loaded.height_m[0] + loaded.ground_z_m[0] == pytest.approx(label_z - row["origin_z_m"], abs=1e-4)
    blind = rewrite(manifest, tmp_path, {0: {"ground_z_m": float("nan")}})
    without = load_dataset(blind, ["train"], LIMITS, labelled=True, include_real=False)
    assert len(without) == len(loaded) - 1 and without.num_excluded == {"no-ground": 1}


def test_what_cannot_be_used_is_counted(manifest: Path, tmp_path: Path) -> None:
    ring = np.array([[0, 0], [9, 0], [9, 9], [0, 9]])
    hole = [3, 3, 3, 6, 6, 6, 6, 3]
    nonagon = 9 * np.column_stack([f(np.arange(9) * 2 * np.pi / 9) for f in (np.cos, np.sin)])
    changed = rewrite(
        manifest,
        tmp_path,
        {
            0: {"x_cm": [1] * 63, "y_cm": [1] * 63, "z_cm": [1] * 63},
            1: {"footprint_xy_m": [*ring.ravel(), *hole], "ring_offset": [0, 4, 8], "angle_deg": [30] * 8},
            2: {"footprint_xy_m": nonagon.ravel(), "ring_offset": [0, 9], "angle_deg": [30] * 9},
            3: {"eave_height_m": 71.0},
            4: {"footprint_xy_m": (ring * 12.0).ravel()},
            5: {"eave_height_m": None},
            6: {"split": "guard"},
        },
    )
    loaded = load_dataset(changed, ["train"], LIMITS, labelled=True, include_real=False)
    assert len(loaded) == 23
    assert loaded.num_excluded == {
        "too-few-points": 1,
        "has-courtyards": 1,
        "too-many-vertices": 1,
        "height-out-of-range": 1,
        "footprint-too-large": 1,
        "no-labels": 1,
    }
    assert "1 has-courtyards" in describe(loaded)


def test_nothing_left_and_broken_manifests_are_one_clear_line(manifest: Path, tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"no building of split train can be used \(excluded: 30 too-few-points"
    ):
        load_dataset(manifest, ["train"], TrainingLimits(10**6, 8, 70), labelled=True, include_real=False)
    (tmp_path / "m.json").write_text('{"files": []}')
    with pytest.raises(InputError, match="not a manifest of crops"):
        load_dataset(tmp_path / "m.json", ["train"], LIMITS, labelled=True, include_real=False)
    (tmp_path / "m.json").write_text('{"shards": [{"path": "gone.parquet", "dataset": "simulated"}]}')
    with pytest.raises(InputError, match=r"lists gone\.parquet, which does not exist"):
        load_dataset(tmp_path / "m.json", ["train"], LIMITS, labelled=True, include_real=False)


def test_a_batch_holds_the_rows_of_the_shard(manifest: Path) -> None:
    train = load_dataset(manifest, ["train"], LIMITS, labelled=True, include_real=False)
    table = pq.read_table(manifest.parent / "0001_0001.parquet")
    batch = train.batch(np.array([7, 2]), 10**6, None)
    for row, i in enumerate((7, 2)):
        points = batch.points[row][batch.valid[row]].numpy()
        cm = np.column_stack([table[name][i].as_py() for name in ("x_cm", "y_cm", "z_cm")])
        assert np.allclose(points, cm / 100, atol=1e-5)
        assert np.allclose(batch.xy[row].numpy().ravel(), table["footprint_xy_m"][i].as_py(), atol=1e-5)
        assert batch.angle[row].tolist() == table["angle_deg"][i].as_py()
    thinned = train.batch(np.array([7, 2]), 100, 0)
    assert thinned.valid.sum(1).tolist() == [100, 100]
    whole = {tuple(p) for p in batch.points[0].tolist()}
    chosen = [tuple(p) for p in thinned.points[0].tolist()]
    assert set(chosen) <= whole
    again = train.batch(np.array([2, 7]), 100, None)
    assert torch.equal(again.points[1], train.batch(np.array([7]), 100, None).points[0])


def test_an_epoch_visits_every_building_once_in_batches_of_similar_length() -> None:
    num = np.random.default_rng(0).integers(3, 17, 1000)
    order = BatchSampler(num, 32, seed=1)
    epoch = [order.batch(step) for step in range(31)]
    visited = np.concatenate(epoch)
    assert len(set(visited)) == len(visited) == 31 * 32
    spread = np.mean([np.ptp(num[batch]) for batch in epoch])
    assert spread < 4 < np.ptp(num)
    assert not np.array_equal(order.batch(31), epoch[0])
    # any step can come first
    assert np.array_equal(BatchSampler(num, 32, seed=1).batch(40), order.batch(40))
    assert len(BatchSampler(num[:5], 32, seed=1).batch(3)) == 5


def test_the_decoded_files_are_found_again_and_hold_the_same(
    manifest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = (["train"], LIMITS, True, False)
    plain = load_dataset(manifest, *arguments)
    first = load_dataset(manifest, *arguments, cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    with monkeypatch.context() as patch:
        patch.setattr(shards, "_read_shard", lambda *_: pytest.fail("decoded again"))
        second = load_dataset(manifest, *arguments, cache=tmp_path)
    for name in vars(plain):
        if name not in ("num_excluded", "folder"):
            assert np.array_equal(getattr(plain, name), getattr(first, name))
            assert np.array_equal(getattr(plain, name), getattr(second, name))
    assert plain.num_excluded == second.num_excluded
    load_dataset(manifest, ["val"], LIMITS, True, False, cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_an_interrupted_decoding_leaves_nothing(
    manifest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dies(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", dies)
    with pytest.raises(KeyboardInterrupt):
        load_dataset(manifest, ["train"], LIMITS, True, False, cache=tmp_path)
    assert not list(tmp_path.iterdir())


def test_thinning_selects_every_point_equally_often_and_in_order() -> None:
    count = np.zeros(50)
    for seed in range(4000):
        chosen = np.empty(20, np.int64)
        dataset._select(50, dataset._random_states(np.array([3]), np.array([50]), seed * 7919)[0], chosen)
        assert (np.diff(chosen) > 0).all() and chosen[-1] < 50
        count[chosen] += 1
    # 4,000 draws of 2 in 5: 5 standard deviations
    assert np.abs(count / 4000 - 0.4).max() < 5 * (0.4 * 0.6 / 4000) ** 0.5
    assert dataset.thin(10, 20).tolist() == list(range(10))


def test_patches_are_computed_once_and_only_of_clouds_that_are_not_thinned(
    manifest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cpu = torch.device("cpu")
    train = load_dataset(manifest, ["train"], LIMITS, True, False, cache=tmp_path)
    size = np.diff(train.point_offset)
    cut = PatchSettings(int(np.median(size)), 6, 8)
    whole = size <= cut.num_points
    assert 0 < whole.sum() < len(train)
    monkeypatch.setattr(patch_cache, "_BATCH_SIZE", 4)
    first = precompute_patches(train, cut, cpu)
    monkeypatch.setattr(patch_cache, "_fill_patch_index", lambda *_: pytest.fail("computed again"))
    second = precompute_patches(train, cut, cpu)
    monkeypatch.undo()
    in_memory = precompute_patches(
        load_dataset(manifest, ["train"], LIMITS, True, False), cut, torch.device("cpu")
    )
    assert first.patch_index is not None and first.patch_index.dtype == np.int16
    assert np.array_equal(first.patch_index, second.patch_index)
    assert np.array_equal(first.patch_index, in_memory.patch_index)
    assert (first.patch_index[~whole] == UNKNOWN_PATCHES).all()
    index = np.array([np.flatnonzero(whole)[-1], np.flatnonzero(~whole)[0]])
    batch = first.batch(index, cut.num_points, 7)
    expected = patch_index(batch.points[:1], batch.valid[:1], 6, 8)
    assert batch.patch_index is not None and torch.equal(batch.patch_index[:1].long(), expected)


def test_an_interrupted_computation_of_patches_leaves_nothing(
    manifest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    train = load_dataset(manifest, ["train"], LIMITS, True, False, cache=tmp_path)
    before = sorted(tmp_path.rglob("*"))

    def dies(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(patch_cache, "patch_index", dies)
    with pytest.raises(KeyboardInterrupt):
        precompute_patches(train, PatchSettings(10**6, 4, 8), torch.device("cpu"))
    assert sorted(tmp_path.rglob("*")) == before
    monkeypatch.undo()
    loaded = precompute_patches(train, PatchSettings(10**6, 4, 8), torch.device("cpu"))
    assert loaded.folder is not None and loaded.patch_index is not None
    expected = loaded.patch_index.copy()
    next(loaded.folder.glob("patches-*")).write_bytes(b"cut off")
    again = precompute_patches(train, PatchSettings(10**6, 4, 8), torch.device("cpu"))
    assert "patches-1000000-4x8.i16: damaged; computing the patches again" in caplog.text
    assert again.patch_index is not None
    assert np.array_equal(again.patch_index, expected)


def test_resident_clouds_give_the_same_batches(manifest: Path) -> None:
    train = load_dataset(manifest, ["train"], LIMITS, labelled=True, include_real=False)
    train = precompute_patches(train, PatchSettings(10**6, 4, 8), torch.device("cpu"))
    resident = dataset.ResidentDataset(train, torch.device("cpu"))
    index = np.array([5, 1, 9])
    for seed in (None, 4):
        ours, other = train.batch(index, 10**6, seed), resident.batch(index, 10**6, seed)
        for name in vars(ours):
            assert torch.allclose(getattr(ours, name), getattr(other, name), atol=1e-6), name
    thinned = resident.batch(index, 100, 4)
    assert thinned.valid.sum(1).tolist() == [100] * 3
    whole = {
        tuple(np.round(100 * p).astype(int)) for p in train.batch(index[:1], 10**6, None).points[0].numpy()
    }
    assert {tuple(np.round(100 * p).astype(int)) for p in thinned.points[0].numpy()} <= whole
