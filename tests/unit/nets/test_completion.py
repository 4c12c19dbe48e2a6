"""The network that completes roofs of few points: with torch and without, padded and not, turned and moved."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
import shapely.affinity
import torch
from completion_network import Mixture, RoofCompletion, completion_loss

from p2wss.nets import supposed
from p2wss.nets.clues import MAX_AROUND, MAX_POINTS, MAX_VERTICES, Clues, Features, features_of
from p2wss.nets.supposed import mixture_of, supposed_roof

HOUSE = shapely.box(0, 0, 12, 8)
# a gable roof, ridge along x, eaves at 5 m and slopes of 0.8
SLOPE, EAVE_M = 0.8, 5.0


def gable_z(xy_m: np.ndarray) -> np.ndarray:
    return EAVE_M + SLOPE * np.minimum(xy_m[:, 1], 8 - xy_m[:, 1])


def few_points(num: int, seed: int = 0) -> np.ndarray:
    xy_m = np.random.default_rng(seed).uniform((0, 0), (12, 8), (num, 2))
    return np.column_stack([xy_m, gable_z(xy_m)])


def clues(num: int, num_around: int, num_vertices: int, rng: np.random.Generator) -> Clues:
    """A padded building."""
    angle = np.linspace(0, 2 * np.pi, num_vertices, endpoint=False)
    ring = np.zeros((1, MAX_VERTICES, 2))
    ring[0, :num_vertices] = np.column_stack([np.cos(angle), np.sin(angle)])

    def within(count: int, size: int) -> np.ndarray:
        return (np.arange(size) < count)[None]

    return Clues(
        rng.normal(0, 0.4, (1, MAX_POINTS, 3)),
        within(num, MAX_POINTS),
        rng.normal(0, 1.0, (1, MAX_AROUND, 3)),
        within(num_around, MAX_AROUND),
        ring,
        within(num_vertices, MAX_VERTICES),
        rng.normal(0, 0.4, (1, 9, 2)),
    )


def tensors(features: Features) -> list[torch.Tensor]:
    return [
        torch.from_numpy(each.copy()).to(torch.float64 if each.dtype == float else None) for each in features
    ]


def tensors_type(array: np.ndarray) -> torch.dtype:
    return torch.from_numpy(array).dtype


@pytest.mark.parametrize(("num", "num_around", "num_vertices"), [(3, 0, 4), (17, 5, 9), (64, 24, 24)])
def test_arrays_alone_give_what_torch_gives(num: int, num_around: int, num_vertices: int) -> None:
    torch.manual_seed(num)
    module = RoofCompletion().double().eval()
    features = features_of(clues(num, num_around, num_vertices, np.random.default_rng(num)))
    with torch.no_grad():
        expected = module(*tensors(features))
    weights = {name: value.numpy() for name, value in module.state_dict().items()}
    z, slope, logit = mixture_of(features, weights)
    # the planes are made in single precision
    assert z == pytest.approx(expected.z[0].numpy(), abs=1e-5)
    assert slope == pytest.approx(expected.slope[0].numpy(), abs=1e-5)
    assert logit == pytest.approx(expected.logit[0].numpy(), rel=1e-5, abs=1e-4)


def test_features_of_tensors_are_those_of_arrays() -> None:
    given = clues(17, 5, 9, np.random.default_rng(2))
    single = Clues(*(torch.from_numpy(e if e.dtype == bool else e.astype(np.float32)) for e in given))
    for expected, feature in zip(features_of(given), features_of(single, torch), strict=True):
        assert feature.dtype == (torch.float32 if expected.dtype == float else tensors_type(expected))
        assert feature.numpy() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("xp", [np, torch])
def test_features_of_many_buildings_are_those_of_each(xp: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the number that is described at once, to the bit."""
    every = [clues(num, num // 3, 4 + num, np.random.default_rng(num)) for num in range(3, 10)]
    many = Clues(*(xp.asarray(np.concatenate(each)) for each in zip(*every, strict=True)))
    at_once = features_of(many, xp)
    monkeypatch.setattr("p2wss.nets.clues._AT_ONCE", 3)
    for row in range(len(every)):
        alone = features_of(Clues(*(each[row : row + 1] for each in many)), xp)
        for parts, whole, one in zip(features_of(many, xp), at_once, alone, strict=True):
            assert parts.dtype == one.dtype
            assert (parts[row] == one[0]).all() and (whole[row] == one[0]).all()


def test_distances_and_offsets_are_those_of_shapes() -> None:
    """From points and places to points and to edges, as GEOS has them."""
    given = clues(17, 5, 9, np.random.default_rng(2))
    features = features_of(given)
    point = np.concatenate([given.point, given.around], axis=1)[0, :, :2]
    corner = given.ring[0, :9]
    end = np.roll(corner, -1, axis=0)
    to = np.concatenate([shapely.points(point), shapely.linestrings(np.stack([corner, end], axis=1))])
    for name, at in (("distance", point), ("place_distance", given.place[0])):
        expected = shapely.distance(shapely.points(at)[:, None], to)
        assert getattr(features, name)[0, : len(at), : len(to)] == pytest.approx(expected, abs=1e-4)
    middle = np.concatenate([point, (corner + end) / 2])
    assert features.offset[0, :, : len(middle)] == pytest.approx(given.place[0][:, None] - middle)


def test_padding_says_nothing() -> None:
    padded = clues(11, 4, 6, np.random.default_rng(1))
    bare = Clues(
        padded.point[:, :11],
        padded.is_point[:, :11],
        padded.around[:, :4],
        padded.is_around[:, :4],
        padded.ring[:, :6],
        padded.is_vertex[:, :6],
        padded.place,
    )
    weights = {name: value.double().numpy() for name, value in RoofCompletion().state_dict().items()}
    (z, _, logit), (bare_z, _, bare_logit) = (
        mixture_of(features_of(each), weights) for each in (padded, bare)
    )
    is_told = np.repeat(features_of(padded).is_token[0], 2)
    assert z[:, is_told] == pytest.approx(bare_z)
    assert logit[:, is_told] == pytest.approx(bare_logit)
    assert (logit[:, ~is_told] == -1e4).all()


def test_the_loss_is_least_for_the_right_plane() -> None:
    """The negative log-likelihood of one plane with a Laplace distribution."""
    z, slope = torch.tensor([[0.5]]), torch.tensor([[[0.1, 0.2]]])
    log_deviation, logit = torch.tensor([[-2.0, -1.0]]), torch.tensor([[[50.0, -50.0]]])
    exact = Mixture(
        torch.tensor([[[0.5, 0.0]]]), torch.tensor([[[0.1, 0.2], [0.0, 0.0]]]), log_deviation, logit
    )
    assert float(completion_loss(exact, z, slope)) == pytest.approx(-2.0)
    off = exact._replace(z=torch.tensor([[[0.6, 0.0]]]), slope=torch.tensor([[[0.1, 0.3], [0.0, 0.0]]]))
    assert float(completion_loss(off, z, slope)) == pytest.approx(
        -2.0 + 0.1 * np.exp(2.0) + 3.0 * 0.1, rel=1e-5
    )


@pytest.mark.parametrize("num", [8, 20])
def test_few_points_of_a_gable_roof_are_completed(num: int) -> None:
    """By a tenth of what the mean height is off, over ten draws: the planes are learnt, as eight points show slopes
    only by chance."""
    off_m, flat_m = [], []
    for seed in range(10):
        point_m = few_points(num, seed)
        roof_m = supposed_roof(HOUSE, point_m, np.zeros((0, 3)))
        true_z = gable_z(roof_m[:, :2])
        off_m.append(np.abs(roof_m[:, 2] - true_z).mean())
        flat_m.append(np.abs(point_m[:, 2].mean() - true_z).mean())
    assert len(roof_m) >= 64 and shapely.contains_xy(HOUSE, *roof_m[:, :2].T).all()
    assert np.mean(off_m) < 0.2 * np.mean(flat_m)


def test_the_result_turns_and_moves_with_the_building() -> None:
    point_m, turn = few_points(12), np.radians(33)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])

    def moved(each_m: np.ndarray) -> np.ndarray:
        return np.column_stack([each_m[:, :2] @ rotation + (700, -90), each_m[:, 2:] + 40])

    polygon = shapely.Polygon(moved(np.pad(shapely.get_coordinates(HOUSE), ((0, 0), (0, 1))))[:, :2])
    roof_m = supposed_roof(HOUSE, point_m, np.zeros((0, 3)))
    other_m = supposed_roof(polygon, moved(point_m), np.zeros((0, 3)))
    # heights are in whole centimetres
    assert other_m == pytest.approx(moved(roof_m), abs=0.011)


def test_too_many_vertices_and_too_many_points() -> None:
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    radius_m = np.where(np.arange(90) % 2, 20, 9)[:, None]
    star = shapely.Polygon(radius_m * np.column_stack([np.cos(angle), np.sin(angle)]))
    assert supposed_roof(star, few_points(9), np.zeros((0, 3))).shape == (0, 3)
    for turn_deg in (0, 45):  # of the building, not of the box around it
        long = shapely.affinity.rotate(shapely.box(0, 0, 95, 8), turn_deg)
        assert supposed_roof(long, few_points(9), np.zeros((0, 3))).shape == (0, 3)
    thin = shapely.box(0, 0, 12, 0.05)
    assert len(supposed_roof(thin, few_points(9), np.zeros((0, 3)))) < 200
    many = supposed_roof(HOUSE, few_points(3000), few_points(500, 1) + np.array([0, 20, 0]))
    assert np.abs(many[:, 2] - gable_z(many[:, :2])).mean() < 0.1


def test_the_weights_are_those_of_the_network() -> None:
    shipped = {name: value.shape for name, value in supposed._weights().items()}
    assert shipped == {name: tuple(value.shape) for name, value in RoofCompletion().state_dict().items()}
