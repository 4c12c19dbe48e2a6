"""The steps of edges and the shift that follows from them, on points whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from p2wss.reconstruction.registration.shifts import edge_steps, search_shift, solve_shift

# the outside is on the right: at x > 0
WALL = np.array([[0.0, 0.0, 0.0, 10.0]])


def steps_of(roofs: list[tuple[float, float]]) -> np.ndarray:
    """The step of the wall. Roofs: ranges of x; ground everywhere else."""
    draw = np.random.default_rng(0)
    x_m, y_m = draw.uniform(-2, 2, 800), draw.uniform(0, 10, 800)
    weight = np.full(800, -1.0)
    for low, high in roofs:
        weight[(x_m > low) & (x_m < high)] = 1.0
    return edge_steps(WALL, x_m, y_m, weight)[0]


@pytest.mark.parametrize("offset_m", [-0.3, 0.0, 0.4])
def test_a_wall_has_its_step_where_the_roof_ends(offset_m: float) -> None:
    assert steps_of([(-2, offset_m)]) == pytest.approx([offset_m], abs=0.06)


def test_an_edge_without_a_building_has_no_step() -> None:
    assert np.isnan(steps_of([])).all()


def test_an_edge_at_the_border_of_the_data_has_no_step() -> None:
    """Ground up to 0.8 m beyond the roof may be all that was read."""
    draw = np.random.default_rng(0)
    x_m, y_m = draw.uniform(-2, 0.1, 800), draw.uniform(0, 10, 800)
    for width_m, is_shown in ((0.0, False), (2.0, True)):
        ground_x, ground_y = draw.uniform(0.1, 0.2 + width_m, 400), draw.uniform(0, 10, 400)
        weight = np.concatenate([np.ones(800), -np.ones(400)])
        if not is_shown:
            ground_x, ground_y = ground_x[:60], ground_y[:60]
            weight = weight[:860]
        step_m, _ = edge_steps(WALL, np.concatenate([x_m, ground_x]), np.concatenate([y_m, ground_y]), weight)
        assert np.isfinite(step_m[0]) == is_shown


@pytest.mark.parametrize(
    ("offset_m", "border_m", "is_shown"), [(0.8, 1.0, False), (0.8, 1.6, True), (-0.7, 0.1, True)]
)
def test_the_data_go_on_beyond_a_step_wherever_its_edge_is(
    offset_m: float, border_m: float, is_shown: bool
) -> None:
    """Of the data that end 0.2 m or 0.8 m beyond the roof."""
    draw = np.random.default_rng(0)
    x_m, y_m = draw.uniform(-2, border_m, 1200), draw.uniform(0, 10, 1200)
    step_m, _ = edge_steps(WALL, x_m, y_m, np.where(x_m < offset_m, 1.0, -1.0))
    assert step_m == pytest.approx([offset_m if is_shown else np.nan], abs=0.06, nan_ok=True)


@pytest.mark.parametrize("num_points", [20, 60, 800])
def test_the_deviation_of_a_step_holds_whatever_the_density(num_points: int) -> None:
    """Two deviations in 95 of 100 cases, for a wall of 4 m, and at few points not many times the error."""
    draw, wall = np.random.default_rng(0), np.array([[0.0, 0.0, 0.0, 4.0]])
    off_m, stated_m = [], []
    for _ in range(400):
        x_m, y_m = draw.uniform(-4, 4, num_points), draw.uniform(0, 4, num_points)
        step_m, sd_m = edge_steps(wall, x_m, y_m, np.where(x_m < 0.1, 1.0, -1.0))
        if np.isfinite(step_m[0]):
            off_m.append(step_m[0] - 0.1)
            stated_m.append(sd_m[0])
    assert len(off_m) > 200
    assert np.mean(np.abs(off_m) <= 2 * np.array(stated_m)) >= 0.95
    assert np.mean(stated_m) < 0.1 + 2.5 * np.std(off_m)


def test_steps_that_disagree_are_less_certain() -> None:
    """Sixteen edges to one side, whose steps differ by far more than by their deviations."""
    corner = np.column_stack([np.linspace(0, 8, 17), np.tile([0, 1.0], 9)[:17]])
    edge = np.column_stack([corner[:-1], corner[1:]])
    sd_m = []
    for spread_m in (0.0, 0.1, 0.4):
        step_m = spread_m * np.tile([-1.0, 1.0, 1.0, -1.0], 4)
        sd_m.append(solve_shift(edge, step_m, np.full(16, 0.1), np.zeros(2)).sd_m)
    assert sd_m[1] < 1.3 * sd_m[0] and sd_m[2] > 1.5 * sd_m[0]


def test_one_wrong_step_hardly_moves_a_block() -> None:
    """Eight edges around a block that is 0.4 m and 0.2 m off; an annex without a footprint hides one of them."""
    corner = np.array([[0, 0], [6, 0], [12, 0], [12, 5], [12, 10], [6, 10], [0, 10], [0, 5.0]])
    edge = np.column_stack([corner, np.roll(corner, -1, axis=0)])
    along = edge[:, 2:] - edge[:, :2]
    normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    step_m = normal @ [0.4, 0.2]
    step_m[0] += 1.2
    estimate = solve_shift(edge, step_m, np.full(len(edge), 0.1), np.zeros(2))
    assert estimate.shift_m == pytest.approx([0.4, 0.2], abs=0.05)
    assert 0.1 < estimate.sd_m < 0.25


@pytest.mark.parametrize("gap_m", [0.5, 1.0, 1.2])
@pytest.mark.parametrize("num_hidden", [0, 1])
def test_no_single_edge_moves_a_rectangle(gap_m: float, num_hidden: int) -> None:
    """A deck, a low annex or a roof next door that has no footprint misplaces one step."""
    edge = np.array([[0, 0, 8, 0], [8, 0, 8, 6], [8, 6, 0, 6], [0, 6, 0, 0.0]])
    for misled in range(4):
        step_m = np.zeros(4)
        step_m[misled] = -gap_m
        step_m[(misled + 1) % 4] = np.nan if num_hidden else 0.0
        estimate = solve_shift(edge, step_m, np.full(len(edge), 0.1), np.zeros(2))
        assert np.linalg.norm(estimate.shift_m) < estimate.sd_m


def test_a_deviation_of_rectangles_holds() -> None:
    """Two of them, in 95 of 100 cases, with steps that are good to 10 cm, and one in ten that is not."""
    draw, held = np.random.default_rng(0), []
    edge = np.array([[0, 0, 8, 0], [8, 0, 8, 6], [8, 6, 0, 6], [0, 6, 0, 0.0]])
    normal = np.array([[0, -1], [1, 0], [0, 1], [-1, 0.0]])
    for _ in range(1000):
        shift_m = draw.uniform(-0.5, 0.5, 2)
        step_m = normal @ shift_m + 0.1 + draw.normal(0, 0.1, 4)
        if draw.uniform() < 0.4:
            step_m[draw.integers(4)] += draw.uniform(-1.2, 1.2)
        estimate = solve_shift(edge, step_m, np.full(len(edge), 0.1), np.zeros(2))
        held.append(np.linalg.norm(estimate.shift_m - shift_m) <= 2 * estimate.sd_m)
    assert np.mean(held) >= 0.95


def test_wide_eaves_seen_from_one_side_are_no_clear_shift() -> None:
    """Five fronts along a bend, whose eaves reach 0.7 m beyond; where their backs should be, there are no data."""
    angle = np.linspace(-np.pi / 6, np.pi / 6, 6)
    corner = 20 * np.column_stack([np.cos(angle), np.sin(angle)])
    edge = np.column_stack([corner[:-1], corner[1:]])
    assert solve_shift(edge, np.full(5, 0.7), np.full(5, 0.1), np.zeros(2)).sd_m > 0.5
    both_sides = np.concatenate([edge, -edge])
    assert solve_shift(both_sides, np.full(10, 0.7), np.full(10, 0.1), np.zeros(2)).sd_m < 0.2


def test_without_points_nothing_is_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """As for 99,980 of 100,000 footprints whose cloud covers 20."""
    edge = np.array([[0.0, 0, 9, 0], [9, 0, 9, 9], [9, 9, 0, 9], [0, 9, 0, 0]])
    monkeypatch.setattr(np.fft, "rfft2", None)
    assert search_shift(edge, np.zeros((0, 2)), np.zeros(0)).tolist() == [0, 0]
    with pytest.raises(TypeError):
        search_shift(edge, np.full((1, 2), 3.0), np.ones(1))
