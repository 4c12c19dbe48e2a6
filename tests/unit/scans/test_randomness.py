"""The hash is SplitMix64 and its deviates are normal and uniform."""

import numpy as np
from numba import njit
from scipy import stats

from p2wss.scans.randomness import NORMAL_QUANTILE, normal, random_bits, uniform

MASK = (1 << 64) - 1


@njit
def draw(key, count, quantile):
    bits = np.empty(count, np.uint64)
    normals = np.empty((count, 4))
    uniforms = np.empty(count)
    for i in range(count):
        bits[i] = random_bits(key, np.uint64(i))
        uniforms[i] = uniform(bits[i])
        for j in range(4):
            normals[i, j] = normal(bits[i], j, quantile)
    return bits, normals, uniforms


def splitmix64(state):
    """The published algorithm, in Python's whole numbers."""
    while True:
        state = (state + 0x9E3779B97F4A7C15) & MASK
        z = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & MASK
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
        yield z ^ (z >> 31)


def test_bits_are_the_published_sequence():
    for seed in (0, 1234567, MASK):
        bits, _, _ = draw(np.uint64(seed), 5, NORMAL_QUANTILE)
        expected = splitmix64(seed)
        assert bits.tolist() == [next(expected) for _ in range(5)]


def test_deviates_follow_their_laws():
    _, normals, uniforms = draw(np.uint64(42), 200_000, NORMAL_QUANTILE)
    assert abs(normals.mean(axis=0)).max() < 0.01
    assert abs(normals.std(axis=0) - 1).max() < 0.01
    assert abs(np.corrcoef(normals.T) - np.eye(4)).max() < 0.01
    assert stats.kstest(normals[:, 0], "norm").statistic < 0.005
    assert stats.kstest(uniforms, "uniform").statistic < 0.005
    assert uniforms.min() >= 0 and uniforms.max() < 1
