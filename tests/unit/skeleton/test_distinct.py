"""Different values, as numpy finds them."""

from __future__ import annotations

import numpy as np
import pytest

from p2wss.fit.points import quantile
from p2wss.mesh.topology import face_numbers, first_of_faces, twins
from p2wss.skeleton.types import distinct, numbered


@pytest.mark.parametrize("size", [0, 1, 2, 50])
def test_different_values_and_their_numbers_are_those_of_numpy(size: int) -> None:
    value = np.random.default_rng(size).integers(0, 20, size)
    expected, number = np.unique(value, return_inverse=True)
    assert np.array_equal(distinct(value), expected)
    assert all(np.array_equal(*each) for each in zip(numbered(value), (expected, number), strict=True))
    assert np.array_equal(distinct(value - 2j * value), np.unique(value - 2j * value))


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.7, 1.0])
def test_a_quantile_is_that_of_numpy_to_the_bit(share: float) -> None:
    rng = np.random.default_rng(1)
    for size in (1, 2, 3, 40):
        value = rng.uniform(0, 9, size)
        assert quantile(value, share) == np.quantile(value, share)


def test_the_first_triangle_of_each_face() -> None:
    # the sides of a tetrahedron, two of which are of one plane
    triangle = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    face = face_numbers(twins(triangle), np.array([4, 7, 4, 9]))
    assert face.tolist() == [0, 1, 0, 2] and first_of_faces(face).tolist() == [0, 1, 3]
