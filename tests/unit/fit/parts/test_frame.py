"""The frame of the cuts follows the roof where the footprint's edges do not."""

import numpy as np
import pytest

from p2wss.fit.parts.frame import roof_frame
from p2wss.fit.parts.parts import main_frame

# a square out of a larger building, as the border of a map cuts it
SQUARE = np.array([[0, 0], [12, 0], [12, 12], [0, 12.0]])
TURN_DEG = 40.0


def survey(turn_deg: float, noise_m: float = 0.02) -> np.ndarray:
    """Points on a gable roof whose ridge runs through the middle of the square, with a step of 3 m across it."""
    rng = np.random.default_rng(3)
    xy_m = rng.uniform(0, 12, (1800, 2))
    turn = np.radians(turn_deg)
    along = (xy_m - 6) @ [np.cos(turn), np.sin(turn)]
    across = (xy_m - 6) @ [-np.sin(turn), np.cos(turn)]
    z = 10 - 0.6 * np.abs(across) - 3.0 * (along > 2)
    return np.column_stack([xy_m, z + noise_m * rng.standard_normal(len(z))])


def direction_deg(frame: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(frame[1, 0], frame[0, 0])) % 90)


def test_the_frame_follows_the_slopes() -> None:
    assert direction_deg(roof_frame([SQUARE], survey(TURN_DEG))) == pytest.approx(TURN_DEG, abs=1.0)


@pytest.mark.parametrize("turn_deg, noise_m", [(0.0, 0.02), (3.0, 0.02), (TURN_DEG, 0.3)])
def test_the_frame_stays_that_of_the_walls_where_roofs_do_not_show_another(turn_deg, noise_m) -> None:
    assert np.array_equal(roof_frame([SQUARE], survey(turn_deg, noise_m)), main_frame([SQUARE]))


def test_the_frame_is_that_of_a_wall_nearby() -> None:
    """The direction that points show is uncertain by a degree; that of a wall is not."""
    corner = np.array([[0, 0], [12, 0], [12, 12], [4, 12], [0, 12 - 4 * np.tan(np.radians(TURN_DEG + 2))]])
    frame = roof_frame([corner], survey(TURN_DEG))
    assert direction_deg(frame) == pytest.approx(TURN_DEG + 2, abs=1e-9)
