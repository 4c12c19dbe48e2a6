"""Returns from walls are distinguished from those of roofs by how the heights of a column are spread."""

import numpy as np
import pytest

from p2wss.fit.points import wall_hits

RNG_SEED = 5


def flat_roof(
    low: tuple[float, float], high: tuple[float, float], z: float, density: float = 15
) -> np.ndarray:
    rng = np.random.default_rng(RNG_SEED)
    num = int(density * (high[0] - low[0]) * (high[1] - low[1]))
    return np.column_stack([rng.uniform(low, high, (num, 2)), z + 0.03 * rng.standard_normal(num)])


def wall(num: int, top_z: float) -> np.ndarray:
    """Points of a wall along y = 0, 0.1 m within the footprint."""
    rng = np.random.default_rng(RNG_SEED + 1)
    return np.column_stack(
        [rng.uniform(0, 10, num), rng.uniform(0.05, 0.15, num), rng.uniform(0, top_z, num)]
    )


def test_points_of_a_high_wall_are_found() -> None:
    roof, facade = flat_roof((0, 0), (10, 10), 15.0), wall(600, 15.0)
    is_wall = wall_hits(np.vstack([roof, facade]))
    assert not is_wall[: len(roof)].any()
    low = facade[:, 2] < 12
    assert is_wall[len(roof) :][low].mean() > 0.8


@pytest.mark.parametrize("height_m", [3.0, 6.0])
def test_a_low_roof_beside_a_wall_stays(height_m) -> None:
    """Its points lie at one height, also those right at the wall."""
    high, low = flat_roof((0, 0), (10, 10), 12.0), flat_roof((0, -4), (10, 0), height_m)
    is_wall = wall_hits(np.vstack([high, low]))
    assert is_wall[len(high) :].mean() < 0.03 and not is_wall[: len(high)].any()


def test_a_steep_roof_stays() -> None:
    roof = flat_roof((0, 0), (10, 10), 0.0)
    roof[:, 2] += 5 + np.tan(np.radians(60)) * np.minimum(roof[:, 1], 10 - roof[:, 1])
    assert wall_hits(roof).mean() < 0.02


def test_few_points_have_no_walls() -> None:
    assert not wall_hits(np.array([[0, 0, 0.0], [0, 0, 9], [0, 0, 9]])).any()
    assert wall_hits(np.zeros((0, 3))).shape == (0,)
