"""Random numbers that are functions of a key: the same for one robot and for a batch."""

from __future__ import annotations

import numpy as np

from acsar_gym.jit import loop

_STEP = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_S11 = np.uint64(11)
_S27 = np.uint64(27)
_S30 = np.uint64(30)
_S31 = np.uint64(31)
_BITS = 2.0**53
"""Scales doubles in [0, 1) to integers."""


@loop
def hash_sample(key: float, number: int) -> float:
    """Uniform random number in [0, 1) of these inputs only: SplitMix64 (Steele, Lea, Flood, 2014).

    So a single robot and the robots of a batch draw the same number, in any order.
    """
    # All 53 bits of the key count. The step makes neighbouring numbers unrelated.
    word = (np.uint64(key * _BITS) << _S11) + np.uint64(number + 1) * _STEP
    word = (word ^ (word >> _S30)) * _FIRST
    word = (word ^ (word >> _S27)) * _SECOND
    word ^= word >> _S31
    return float(word >> _S11) * (1.0 / _BITS)
