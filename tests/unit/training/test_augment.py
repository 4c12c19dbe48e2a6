"""Cloud and parameters change together."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from nets.test_tokenizer import buildings

from p2wss.config import Augmentation
from p2wss.nets.batch import Batch, centre
from p2wss.training import augment
from p2wss.training.model import augment_batch


def batch(seed: int = 0) -> Batch:
    """Clouds of noise around rings, of which each vertex is also the first points of its cloud."""
    height, xy, angle, num = buildings(seed, 6, most=8)
    rng = np.random.default_rng(seed)
    points = torch.from_numpy(rng.normal(0, 10, (6, 60, 3))).float()
    points[:, : xy.shape[1], :2] = xy.float()
    valid = torch.ones(6, 60, dtype=torch.bool)
    valid[:, 50:] = False
    return Batch(points, valid, torch.full((6,), -8.0), height.float(), xy.float(), angle.float(), num)


def rings_follow(before: Batch, after: Batch) -> None:
    """The points that lay on the vertices still do (in any order of the vertices)."""
    for row, n in enumerate(before.num_vertices.tolist()):
        gap = torch.cdist(after.points[row, :n, :2], after.xy[row, :n])
        assert gap.amin(1).max() < 1e-4


@pytest.mark.parametrize(
    "change",
    [
        centre,
        augment.rotate_randomly,
        lambda b: augment.scale_randomly(b, (0.5, 2)),
        lambda b: augment.lift_randomly(b, 3),
    ],
)
def test_rings_stay_on_their_points(change: object) -> None:
    torch.manual_seed(0)
    before = batch()
    after = change(before)  # type: ignore[operator]
    rings_follow(before, after)
    assert not torch.equal(after.points, before.points)


def test_centre_ignores_padding() -> None:
    after = centre(batch())
    mean = after.points[:, :50].mean(1)
    assert mean.abs().max() < 1e-4
    assert (after.points[:, 50:] == 0).all()


def test_rotation_turns_counter_clockwise_and_keeps_heights() -> None:
    before = batch()
    after = augment.rotate(before, torch.full((6,), math.pi / 2))
    assert torch.allclose(after.xy[..., 0], -before.xy[..., 1], atol=1e-4)
    assert torch.allclose(after.points[..., 2], before.points[..., 2])


def test_scale_keeps_the_ratio_of_height_to_ground_and_cloud() -> None:
    torch.manual_seed(0)
    before = batch()
    after = augment.scale_randomly(before, (0.5, 2))
    factor = after.height / before.height
    assert torch.allclose(after.points, before.points * factor[:, None, None])
    assert torch.allclose(after.ground_z, before.ground_z * factor)
    assert factor.min() >= 0.5 and factor.max() <= 2 and factor.std() > 0.1


def test_lift_moves_the_roof_with_the_label_and_leaves_the_ground() -> None:
    torch.manual_seed(0)
    before = batch()
    after = augment.lift_randomly(before, 2)
    lift = after.height - before.height
    above = before.points[..., 2] - before.ground_z[:, None] > before.height[:, None] / 2
    above &= before.valid
    moved = after.points[..., 2] - before.points[..., 2]
    assert torch.allclose(moved, lift[:, None] * above, atol=1e-4)
    assert (after.height > 0).all() and lift.abs().max() > 0.5


def test_occlusion_removes_a_wedge_from_some_clouds_only() -> None:
    torch.manual_seed(0)
    before = batch()
    after = augment.occlude_randomly(before, 1.0, 10)
    removed = before.valid & ~after.valid
    assert (removed.sum(1) > 0).sum() >= 3 and (after.valid.sum(1) >= 10).all()
    for row in torch.where(removed.sum(1) > 1)[0]:
        xy = before.points[row, :, :2]
        # from some point of the cloud all removed points lie within 60 degrees, and no remaining one between them
        is_wedge = False
        for apex in torch.where(before.valid[row] & ~removed[row])[0]:
            towards = torch.nn.functional.normalize(xy - xy[apex], dim=-1)
            middle = towards[removed[row]].sum(0)
            side = towards[:, 0] * middle[1] - towards[:, 1] * middle[0]
            angle = torch.rad2deg(torch.atan2(side, towards @ middle))
            low, high = angle[removed[row]].aminmax()
            remaining = after.valid[row].clone()
            remaining[apex] = False
            is_wedge |= bool(high - low < 60 and not ((angle > low) & (angle < high) & remaining).any())
        assert is_wedge
    assert torch.equal(augment.occlude_randomly(before, 0.0, 10).valid, before.valid)
    assert torch.equal(augment.occlude_randomly(before, 1.0, 50).valid, before.valid)


def test_dropped_points_leave_a_share_but_never_too_few() -> None:
    torch.manual_seed(0)
    before = batch()
    after = augment.drop_points_randomly(before, (0.5, 0.5), 10)
    assert after.valid.sum(1).tolist() == [25] * 6
    assert not (after.valid & ~before.valid).any()
    assert augment.drop_points_randomly(before, (0.0, 0.1), 20).valid.sum(1).tolist() == [20] * 6
    assert augment.drop_points_randomly(before, (0.0, 0.1), 99).valid.sum(1).tolist() == [50] * 6


def test_no_augmentation_takes_a_vertex_out_of_reach() -> None:
    """Where a shadow or thinning leaves the points at one end of a long building, its other end would be too far."""
    torch.manual_seed(0)
    num, half = 256, torch.tensor([65.0, 7.0])
    flat = (2 * torch.rand(num, 300, 2) - 1) * half
    ring = (torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]) * half).expand(num, 4, 2)
    long = Batch(
        points=torch.cat([flat, 8 * torch.rand(num, 300, 1)], -1),
        valid=torch.ones(num, 300, dtype=torch.bool),
        ground_z=torch.zeros(num),
        height=torch.full((num,), 8.0),
        xy=ring,
        angle=torch.zeros(num, 4),
        num_vertices=torch.full((num,), 4),
    )
    settings = Augmentation(occlusion_share=1, keep_points=(0.1, 1), jitter_m=0)

    def augmented(reach_m: float) -> Batch:
        torch.manual_seed(1)
        return augment_batch(long, settings, 30, reach_m)

    far, near = augmented(1e9), augmented(99.9)
    assert far.xy.norm(dim=-1).max() > 110
    assert near.xy.norm(dim=-1).max() < 99.9
    is_far = far.xy.norm(dim=-1).amax(1) > 99.9
    assert 0 < is_far.sum() < num / 4
    assert near.valid[is_far].all() and torch.equal(near.valid[~is_far], far.valid[~is_far])
