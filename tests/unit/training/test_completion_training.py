"""Training of the completion: drawn roofs, varied samples, the script."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import completion
import completion_roofs
import numpy as np
import pytest
import torch
from completion_network import RoofCompletion
from completion_roofs import (
    NUM_NEIGHBOURS,
    NUM_SAMPLES,
    DrawnRoofs,
    _roof,
    draw_batch,
    draw_roofs,
)
from safetensors.numpy import load_file

from p2wss.config.training import Optimiser
from p2wss.nets import supposed
from p2wss.nets.clues import MAX_POINTS, MAX_VERTICES, SCALE_M
from p2wss.storage.messages import InputError
from p2wss.towns.buildings import DrawnBuilding, Wing

# sums of the test below, by the first version
FORMER = {
    "point": -33.160663496065254,
    "is_point": 10.111293070038043,
    "around": 15.14239107682729,
    "is_around": 6.738678464036769,
    "ring": 0.7199987810731283,
    "is_vertex": 1.580250669487271,
    "place": -19.757256861832794,
    "z": 9.266222899612925,
    "slope": 82.80720879290445,
}


@pytest.fixture(scope="module")
def few_towns() -> Iterator[None]:
    """Forty buildings of each kind."""

    def few(draw: Callable[[np.random.Generator], Sequence[DrawnBuilding]]) -> Callable:
        return lambda rng: draw(rng)[:40]

    kinds = {kind: (few(draw), 1) for kind, (draw, _) in completion_roofs.KINDS.items() if kind != "streets"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(completion_roofs, "KINDS", kinds)
        yield


@pytest.fixture(scope="module")
def roofs(few_towns: None) -> DrawnRoofs:
    return draw_roofs(5)


def test_the_highest_of_wings_is_seen() -> None:
    gable = Wing(np.array([[0.0, 0], [10, 0], [10, 8], [0, 8]]), 4.0, 45.0, (0, 2))
    annex = Wing(np.array([[0.0, 7], [10, 7], [10, 12], [0, 12]]), 3.0, 0.0, ())
    z, slope = _roof([gable, annex], np.array([[5.0, 1], [5, 6], [5, 7.5], [5, 11], [5, 20]]))
    assert z == pytest.approx([5, 6, 4.5, 3, -np.inf])
    assert slope == pytest.approx(np.array([[0, 1], [0, -1], [0, -1], [0, 0], [0, 0]]), abs=1e-12)


def test_samples_lie_on_planes_with_their_slopes(roofs: DrawnRoofs) -> None:
    """Two samples of one slope that are near each other are on one plane, unless there is a step between them."""
    assert (roofs.z > 0.5).all() and (roofs.seen_z >= roofs.z).all()
    shares = []
    for xy, z, slope in zip(roofs.xy, roofs.z, roofs.slope, strict=True):
        offset = xy[:, None] - xy
        off_m = z[:, None] - z - (offset * slope[:, None]).sum(axis=-1)
        same = (np.abs(slope[:, None] - slope).max(axis=-1) < 1e-9) & (np.hypot(*offset.T).T < 0.7)
        shares.append((np.abs(off_m[same]) < 1e-6).mean())
    assert np.mean(shares) > 0.95
    neighbour = roofs.neighbour[roofs.neighbour >= 0]
    assert len(neighbour) and neighbour.max() < len(roofs.z)
    own = np.repeat(np.arange(len(roofs.z)), (roofs.neighbour >= 0).sum(axis=1))
    assert (own != neighbour).all() and np.hypot(*(roofs.centre[own] - roofs.centre[neighbour]).T).max() < 80


def test_samples_are_deterministic_and_vary(roofs: DrawnRoofs) -> None:
    index = np.arange(40)
    first, again, other = (draw_batch(roofs, index, np.random.default_rng(seed)) for seed in (1, 1, 2))
    for one, same in zip((*first[0], *first[1:]), (*again[0], *again[1:]), strict=True):
        assert np.array_equal(one, same)
    assert not np.array_equal(first[1], other[1])


def test_samples_of_a_seed_are_those_of_former_versions() -> None:
    """Weighted sums of what the first version drew of the same roofs."""
    rng, num = np.random.default_rng(7), 30
    angle = np.linspace(0, 2 * np.pi, MAX_VERTICES, endpoint=False)
    ring = np.column_stack([6 * np.cos(angle), 4 * np.sin(angle)]) * rng.uniform(0.8, 1.2, (num, 1, 1))
    ring[rng.random(num) < 0.5, 6:] = np.nan
    xy, z = rng.uniform(-6, 6, (num, NUM_SAMPLES, 2)), rng.uniform(3, 9, (num, NUM_SAMPLES))
    centre, slope = rng.uniform(0, 40, (num, 2)), rng.normal(size=xy.shape)
    neighbour = rng.integers(-1, num, (num, NUM_NEIGHBOURS))
    roofs = DrawnRoofs(ring, centre, xy, z, slope, z + rng.random(z.shape), neighbour)
    clues, *wanted = draw_batch(roofs, rng.integers(num, size=200), rng)
    sums = [float((each.ravel() * np.cos(np.arange(each.size))).sum()) for each in (*clues, *wanted)]
    assert sums == pytest.approx(list(FORMER.values()), rel=1e-9)


def test_batches_of_forks_are_those_of_one_process(roofs: DrawnRoofs) -> None:
    one, many = roofs, draw_roofs(5, num_processes=3)
    assert all(np.array_equal(*pair, equal_nan=True) for pair in zip(one, many, strict=True))
    alone = completion.CompletionTask(RoofCompletion(), one, 4, 0)
    with closing(completion.CompletionTask(RoofCompletion(), many, 4, 0, num_forks=3).batches) as batches:
        for step in range(7, 15):
            drawn, expected = batches[step], alone.batches[step]
            pairs = zip((*drawn.clues, *drawn[1:]), (*expected.clues, *expected[1:]), strict=True)
            assert all(np.array_equal(*pair) and pair[0].dtype in (bool, np.float32) for pair in pairs)


def test_heights_and_slopes_of_a_batch_fit_each_other(roofs: DrawnRoofs) -> None:
    """Also after the roofs are stretched, mirrored, turned, lowered in parts and raised."""
    clues, z, slope = draw_batch(roofs, np.arange(len(roofs.z)), np.random.default_rng(3))
    offset = clues.place[:, :, None] - clues.place[:, None]
    off_m = SCALE_M * (z[:, :, None] - z[:, None] - (offset * slope[:, :, None]).sum(axis=-1))
    same = np.abs(slope[:, :, None] - slope[:, None]).max(axis=-1) < 1e-9
    same &= np.linalg.norm(offset, axis=-1) < 0.07
    same &= ~np.eye(z.shape[1], dtype=bool)
    assert same.sum() > 1000 and (np.abs(off_m[same]) < 1e-6).mean() > 0.9
    mean = (clues.point[..., 2] * clues.is_point).sum(axis=1) / clues.is_point.sum(axis=1)
    assert mean == pytest.approx(0, abs=1e-9)
    assert clues.is_point.sum(axis=1).min() >= 3 and clues.is_point.sum(axis=1).max() <= MAX_POINTS


def test_the_script_trains(few_towns: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(completion, "_NUM_VALIDATION", 16)
    out, metrics = tmp_path / "c.safetensors", tmp_path / "m.jsonl"
    arguments = ["--out", str(out), "--out-metrics", str(metrics), "--batch-size", "4"]
    arguments += ["--checkpoints", str(tmp_path / "checkpoints"), "--num-steps", "4"]
    assert completion.main(arguments) == 0
    records = [json.loads(line) for line in metrics.read_text().splitlines()]
    assert any("loss" in record for record in records)
    assert all(0 < record["val_height_m"] < 10 for record in records if "val_height_m" in record)
    assert load_file(out).keys() == supposed._weights().keys()
    assert not (tmp_path / "checkpoints").exists()


def test_a_batch_is_learnt(roofs: DrawnRoofs) -> None:
    """The loss that is minimised becomes that of heights known to decimetres."""
    torch.manual_seed(0)
    task = completion.CompletionTask(RoofCompletion(), roofs, 4, 0)
    optimiser = torch.optim.Adam(task.module.parameters(), 3e-4)
    losses = []
    for _ in range(30):
        loss = task.step(0, task.load(0))["loss"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert np.mean(losses[-5:]) < losses[0] - 1.5


def test_a_loss_that_is_not_finite_is_one_line(
    few_towns: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(completion, "completion_loss", lambda mixture, z, slope: mixture.z.mean() * np.nan)
    optimiser = Optimiser(num_steps=20, batch_size=2)
    with pytest.raises(InputError, match="the loss is nan at step 20"):
        completion.train(optimiser, "cpu", tmp_path, "x")
