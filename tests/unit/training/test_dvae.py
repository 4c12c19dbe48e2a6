"""Stage dvae on simple crops."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import toy_crops
from small_networks import SMALL_DVAE

from p2wss import cli
from p2wss.config import load
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.patches import Patches
from p2wss.nets.weights import load_dvae
from p2wss.storage.messages import InputError
from p2wss.training import dvae
from p2wss.training.dataset import TrainingLimits, load_dataset


@pytest.fixture(scope="module")
def manifest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return toy_crops.make(tmp_path_factory.mktemp("crops"), {"train": 24, "val": 8}, lidar=8)


def test_the_command_trains_and_the_weights_load(manifest: Path, tmp_path: Path) -> None:
    out, metrics, checkpoints = tmp_path / "d.safetensors", tmp_path / "m.jsonl", tmp_path / "checkpoints"
    arguments = ["dvae", "--manifest", str(manifest), "--out", str(out)]
    arguments += ["--out-metrics", str(metrics), "--checkpoints", str(checkpoints)]
    assert cli.main([*arguments, "--config", json.dumps({"dvae": SMALL_DVAE})]) == 0
    assert not checkpoints.exists()
    records = [json.loads(line) for line in metrics.read_text().splitlines()]
    measured = [r["val_chamfer_m"] for r in records if "val_chamfer_m" in r]
    assert len(measured) == 3 and measured[-1] < 0.97 * measured[0]
    assert next(r for r in records if "loss" in r)["fine"] > 0
    assert {"temperature", "kl_weight", "perplexity"} <= set().union(*records)
    module = load_dvae(out)
    assert module.config == load({"dvae": SMALL_DVAE}).dvae
    assert not any(p.requires_grad for p in module.parameters())


def test_the_same_seed_gives_the_same_weights_and_another_seed_others(manifest: Path, tmp_path: Path) -> None:
    few = SMALL_DVAE | {"optimiser": {"num_steps": 3, "batch_size": 8}}
    states = [
        dvae.train(manifest, load({"dvae": few | {"seed": seed}}).dvae, tmp_path / str(i), "x").state_dict()
        for i, seed in enumerate((0, 0, 1))
    ]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    assert not torch.equal(states[0]["codebook"], states[2]["codebook"])


def test_a_collapsed_codebook_is_refused(
    manifest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dvae, "MIN_CODE_USAGE", 1.1)
    with pytest.raises(InputError, match=r"codebook collapsed: .* of 16 codes in use"):
        dvae.train(manifest, load({"dvae": SMALL_DVAE}).dvae, tmp_path, "x")


def test_surplus_patches_do_not_count_for_the_perplexity(manifest: Path) -> None:
    """A cloud of three points has three patches of its own; the others repeat them."""
    config = load({"dvae": SMALL_DVAE}).dvae
    buildings = load_dataset(manifest, ["train"], TrainingLimits(64, 0, 0), labelled=False)
    task = dvae.DvaeTask(DiscreteVae(config), buildings, buildings)

    def coded(patches: Patches, _temperature: torch.Tensor) -> dict[str, torch.Tensor]:
        losses = {name: torch.zeros(()) for name in ("coarse", "fine", "kl")}
        return losses | {"codes": (~patches.valid).long()}

    task.module.forward = coded  # type: ignore[assignment]
    batch = task.load(0)
    few = replace(batch, valid=batch.valid & (torch.arange(batch.valid.shape[1]) < 3))
    assert [float(task.step(0, each)["perplexity"]) for each in (batch, few)] == [1, 1]
