"""Stage model on simple crops: training, weights, prediction."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import toy_crops
from places import ROOT
from small_networks import SMALL_DVAE, SMALL_MODEL

from p2wss import cli
from p2wss.config import Model, load
from p2wss.nets import distributed
from p2wss.nets.batch import Batch, thin
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.point2wss import Point2Wss, inference_weights
from p2wss.nets.prediction import Prediction
from p2wss.nets.predictor import Point2WssPredictor, load_predictor
from p2wss.nets.weights import save_dvae
from p2wss.storage import integrity
from p2wss.storage.messages import InputError
from p2wss.training import model
from p2wss.training.dataset import BuildingDataset, TrainingLimits, load_dataset


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Crops, an untrained tokenizer and a hardly trained model, by the commands."""
    folder = tmp_path_factory.mktemp("model")
    manifest = toy_crops.make(folder, {"train": 24, "val": 8, "test": 20})
    config = load({"dvae": SMALL_DVAE}).dvae
    torch.manual_seed(0)
    save_dvae(DiscreteVae(config), folder / "d.safetensors", "x", "")
    arguments = ["model", "--manifest", str(manifest), "--dvae", str(folder / "d.safetensors")]
    arguments += ["--out", str(folder / "m.safetensors")]
    arguments += ["--out-metrics", str(folder / "m.jsonl"), "--checkpoints", str(folder / "c")]
    assert cli.main([*arguments, "--config", json.dumps({"model": SMALL_MODEL | {"num_validation": 4}})]) == 0
    return folder


@pytest.fixture(scope="module")
def predictor(folder: Path) -> Point2WssPredictor:
    return load_predictor(folder / "m.safetensors")


@pytest.fixture(scope="module")
def labelled(folder: Path) -> BuildingDataset:
    return load_dataset(
        folder / "manifest.json", ["test"], TrainingLimits(64, 8, 70), labelled=True, include_real=False
    )


def inputs(buildings: BuildingDataset) -> tuple[list[np.ndarray], list[list[np.ndarray]]]:
    """Clouds with z above the ground, and rings."""
    clouds, rings = [], []
    for i in range(len(buildings)):
        points = slice(buildings.point_offset[i], buildings.point_offset[i + 1])
        cloud = buildings.points_cm[points] / 100.0
        clouds.append(cloud - [0, 0, buildings.ground_z_m[i]])
        rings.append([buildings.xy_m[buildings.vertex_offset[i] : buildings.vertex_offset[i + 1]]])
    return clouds, rings


def test_metrics_show_the_constant_predictor_beside_the_model(folder: Path) -> None:
    records = [json.loads(line) for line in integrity.read_lines(folder / "m.jsonl")]
    last = records[-1]
    assert last["step"] == 10 and last["val_height_mae_m"] > 0 and last["val_angle_mae_deg"] > 0
    train = load_dataset(
        folder / "manifest.json", ["train"], TrainingLimits(64, 8, 70), labelled=True, include_real=False
    )
    val = load_dataset(
        folder / "manifest.json", ["val"], TrainingLimits(64, 8, 70), labelled=True, include_real=False
    )
    # four of eight, from the first to the last
    angle_deg = np.concatenate([val.edge_angles_deg(i) for i in np.arange(0, 8, 2)])
    expected = np.abs(val.height_m[::2] - np.median(train.height_m)).mean()
    assert last["val_height_mae_constant_m"] == pytest.approx(expected, rel=1e-5)
    expected = np.abs(angle_deg - np.median(train.angle_deg)).mean()
    assert last["val_angle_mae_constant_deg"] == pytest.approx(expected, rel=1e-5)


