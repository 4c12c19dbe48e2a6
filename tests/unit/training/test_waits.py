"""For what values a step of training asks: on a GPU, the host waits for each of them until all work is done."""

from __future__ import annotations

from typing import Any

import completion_roofs
import pytest
import torch
import toy_crops
from completion import CompletionTask
from completion_network import RoofCompletion
from drawn_towns.wings import draw_wings
from small_networks import SMALL_DVAE, SMALL_MODEL
from torch.utils._python_dispatch import TorchDispatchMode

from p2wss.config import load
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.point2wss import Point2Wss
from p2wss.training.dataset import BuildingDataset, TrainingLimits, load_dataset
from p2wss.training.dvae import DvaeTask
from p2wss.training.loop import Task
from p2wss.training.model import ModelTask


class Asked(TorchDispatchMode):
    """Lists the operations that have to know values of a tensor: numbers, and sizes that follow from a mask."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = function.overloadpacket.__name__
        indices = args[1] if name in ("index", "index_put", "index_put_", "_index_put_impl_") else []
        if name in ("_local_scalar_dense", "nonzero", "masked_select", "bincount", "unique") or any(
            each is not None and each.dtype == torch.bool for each in indices
        ):
            self.names.append(name)
        return function(*args, **(kwargs or {}))


def asked(task: Task) -> list[str]:
    """What a step asks for, but for that of the optimiser, which on a GPU is another."""
    loaded = task.load(0)
    with Asked() as mode:
        task.step(0, loaded)["loss"].backward()
        torch.nn.utils.clip_grad_norm_(task.module.parameters(), 1.0)
    return mode.names


@pytest.fixture(scope="module")
def buildings(tmp_path_factory: pytest.TempPathFactory) -> BuildingDataset:
    manifest = toy_crops.make(tmp_path_factory.mktemp("crops"), {"train": 12})
    return load_dataset(manifest, ["train"], TrainingLimits(64, 8, 70), labelled=True)


def test_the_completion_asks_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(completion_roofs, "KINDS", {"wings": (draw_wings, 1)})
    roofs = completion_roofs.draw_roofs(5)
    assert asked(CompletionTask(RoofCompletion(), roofs, 2, 0)) == []


def test_the_dvae_asks_for_nothing(buildings: BuildingDataset) -> None:
    config = load({"dvae": SMALL_DVAE}).dvae
    assert asked(DvaeTask(DiscreteVae(config), buildings, buildings)) == []


@pytest.mark.parametrize(("auxiliary_share", "num_asked"), [(0.0, 1), (1.0, 2)])
def test_the_model_asks_whether_values_fit(
    buildings: BuildingDataset, auxiliary_share: float, num_asked: int
) -> None:
    """Once, and for the masked patches, whose number it does not know; not for each group of sequences."""
    config = load({"dvae": SMALL_DVAE, "model": SMALL_MODEL | {"auxiliary_share": auxiliary_share}})
    network, vae = Point2Wss(config.model, config.dvae), DiscreteVae(config.dvae)
    names = asked(ModelTask(network, vae, buildings, buildings))
    assert names[0] == "_local_scalar_dense" and len(names) == num_asked
