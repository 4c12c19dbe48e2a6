"""Two processes with half of the batch each are one process with the whole batch."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny_network
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from p2wss.nets import distributed
from p2wss.nets.discrete_vae import DiscreteVae
from p2wss.nets.layers import BatchNorm
from p2wss.nets.patches import Patches, make_patches
from p2wss.nets.point2wss import Point2Wss, Sequences
from p2wss.nets.tokenizer import MASK
from p2wss.training import loop

NUM = 8


def rows(x: Tensor) -> Tensor:
    return x[torch.from_numpy(distributed.shard(np.arange(len(x))))]


def patches(generator: torch.Generator) -> Patches:
    points = torch.randn(NUM, 60, 3, generator=generator)
    whole = make_patches(points, torch.ones(NUM, 60, dtype=torch.bool), 8, 8)
    return Patches(*(rows(value) for value in vars(whole).values()))


def measure(module: nn.Module, losses: dict[str, Tensor]) -> dict[str, Tensor]:
    """Losses and gradients as the training loop would see them."""
    torch.stack(list(losses.values())).sum().backward()
    distributed.average_gradients(module)
    averages = distributed.average_values({name: float(value.detach()) for name, value in losses.items()})
    result = {name: torch.tensor(value) for name, value in averages.items()}
    result |= {f"grad {name}": p.grad for name, p in module.named_parameters() if p.grad is not None}
    return result | {name: value for name, value in module.named_buffers() if "running" in name}


def dvae_step() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(1)
    torch.manual_seed(0)
    module = DiscreteVae(tiny_network.DVAE)
    # only the noise is drawn per process
    F.gumbel_softmax = lambda logits, tau, **_: F.softmax(logits / tau, -1)
    losses = module(patches(generator), 0.5)
    return measure(module, {name: losses[name] for name in ("coarse", "fine", "kl")})


def model_step() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(2)
    torch.manual_seed(0)
    config = tiny_network.MODEL.model_copy(update={"coord_decimals": 1, "match_balanced": False})
    module = Point2Wss(config, tiny_network.DVAE)
    tokenizer = module.tokenizer
    num_vertices = torch.randint(3, 7, (NUM,), generator=generator)
    num_vertices[0] = num_vertices[1] = 6  # each half is as wide as the whole
    xy = torch.randn(NUM, 6, 2, generator=generator) * 10
    angle = torch.randint(20, 46, (NUM, 6), generator=generator)
    height = torch.rand(NUM, generator=generator) * 10
    parameters, _ = tokenizer.canonical(tokenizer.quantise(height, xy, angle, num_vertices))
    tokens = tokenizer.encode(parameters)
    # unequal shares of masked tokens
    token_masked = torch.rand(tokens.shape, generator=generator) < torch.linspace(0.1, 0.9, NUM)[:, None]
    token_masked &= tokens > 3
    patch_masked = torch.rand(NUM, 8, generator=generator) < torch.linspace(0.2, 0.8, NUM)[:, None]
    labels = torch.randint(12, (NUM, 8), generator=generator)
    patches_of_process = patches(generator)
    given = tokens.masked_fill(token_masked, MASK)
    arguments = [rows(x) for x in (torch.zeros(NUM), patch_masked, labels)]
    sequences = Sequences(*(rows(x) for x in (tokens, given, token_masked, num_vertices)))
    return measure(module, module.losses(patches_of_process, *arguments, sequences))


class Line:
    """A noisy line, drawn for the whole batch, of which a process takes its rows."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        self.module = nn.Sequential(nn.Linear(2, 8, bias=False), BatchNorm(8), nn.ReLU(), nn.Linear(8, 1))

    def load(self, step: int) -> None:
        """It reads nothing."""

    def step(self, step: int, loaded: None) -> dict[str, Tensor]:
        x = rows(torch.randn(NUM, 2, generator=torch.Generator().manual_seed(step)))
        return {"loss": (self.module(x)[:, 0] - x.sum(1)).square().mean()}

    def validate(self, module: nn.Module) -> dict[str, float]:
        x = torch.randn(64, 2, generator=torch.Generator().manual_seed(99))
        return {"val_error": float((module(x)[:, 0] - x.sum(1)).abs().mean())}


def train_line(folder: Path) -> dict[str, Tensor]:
    from p2wss.config import Optimiser

    plan = loop.Plan(0, Optimiser(num_steps=40, batch_size=NUM), 20)
    return dict(loop.train(Line(), plan, folder, {}, "x").state_dict())


def everything(folder: Path) -> dict[str, dict[str, Tensor]]:
    return {
        "dvae": dvae_step(),
        "model": model_step(),
        "line": train_line(folder),
    }


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of one process and of two, run by torchrun, as a user would; both at the same time."""
    folder = tmp_path_factory.mktemp("distributed")
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    runs = []
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    for count, launcher in (("1", []), ("2", torchrun)):
        command = [sys.executable, *launcher, __file__, str(folder / count)]
        runs.append(subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True))
    for run in runs:
        _, error = run.communicate()
        assert run.returncode == 0, error[-3000:]
    return folder


@pytest.mark.parametrize("part", ["dvae", "model", "line"])
def test_losses_gradients_and_statistics_are_those_of_one_process(outputs: Path, part: str) -> None:
    one, two = (torch.load(outputs / count / "results.pt")[part] for count in "12")
    assert one.keys() == two.keys()
    for name in one:
        if one[name].is_floating_point():
            assert torch.allclose(one[name], two[name], rtol=1e-3, atol=2e-5), name


def test_the_first_process_writes_once(outputs: Path) -> None:
    one, two = ((outputs / count / "metrics.jsonl").read_text().splitlines() for count in "12")
    assert len(one) == len(two) == 5  # the code, two losses, two validations
    assert sorted(p.name for p in (outputs / "2").glob("*.pt")) == [
        "results.pt",
        "step-00000020.pt",
        "step-00000040.pt",
    ]


def test_each_building_belongs_to_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distributed, "num_processes", lambda: 3)
    parts = []
    for rank in range(3):
        monkeypatch.setattr(distributed, "rank", lambda rank=rank: rank)
        parts.append(distributed.shard(np.arange(11)))
    assert [len(part) for part in parts] == [3, 3, 3]
    assert sorted(np.concatenate(parts)) == list(range(9))


if __name__ == "__main__":
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    with distributed.process_group(torch.device("cpu")):
        result = everything(folder)
        if distributed.rank() == 0:
            torch.save(result, folder / "results.pt")