def test_interrupted_and_resumed_is_uninterrupted_to_the_bit(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = load({"model": SMALL_MODEL}).model
    data = folder / "manifest.json", folder / "d.safetensors", config
    expected = model.train(*data, tmp_path / "one", "x").state_dict()
    real = model.ModelTask.step

    def dies(self: model.ModelTask, step: int, loaded: Any) -> dict[str, torch.Tensor]:
        if step == 7:
            raise KeyboardInterrupt
        return real(self, step, loaded)

    monkeypatch.setattr(model.ModelTask, "step", dies)
    with pytest.raises(KeyboardInterrupt):
        model.train(*data, tmp_path / "two", "x")
    monkeypatch.setattr(model.ModelTask, "step", real)
    resumed = model.train(*data, tmp_path / "two", "x").state_dict()
    assert all(torch.equal(expected[name], resumed[name]) for name in expected)


@pytest.mark.parametrize("key", ["dvae_start", "similar_lengths"])
def test_the_papers_start_and_batches_are_others(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, key: str
) -> None:
    """The weights before the first step, or the lengths by which batches are made, differ by the setting."""
    seen: dict[bool, tuple[torch.Tensor, list[int]]] = {}

    def stops(self: model.ModelTask, step: int, loaded: Any) -> dict[str, torch.Tensor]:
        weights = torch.cat([each.detach().ravel() for each in self.module.cloud.embed.parameters()])
        seen[value] = weights, self.sampler.num_vertices.tolist()
        raise StopIteration

    monkeypatch.setattr(model.ModelTask, "step", stops)
    for value in (True, False):
        config = load({"model": {**SMALL_MODEL, key: value}}).model
        with pytest.raises(StopIteration):
            model.train(
                folder / "manifest.json", folder / "d.safetensors", config, tmp_path / str(value), "x"
            )
    assert torch.equal(seen[True][0], seen[False][0]) is (key != "dvae_start")
    assert (seen[True][1] == seen[False][1]) is (key != "similar_lengths")


def test_predictions_do_not_depend_on_the_order_or_on_other_buildings(
    predictor: Point2WssPredictor, labelled: BuildingDataset
) -> None:
    clouds, rings = inputs(labelled)
    together = predictor.predict(clouds, rings)
    backwards = predictor.predict(clouds[::-1], rings[::-1])
    alone = [predictor.predict([c], [r]) for c, r in zip(clouds, rings, strict=True)]
    for i, single in enumerate(alone):
        assert values(together, i) == values(single, 0) == values(backwards, len(alone) - 1 - i)


def values(prediction: Prediction, building: int) -> tuple[bytes, ...]:
    """Everything that is predicted of a building, to the bit."""
    return tuple(np.asarray(column[building]).tobytes() for column in vars(prediction).values())


@pytest.mark.parametrize(("num_views", "num_buildings"), [(1, 68), (3, 24)])
def test_predictions_are_the_same_to_the_bit_in_any_batch_and_on_any_number_of_threads(
    num_views: int, num_buildings: int
) -> None:
    shipped = load_predictor(ROOT / "models/point2wss.safetensors", "cpu")
    predictor = Point2WssPredictor(shipped.module, num_views)
    draw = np.random.default_rng(0)
    clouds, rings = [], []
    sizes = zip(draw.integers(4, 17, num_buildings), draw.integers(16, 2000, num_buildings), strict=True)
    for num_vertices, num_points in sizes:
        angle, radius_m = np.sort(draw.uniform(0, 2 * np.pi, num_vertices)), draw.uniform(4, 12, num_vertices)
        rings.append([np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle)])])
        xyz_m = np.column_stack([draw.uniform(-12, 12, (num_points, 2)), draw.uniform(0, 9, num_points)])
        clouds.append(np.round(xyz_m, 2))
    together = predictor.predict(clouds, rings)
    num_threads = torch.get_num_threads()
    try:
        for batch_size, threads in ((1, 1), (7, 2), (12, 1), (64, 2)):
            torch.set_num_threads(threads)
            order = draw.permutation(num_buildings)[: max(batch_size, 12)]
            for first in range(0, len(order), batch_size):
                rows = order[first : first + batch_size]
                prediction = predictor.predict([clouds[i] for i in rows], [rings[i] for i in rows])
                for row, i in enumerate(rows):
                    assert values(prediction, row) == values(together, i), (batch_size, threads, i)
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(num_threads)


