import doctest

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from p2wss.data import seeds, tiling
from p2wss.storage.messages import InputError


def test_examples_in_docstrings():
    for module in (tiling, seeds):
        result = doctest.testmod(module)
        assert result.attempted > 0 and result.failed == 0


@given(
    st.floats(100_000, 1_200_000),
    st.floats(6_000_000, 7_100_000),
    st.sampled_from([250.0, 500.0, 1000.0, 2000.0]),
)
def test_every_point_is_in_exactly_one_tile(x, y, size):
    (name,) = tiling.tiles_of_points(np.array([x]), np.array([y]), size)
    x_min, y_min, x_max, y_max = tiling.tile_bounds(name, size)
    assert x_min <= x < x_max and y_min < y <= y_max
    assert name in list(tiling.tiles_of_bounds((x - 1, y - 1, x + 1, y + 1), size))
    assert name not in tiling.neighbours(name, size)


def test_tiles_of_bounds_on_the_grid_lines():
    assert list(tiling.tiles_of_bounds((652000, 6860000, 654000, 6862000), 1000)) == [
        "0652_6862",
        "0653_6862",
        "0652_6861",
        "0653_6861",
    ]


def test_margin_and_bad_name():
    assert tiling.tile_bounds("0652500_6862000", 500, 10) == (652490, 6861490, 653010, 6862010)
    with pytest.raises(InputError, match="0652-6862"):
        tiling.tile_bounds("0652-6862", 1000)
