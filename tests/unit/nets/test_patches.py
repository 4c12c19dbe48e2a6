"""Farthest point sampling and nearest neighbours against brute force."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from p2wss.nets.patches import farthest_points, make_patches, nearest_points


def clouds(seed: int, padded: int = 20) -> tuple[torch.Tensor, torch.Tensor]:
    """Three clouds (3, p, 3) with padding in between that would win every choice; valid (3, p)."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(3, 80 + padded, 3))
    valid = np.ones(points.shape[:2], bool)
    for row in range(3):
        pads = rng.choice(points.shape[1], padded, replace=False)
        valid[row, pads] = False
        points[row, pads[: padded // 2]] = 1e6
        points[row, pads[padded // 2 :]] = 0
    return torch.from_numpy(points).float(), torch.from_numpy(valid)


def brute_force_farthest(points: np.ndarray, num: int) -> list[int]:
    chosen = [0]
    while len(chosen) < num:
        distance = np.linalg.norm(points[:, None] - points[chosen], axis=-1).min(1)
        chosen.append(int(distance.argmax()))
    return chosen


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32))
def test_farthest_points_as_by_brute_force_and_never_padding(seed: int) -> None:
    points, valid = clouds(seed)
    chosen, distinct, distance = farthest_points(points, valid, 16)
    assert distinct.all()
    assert (distance.isinf() == ~valid[:, None]).all()
    for row in range(3):
        valid_index = np.flatnonzero(valid[row])
        expected = valid_index[brute_force_farthest(points[row].numpy()[valid_index].astype(float), 16)]
        assert chosen[row].tolist() == expected.tolist()
        reference = cdist(points[row, chosen[row]].numpy(), points[row].numpy()[valid_index])
        assert np.allclose(distance[row].numpy()[:, valid_index], reference**2, rtol=1e-4, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32))
def test_nearest_points_as_by_kd_tree_and_never_padding(seed: int) -> None:
    points, valid = clouds(seed)
    centre = points[:, :8] * valid[:, :8, None]
    reference = torch.from_numpy(np.array([cdist(*pair) for pair in zip(centre, points, strict=True)]))
    index = nearest_points(reference.float().masked_fill(~valid[:, None], torch.inf), 12)
    for row in range(3):
        valid_index = np.flatnonzero(valid[row])
        _, expected = cKDTree(points[row].numpy()[valid_index]).query(centre[row].numpy(), 12)
        assert np.array_equal(np.sort(index[row].numpy()), np.sort(valid_index[expected]))


def test_small_clouds_repeat_points_and_mark_repeated_patches() -> None:
    points = torch.zeros(2, 10, 3)
    points[0, :5, 0] = torch.arange(5.0)
    points[1, :, 1] = torch.arange(10.0)
    valid = torch.tensor([[True] * 5 + [False] * 5, [True] * 10])
    patches = make_patches(points, valid, num_patches=8, patch_size=16)
    assert patches.valid.sum(1).tolist() == [5, 8]
    assert sorted(patches.centre[0, :5, 0].tolist()) == [0, 1, 2, 3, 4]
    # five points and eleven repetitions of the nearest one, the centre itself
    first = patches.points[0, 0, :, 0]
    assert len(first.unique()) == 5 and int((first == 0).sum()) == 12


def test_points_that_coincide_make_one_patch() -> None:
    points = torch.ones(1, 30, 3)
    patches = make_patches(points, torch.ones(1, 30, dtype=torch.bool), 4, 8)
    # the first one has no earlier patch to coincide with
    assert patches.valid.tolist() == [[True, False, False, False]]
    assert (patches.points == 0).all()


def test_patches_turn_with_the_cloud() -> None:
    points, valid = clouds(7)
    turn = torch.tensor([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    one = make_patches(points, valid, 8, 8)
    other = make_patches(points @ turn, valid, 8, 8)
    assert torch.allclose(one.points @ turn, other.points, atol=1e-5)