def test_passes_of_many_rows_have_sizes_that_follow_from_each_building(
    predictor: Point2WssPredictor, labelled: BuildingDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a GPU, where a matrix product of the same sizes rounds each row in the same way."""
    clouds, rings = inputs(labelled)
    clouds, rings = clouds[:7], [*rings[:6], [np.array([[0, 0], [9, 0], [9, 5], [5, 5], [5, 9.0]])]]
    rings[3] = [rings[3][0] * 30]  # beyond the number format
    expected = predictor.predict(clouds, rings)
    monkeypatch.setattr(predictor, "_rows_per_pass", 4)
    sizes = []
    decode = predictor._decode

    def spy(batch: Batch) -> object:
        sizes.append((*batch.points.shape, *batch.xy.shape))
        return decode(batch)

    monkeypatch.setattr(predictor, "_decode", spy)
    prediction = predictor.predict(clouds, rings)
    assert sizes == [(4, 128, 3, 4, 8, 2)] * 2
    assert np.flatnonzero(np.isnan(prediction.eave_height_m)).tolist() == [3]
    assert np.allclose(prediction.eave_height_m, expected.eave_height_m, atol=0.011, equal_nan=True)
    for a, b in zip(prediction.angle_deg, expected.angle_deg, strict=True):
        assert np.allclose(a, b, atol=1, equal_nan=True)


def test_predictions_follow_the_vertex_order_of_the_ring(
    predictor: Point2WssPredictor, labelled: BuildingDataset
) -> None:
    """Another first vertex rolls the angles; a shift of cloud and ring changes nothing."""
    clouds, rings = inputs(labelled)
    straight = predictor.predict(clouds, rings)
    rolled = predictor.predict(clouds, [[np.roll(r[0], 1, 0)] for r in rings])
    moved = predictor.predict(
        [c + np.array([500, -300, 0]) for c in clouds], [[r[0] + [500, -300]] for r in rings]
    )
    for a, b, c in zip(straight.angle_deg, rolled.angle_deg, moved.angle_deg, strict=True):
        assert np.array_equal(np.roll(a, 1), b)
        assert np.abs(a - c).mean() < 2  # float32 may tip a rounded coordinate
    assert np.allclose(straight.eave_height_m, moved.eave_height_m, atol=0.3)


def test_two_processes_choose_the_clouds_that_one_would(
    labelled: BuildingDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of which only the points on the building are kept: each process has half of the rows, not the same draws."""
    augmentation = {"on_building_share": 0.5}
    config = load({"dvae": SMALL_DVAE, "model": {**SMALL_MODEL, "augmentation": augmentation}})
    task = model.ModelTask(Point2Wss(config.model, config.dvae), DiscreteVae(config.dvae), labelled, labelled)
    chosen: list[dict[int, bool]] = []
    batch = BuildingDataset.batch

    def records(
        self: BuildingDataset, index: np.ndarray, num: int, seed: int, on_building: np.ndarray
    ) -> Batch:
        chosen[-1] |= dict(zip(index.tolist(), on_building.tolist(), strict=True))
        return batch(self, index, num, seed, on_building)

    monkeypatch.setattr(BuildingDataset, "batch", records)
    for num_processes in (1, 2):
        chosen.append({})
        monkeypatch.setattr(distributed, "num_processes", lambda num=num_processes: num)
        for rank in range(num_processes):
            monkeypatch.setattr(distributed, "rank", lambda rank=rank: rank)
            task.load(0)
    assert chosen[0] == chosen[1] and 0 < sum(chosen[0].values()) < len(chosen[0])


def test_errors_of_labelled_buildings_are_those_of_their_predictions(
    predictor: Point2WssPredictor, labelled: BuildingDataset
) -> None:
    clouds, rings = inputs(labelled)
    prediction = predictor.predict(clouds, rings)
    height, angle = model.prediction_errors(predictor, labelled, np.arange(len(labelled)))
    assert np.allclose(prediction.eave_height_m - labelled.height_m, height, atol=0.02)
    assert np.array_equal(np.concatenate(prediction.angle_deg) - labelled.angle_deg, angle)


def test_errors_of_a_network_of_points_on_buildings_are_with_these_alone(
    predictor: Point2WssPredictor, labelled: BuildingDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a reconstruction gives them to it."""
    monkeypatch.setattr(predictor, "on_building", True)
    clouds, rings = inputs(labelled)
    num_on = labelled.num_on_building
    assert (num_on < np.diff(labelled.point_offset)).any()
    clouds = [cloud[: num or None] for cloud, num in zip(clouds, num_on, strict=True)]
    height, _ = model.prediction_errors(predictor, labelled, np.arange(len(labelled)))
    assert np.allclose(predictor.predict(clouds, rings).eave_height_m - labelled.height_m, height, atol=1e-4)


def test_courtyards_get_the_median_slope(predictor: Point2WssPredictor, labelled: BuildingDataset) -> None:
    clouds, rings = inputs(labelled)
    hole = np.array([[0, 0], [0, 1], [1, 1], [1, 0.0]])
    plain, pierced = predictor.predict(clouds, rings), predictor.predict(clouds, [[*r, hole] for r in rings])
    for a, b in zip(plain.angle_deg, pierced.angle_deg, strict=True):
        assert np.array_equal(a, b[:4]) and len(b) == 8
        slopes = a[a < 90]
        assert (b[4:] == np.median(slopes if len(slopes) else a)).all()


def test_a_footprint_beyond_the_number_format_has_no_prediction(
    predictor: Point2WssPredictor, labelled: BuildingDataset
) -> None:
    clouds, rings = inputs(labelled)
    rings[3] = [rings[3][0] * 30]
    prediction = predictor.predict(clouds, rings)
    assert np.flatnonzero(np.isnan(prediction.eave_height_m)).tolist() == [3]
    assert np.isnan(prediction.angle_deg[3]).all()
    with pytest.raises(ValueError, match="building 0 has 9 vertices, not 3 to 8"):
        predictor.predict(clouds[:1], [[np.zeros((9, 2))]])
    with pytest.raises(ValueError, match="building 0 has no points"):
        predictor.predict([np.zeros((0, 3))], rings[:1])


@pytest.mark.parametrize("signs_visible", [True, False])
def test_footprints_predicted_from_masked_digits_keep_frame_and_order(
    predictor: Point2WssPredictor, labelled: BuildingDataset, signs_visible: bool
) -> None:
    clouds, rings = inputs(labelled)
    exterior = [r[0] for r in rings]
    height, xy, angle = predictor.reconstruct_all_masked(clouds, exterior, signs_visible)
    assert np.isfinite(height).all() and all(len(a) == 4 for a in angle)
    shift = np.array([500, -300])
    _, moved, _ = predictor.reconstruct_all_masked(
        [c + np.append(shift, 0) for c in clouds], [r + shift for r in exterior], signs_visible
    )
    middle = [c[thin(len(c), SMALL_DVAE["num_points"])].mean(0)[:2] for c in clouds]
    for place, other, ring, at in zip(xy, moved, exterior, middle, strict=True):
        assert place.shape == ring.shape
        if signs_visible:  # the signs are those of the footprint
            ring = np.round(ring - at, 1)
            guess = place - at
            clear = (np.abs(ring) > 0.3) & (np.abs(guess) > 0.3)
            assert (np.sign(guess) == np.sign(ring))[clear].all()
        assert np.abs(place + shift - other).mean() < 1


def test_every_view_of_a_predicted_footprint_is_representable(
    predictor: Point2WssPredictor, labelled: BuildingDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Corners at 99.9 m in x and in y: an eighth of a turn later, x would be 141 m."""
    clouds, rings = inputs(labelled)
    other = Point2WssPredictor(predictor.module, num_views=8)
    most = predictor.tokenizer.max_coord

    def farthest(_self: object, blocks: torch.Tensor, _logits: torch.Tensor) -> torch.Tensor:
        return torch.full((*blocks.shape[:2], 2), most)

    monkeypatch.setattr(Point2WssPredictor, "_coordinates", farthest)
    height, xy, _ = other.reconstruct_all_masked(clouds[:1], [rings[0][0]])
    assert np.isfinite(height).all() and xy[0].max() > 90


def test_a_predicted_footprint_is_given_to_the_network_again(
    predictor: Point2WssPredictor, labelled: BuildingDataset
) -> None:
    """Height and angles are those of the predicted footprint; before that, its coordinates are predicted again."""
    clouds, rings = inputs(labelled)
    exterior = [r[0] for r in rings]

    def reconstructed(num_refinements: int) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        other = Point2WssPredictor(predictor.module)
        other.settings = other.settings.model_copy(update={"num_refinements": num_refinements})
        return other.reconstruct_all_masked(clouds, exterior)

    (_, plain, _), (height, once, angle), (_, twice, _) = map(reconstructed, range(3))
    assert np.array_equal(np.concatenate(plain), np.concatenate(once))
    assert not np.allclose(np.concatenate(plain), np.concatenate(twice), atol=0.05)
    again = predictor.predict(clouds, [[ring] for ring in once])
    assert np.array_equal(again.eave_height_m, height)
    assert np.array_equal(np.concatenate(again.angle_deg), np.concatenate(angle))


def test_a_training_starts_from_given_weights(folder: Path, tmp_path: Path) -> None:
    start = str(folder / "m.safetensors")
    few = SMALL_MODEL | {"start": start, "seed": 5, "optimiser": {"num_steps": 1, "batch_size": 8}}
    few |= {"auxiliary_share": 0}
    config = load({"model": few}).model
    trained = model.train(folder / "manifest.json", folder / "d.safetensors", config, tmp_path, "x")
    module = trained.state_dict()
    weights = load_predictor(folder / "m.safetensors", "cpu").module.state_dict()
    # a step moves each weight by about the rate; moments of batch norms follow the data
    for name, value in inference_weights(weights).items():
        if value.is_floating_point() and "running" not in name:
            assert torch.allclose(module[name], value, atol=0.01), name


def test_files_of_another_kind_are_rejected(folder: Path) -> None:
    with pytest.raises(InputError, match="not a model of p2wss"):
        load_predictor(folder / "d.safetensors")


def test_the_papers_preset_is_a_valid_override() -> None:
    paper = load(ROOT / "config" / "paper.yaml").model
    assert paper.dim == 384 and paper.masking.random_ratio == (0.3, 0.3)
    assert Point2Wss(paper, load(ROOT / "config" / "paper.yaml").dvae).tokenizer.vocabulary_size == 61
    assert Model().masking.inference_share == 0.8


@pytest.mark.slow
def test_eight_buildings_can_be_memorised(folder: Path, tmp_path: Path) -> None:
    manifest = toy_crops.make(tmp_path, {"train": 8, "val": 8}, seed=4)
    config = load(
        {
            "model": SMALL_MODEL
            | {
                "dim": 64,
                "cross_depth": 2,
                "augmentation": {"lift_m": 0, "scale": [1, 1], "keep_points": [1, 1]},
                "checkpoint_every_steps": 400,
                "optimiser": {"num_steps": 800, "batch_size": 8},
            }
        }
    ).model
    module = model.train(manifest, folder / "d.safetensors", config, tmp_path / "c", "x")
    training_set = load_dataset(
        manifest, ["train"], TrainingLimits(64, 8, 70), labelled=True, include_real=False
    )
    height, angle = model.prediction_errors(Point2WssPredictor(module), training_set, np.arange(8))
    assert np.abs(height).mean() < 0.1 and np.abs(angle).mean() < 1


def test_bfloat16_and_the_device_option_train_too(folder: Path, tmp_path: Path) -> None:
    few = SMALL_MODEL | {
        "optimiser": {"num_steps": 4, "batch_size": 8},
        "compute": {"precision": "bfloat16"},
    }
    arguments = [
        "model",
        "--manifest",
        str(folder / "manifest.json"),
        "--dvae",
        str(folder / "d.safetensors"),
    ]
    arguments += ["--out", str(tmp_path / "m.safetensors"), "--out-metrics", str(tmp_path / "m.jsonl")]
    arguments += ["--checkpoints", str(tmp_path / "c"), "--device", "cpu"]
    assert cli.main([*arguments, "--config", json.dumps({"model": few})]) == 0
    assert (
        load_predictor(tmp_path / "m.safetensors", "cpu").module.sequence_head.weight.dtype == torch.float32
    )
    assert not (tmp_path / "c").exists()
