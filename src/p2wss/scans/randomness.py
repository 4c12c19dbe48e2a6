"""Counter-based randomness: the draw of a pulse depends on its key and number, never on what was drawn
before.

So a scan has the same points whatever the chunk size, the number of threads or the order of the work. The
hash is the finaliser of SplitMix64 (Steele, Lea, Flood 2014, "Fast splittable pseudorandom number
generators"). Normal deviates are looked up in a table of 2^12 quantiles that fits the first-level cache: four
per hash, ten times cheaper than Box-Muller; they end at 3.67 standard deviations.
"""

import numpy as np
from scipy.special import ndtri

from p2wss.skeleton.compiled import entry, inlined

# float32 (4096,): entry i is the standard normal quantile of (i + 1/2) / 4096
NORMAL_QUANTILE = ndtri((np.arange(4096) + 0.5) / 4096).astype(np.float32)

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31 = np.uint64(30), np.uint64(27), np.uint64(31)


@inlined
def random_bits(key: np.uint64, counter: np.uint64) -> np.uint64:
    """64 random bits: draw number ``counter`` of the stream ``key``."""
    z = key + (counter + np.uint64(1)) * _GOLDEN
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@inlined
def normal(bits: np.uint64, which: int, quantile: np.ndarray) -> float:
    """Standard normal deviate number ``which`` (0 to 3) of ``bits``, each from its own 12 bits.

    ``quantile`` is :data:`NORMAL_QUANTILE`, an argument because numba would copy a global table into the
    code.
    """
    return np.float64(quantile[np.int64((bits >> np.uint64(16 * which)) & np.uint64(0xFFF))])


@inlined
def uniform(bits: np.uint64) -> float:
    """Uniform deviate in [0, 1) from the upper 53 of ``bits``."""
    return np.float64(bits >> np.uint64(11)) * 1.1102230246251565e-16


@entry
def uniforms(key: np.ndarray, first: int, count: int) -> np.ndarray:
    """Draws ``first`` to ``first + count`` of each stream, float64 (len(key), count). key: uint64 (n,)."""
    result = np.empty((len(key), count))
    for i in range(len(key)):
        for j in range(count):
            result[i, j] = uniform(random_bits(key[i], np.uint64(first + j)))
    return result
