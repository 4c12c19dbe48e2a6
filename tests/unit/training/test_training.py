"""The loop: an interruption changes nothing, checkpoints of something else are not used."""

from __future__ import annotations

import errno
import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from p2wss.nets import compute
from p2wss.nets.weights import last_validation
from p2wss.storage.messages import InputError
from p2wss.training import loop
from p2wss.training.loop import METRICS_NAME, TrainingState, learning_rate, remove_checkpoints

IDENTITY = {"config": {"a": 1}}


@dataclass(frozen=True)
class Settings:
    num_steps: int = 60
    batch_size: int = 8
    learning_rate: float = 0.05
    learning_rate_end: float = 1e-4
    warmup_share: float = 0.1
    weight_decay: float = 0.01
    beta2: float = 0.95
    gradient_clip: float = 1.0
    ramp_steps: int = 0


class Line:
    """Fit a line through noise; draws random numbers, has batch norm and drop-out."""

    def __init__(self, stop_after: int | None = None, poison: int | None = None) -> None:
        torch.manual_seed(0)
        self.module = nn.Sequential(
            nn.Linear(2, 8), nn.BatchNorm1d(8), nn.Dropout(0.1), nn.ReLU(), nn.Linear(8, 1)
        )
        self.stop_after, self.poison = stop_after, poison

    def load(self, step: int) -> None:
        """It reads nothing."""

    def step(self, step: int, loaded: Any) -> dict[str, Tensor]:
        if step == self.stop_after:
            os.kill(os.getpid(), signal.SIGTERM)
        x = torch.randn(8, 2)
        loss = (self.module(x)[:, 0] - x.sum(1)).square().mean()
        return {"loss": loss * (math.nan if step == self.poison else 1.0)}

    def validate(self, module: nn.Module) -> dict[str, float]:
        x = torch.randn(64, 2)
        return {"val_error": float((module(x)[:, 0] - x.sum(1)).abs().mean())}


def read_metrics(folder: Path) -> str:
    return (folder / METRICS_NAME).read_text()


def run(
    folder: Path,
    task: Line,
    identity: dict = IDENTITY,
    code: str = "x",
    **settings: int,
) -> dict[str, Tensor]:
    plan = loop.Plan(3, Settings(**settings), 20)
    return loop.train(task, plan, folder, identity, code).state_dict()


@pytest.mark.parametrize("stop_after", [7, 20, 39, 45])
def test_interrupted_and_resumed_is_uninterrupted_to_the_bit(tmp_path: Path, stop_after: int) -> None:
    expected = run(tmp_path / "one", Line())
    with pytest.raises(SystemExit) as stopped:
        run(tmp_path / "two", Line(stop_after))
    assert stopped.value.code == 0
    resumed = run(tmp_path / "two", Line())
    assert expected.keys() == resumed.keys()
    assert all(torch.equal(expected[name], resumed[name]) for name in expected)
    assert read_metrics(tmp_path / "one") == read_metrics(tmp_path / "two")


def test_a_training_stops_with_a_checkpoint_once_its_snakemake_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = run(tmp_path / "one", Line())
    snakemake = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)

    class Orphan(Line):
        def step(self, step: int, loaded: Any) -> dict[str, Tensor]:
            if step == 33:
                snakemake.kill()
                snakemake.wait()
            return super().step(step, loaded)

    monkeypatch.setenv(loop.WORKFLOW_VARIABLE, str(snakemake.pid))
    with pytest.raises(SystemExit) as stopped:
        run(tmp_path / "two", Orphan())
    assert stopped.value.code == 0 and (tmp_path / "two/step-00000034.pt").exists()
    monkeypatch.setenv(loop.WORKFLOW_VARIABLE, str(os.getpid()))
    resumed = run(tmp_path / "two", Line())
    assert all(torch.equal(expected[name], resumed[name]) for name in expected)


def test_a_kill_without_warning_repeats_the_steps_since_the_last_checkpoint(tmp_path: Path) -> None:
    expected = run(tmp_path / "one", Line())

    class Killed(Line):
        def step(self, step: int, loaded: Any) -> dict[str, Tensor]:
            if step == 47:
                raise KeyboardInterrupt
            return super().step(step, loaded)

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "two", Killed())
    resumed = run(tmp_path / "two", Line())
    assert all(torch.equal(expected[name], resumed[name]) for name in expected)
    assert read_metrics(tmp_path / "one") == read_metrics(tmp_path / "two")


