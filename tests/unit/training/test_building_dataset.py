"""From shards to batches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely
import torch
import toy_crops

from p2wss.data.points import points_on_building
from p2wss.nets.batch import thin
from p2wss.storage import files
from p2wss.storage.messages import InputError
from p2wss.storage.schemas.crops import CROPS
from p2wss.training.dataset import BatchSampler, TrainingLimits, describe, load_dataset

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
        ring_m = np.reshape(table["footprint_xy_m"][i].as_py(), (-1, 2))
        above_m = cm / 100 - [0.0, 0.0, table["ground_z_m"][i].as_py() - table["origin_z_m"][i].as_py()]
        is_on = points_on_building(
            shapely.Polygon(ring_m), above_m, np.array(table["classification"][i].as_py())
        )
        # those on the building come first
        assert np.allclose(points, np.vstack([cm[is_on], cm[~is_on]]) / 100, atol=1e-5)
        assert np.allclose(batch.xy[row].numpy().ravel(), table["footprint_xy_m"][i].as_py(), atol=1e-5)
        assert batch.angle[row].tolist() == table["angle_deg"][i].as_py()
    thinned = train.batch(np.array([7, 2]), 100, 0)
    assert thinned.valid.sum(1).tolist() == [100, 100]
    whole = {tuple(p) for p in batch.points[0].tolist()}
    chosen = [tuple(p) for p in thinned.points[0].tolist()]
    assert set(chosen) <= whole
    again = train.batch(np.array([2, 7]), 100, None)
    assert torch.equal(again.points[1], train.batch(np.array([7]), 100, None).points[0])


def test_a_batch_may_hold_only_the_points_on_the_building(manifest: Path) -> None:
    train = load_dataset(manifest, ["train"], LIMITS, labelled=True)
    index = np.array([7, 2])
    every, some = train.batch(index, 10**6, 0), train.batch(index, 10**6, 0, np.array([False, True]))
    assert some.valid[0].sum() == every.valid[0].sum()
    num_on = some.valid[1].sum().item()
    assert 0 < num_on == train.num_on_building[2] < every.valid[1].sum()
    inside = shapely.contains_xy(shapely.Polygon(train.ring_m(2)), *some.points[1, :num_on, :2].T.numpy())
    assert inside.all() and (some.points[1, :num_on, 2] > train.ground_z_m[2] + 1).all()


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


def test_thinning_selects_every_point_equally_often_and_in_order() -> None:
    count = np.zeros(50)
    for seed in range(4000):
        chosen = thin(50, 20, seed * 7919)
        assert (np.diff(chosen) > 0).all() and chosen[-1] < 50
        count[chosen] += 1
    # 4,000 draws of 2 in 5: 5 standard deviations
    assert np.abs(count / 4000 - 0.4).max() < 5 * (0.4 * 0.6 / 4000) ** 0.5
    assert thin(10, 20).tolist() == list(range(10))


def test_the_points_leave_no_file_and_a_full_disk_is_one_clear_line(
    manifest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = load_dataset(manifest, ["train"], LIMITS, labelled=True, folder=tmp_path)
    assert len(loaded.points_cm) == loaded.point_offset[-1] and not list(tmp_path.iterdir())

    def full(**_: object) -> object:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tempfile.TemporaryFile", full)
    with pytest.raises(InputError, match="temporary file: not written: No space left on device"):
        load_dataset(manifest, ["train"], LIMITS, labelled=True, folder=tmp_path)
