"""The table of the ablation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
import toy_crops
from places import ROOT
from small_networks import SMALL_DVAE, SMALL_MODEL

from p2wss import cli
from p2wss.config import ablated, load
from p2wss.nets.point2wss import Point2Wss
from p2wss.nets.predictor import load_predictor
from p2wss.nets.weights import save_model
from p2wss.storage.messages import InputError
from p2wss.training import ablation
from p2wss.training.dataset import TrainingLimits, load_dataset, training_limits


def test_a_variant_changes_what_it_names_and_nothing_else() -> None:
    config = load({"ablation": {"variants": {"a": {"masking": {"table1_share": 0.5}}}}})
    changed = ablated(config, "a").model
    assert changed.masking.table1_share == 0.5
    back = changed.masking.model_copy(update={"table1_share": config.model.masking.table1_share})
    assert changed.model_copy(update={"masking": back}) == config.model


def test_the_variant_of_the_paper_is_its_config() -> None:
    """But for sizes, lengths and the number format, which the budget decides."""
    ours = ablated(load({}), "paper").model
    paper = load(ROOT / "config" / "paper.yaml").model
    for name in (
        "masking",
        "decoding",
        "augmentation",
        "loss_weights",
        "match_balanced",
        "auxiliary_share",
        "dvae_start",
        "similar_lengths",
    ):
        assert getattr(ours, name) == getattr(paper, name), name


def test_a_variant_with_a_wrong_key_is_one_clear_line() -> None:
    with pytest.raises(InputError, match=r"ablation\.variants\.a\.dimm: Extra inputs"):
        load({"ablation": {"variants": {"a": {"dimm": 3}}}})


def test_seeds_are_summed_up_below_the_table() -> None:
    rows = [("a", 0.1, 2.0), ("a_seed_1", 0.3, 4.0), ("b", 9.0, 9.0)]
    table = pd.DataFrame(rows, columns=["variant", "height_mae_m", "angle_mae_deg"])
    spreads = ablation.spreads(table)
    assert list(spreads.index) == ["a"]
    assert spreads.loc["a"].tolist() == pytest.approx([2, 0.2, 0.1 * 2**0.5, 2, 3.0, 2**0.5])


def test_the_table_holds_the_errors_on_the_test_split(tmp_path: Path) -> None:
    manifest = toy_crops.make(tmp_path, {"train": 12, "val": 4, "test": 10})
    config = load({"dvae": SMALL_DVAE, "model": SMALL_MODEL})
    torch.manual_seed(0)
    paths = []
    for name in ("one", "two"):
        module = Point2Wss(config.model, config.dvae)
        paths.append(tmp_path / name / "model.safetensors")
        save_model(module, paths[-1], "x", "")
    arguments = ["--manifest", str(manifest), "--models", *map(str, paths)]
    arguments += ["--out", str(tmp_path / "t.csv")]
    assert cli.main(["eval", "ablation", *arguments, "--device", "cpu"]) == 0
    header, *lines = (tmp_path / "t.csv").read_text().splitlines()
    rows = [dict(zip(header.split(","), line.split(","), strict=True)) for line in lines]
    assert [row["variant"] for row in rows] == ["one", "two"]
    test = load_dataset(manifest, ["test"], TrainingLimits(64, 8, 70), labelled=True, include_real=False)
    clouds, rings = [], []
    for i in range(len(test)):
        points = test.points_cm[test.point_offset[i] : test.point_offset[i + 1]] / 100
        clouds.append(points - [0, 0, test.ground_z_m[i]])
        rings.append([test.xy_m[test.vertex_offset[i] : test.vertex_offset[i + 1]]])
    prediction = load_predictor(paths[1], "cpu").predict(clouds, rings)
    expected = np.abs(prediction.eave_height_m - test.height_m).mean()
    # centimetres may fall either way: the frames differ by the ground
    assert float(rows[1]["height_mae_m"]) == pytest.approx(expected, abs=0.05)
    assert rows[0]["num_buildings"] == "10"


def test_variants_are_measured_on_the_same_buildings(tmp_path: Path) -> None:
    """One variant raises roofs in training, and so takes lower buildings than the other."""
    manifest = toy_crops.make(tmp_path, {"train": 1, "val": 1, "test": 10})
    config = load({"dvae": SMALL_DVAE, "model": SMALL_MODEL})
    limit_m = training_limits(config.model, config.dvae).max_length_m
    augmentation = config.model.augmentation
    augmentation = augmentation.model_copy(update={"lift_m": augmentation.lift_m + limit_m - 10})
    variants = {
        "plain": config.model,
        "lifted": config.model.model_copy(update={"augmentation": augmentation}),
    }
    paths = [tmp_path / name / "model.safetensors" for name in variants]
    for path, model in zip(paths, variants.values(), strict=True):
        save_model(Point2Wss(model, config.dvae), path, "x", "")
    together, alone = ablation.measure(manifest, paths, "cpu"), ablation.measure(manifest, paths[:1], "cpu")
    num = set(together["num_buildings"])
    assert len(num) == 1 and 0 < num.pop() < alone["num_buildings"][0] == 10