def test_a_broken_checkpoint_is_passed_over(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    expected = run(tmp_path, Line())
    last = sorted(tmp_path.glob("step-*.pt"))
    assert [path.name for path in last] == ["step-00000040.pt", "step-00000060.pt"]
    last[-1].write_bytes(last[-1].read_bytes()[:500])
    resumed = run(tmp_path, Line())
    assert "step-00000060.pt: damaged or incomplete; trying the previous one" in caplog.text
    assert all(torch.equal(expected[name], resumed[name]) for name in expected)


def test_checkpoints_of_another_config_are_not_used(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(SystemExit):
        run(tmp_path, Line(stop_after=30), identity={"config": {"a": 2}})
    resumed = run(tmp_path, Line())
    assert "starting from the beginning" in caplog.text
    expected = run(tmp_path / "other", Line())
    assert all(torch.equal(expected[name], resumed[name]) for name in expected)


def test_an_edit_of_the_code_is_recorded_and_costs_no_training(tmp_path: Path) -> None:
    with pytest.raises(SystemExit):
        run(tmp_path, Line(stop_after=30), code="old")
    resumed = run(tmp_path, Line(), code="new")
    expected = run(tmp_path / "other", Line())
    assert all(torch.equal(expected[name], resumed[name]) for name in expected)
    records = [json.loads(line) for line in read_metrics(tmp_path).splitlines()]
    assert [record for record in records if "code" in record] == [
        {"step": 0, "code": "old"},
        {"step": 31, "code": "new"},
    ]


@pytest.mark.parametrize("longer", [64, 130])
def test_a_training_with_a_constant_rate_can_be_extended(tmp_path: Path, longer: int) -> None:
    """From before its last ramp, so that the result is that of the longer training alone, to the bit."""
    run(tmp_path / "one", Line(), ramp_steps=8)
    assert sorted(path.name for path in (tmp_path / "one").glob("*.pt")) == [
        "step-00000052.pt",
        "step-00000060.pt",
    ]
    steps = []

    class Counted(Line):
        def step(self, step: int, loaded: Any) -> dict[str, Tensor]:
            steps.append(step)
            return super().step(step, loaded)

    extended = run(tmp_path / "one", Counted(), ramp_steps=8, num_steps=longer)
    assert steps == list(range(52, longer))
    expected = run(tmp_path / "two", Line(), ramp_steps=8, num_steps=longer)
    assert all(torch.equal(expected[name], extended[name]) for name in expected)


def test_another_decay_continues_before_either(tmp_path: Path) -> None:
    run(tmp_path, Line(), ramp_steps=8)
    run(tmp_path, Line(), ramp_steps=20, num_steps=80)
    records = [json.loads(line) for line in read_metrics(tmp_path).splitlines()]
    rates = {record["step"]: record["learning_rate"] for record in records if "learning_rate" in record}
    assert rates[52] == rates[60] == 0.05 and rates[80] == pytest.approx(0.05 / 20)


def test_a_cosine_decay_cannot_be_extended(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run(tmp_path / "one", Line())
    extended = run(tmp_path / "one", Line(), num_steps=80)
    assert "step-00000060.pt: made for 60 steps" in caplog.text
    expected = run(tmp_path / "two", Line(), num_steps=80)
    assert all(torch.equal(expected[name], extended[name]) for name in expected)


def test_a_loss_that_is_not_finite_stops_with_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"loss is nan at step \d+: lower the learning rate"):
        run(tmp_path, Line(poison=15))


def test_a_full_disk_is_one_clear_line_and_leaves_the_last_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Path.write_bytes

    def full(path: Path, data: bytes) -> int:
        if "step-00000040" in path.name:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match=r"step-00000040\.pt: not written: No space left"):
        run(tmp_path, Line())
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["metrics.jsonl", "step-00000020.pt"]


def test_only_weights_of_linear_layers_decay() -> None:
    module = nn.ModuleDict({"a": nn.Linear(2, 2), "b": nn.Embedding(3, 2), "c": nn.LayerNorm(2)})
    module.register_parameter("codebook", nn.Parameter(torch.ones(4, 2)))
    state = TrainingState(module, Settings())
    decayed, plain = (group["params"] for group in state.optimiser.param_groups)
    assert [p.shape for p in decayed] == [(2, 2)] and decayed[0] is module["a"].weight
    assert len(plain) == 5 and state.optimiser.param_groups[1]["weight_decay"] == 0


def test_schedule_rises_then_falls() -> None:
    settings = Settings(num_steps=100)
    rates = [learning_rate(step, settings) for step in range(100)]
    assert rates[9] == max(rates) == settings.learning_rate
    assert rates[:10] == sorted(rates[:10]) and rates[10:] == sorted(rates[10:], reverse=True)
    assert settings.learning_rate_end < rates[-1] < 2e-4
    middle = learning_rate(55, settings)
    assert middle == pytest.approx((settings.learning_rate + settings.learning_rate_end) / 2)


def test_a_constant_rate_lies_between_two_ramps() -> None:
    settings = Settings(num_steps=100, ramp_steps=10)
    rates = [learning_rate(step, settings) for step in range(100)]
    assert rates[9:91] == [settings.learning_rate] * 82
    assert rates[0] == rates[99] == pytest.approx(settings.learning_rate / 10)
    assert rates[:10] == sorted(rates[:10]) and rates[90:] == sorted(rates[90:], reverse=True)


def test_metrics_are_lines_of_json_and_the_folder_can_go(tmp_path: Path) -> None:
    folder = tmp_path / "checkpoints"
    run(folder, Line())
    records = [json.loads(line) for line in read_metrics(folder).splitlines()]
    assert [r["step"] for r in records if "loss" in r] == [20, 40, 60]
    assert last_validation(read_metrics(folder))["step"] == 60
    remove_checkpoints(folder)
    assert not folder.exists()


def test_a_gpu_that_is_not_there_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert compute.device_of("auto") == compute.device_of("cpu") == torch.device("cpu")
    with pytest.raises(InputError, match="device cuda: torch finds no GPU"):
        compute.device_of("cuda")
