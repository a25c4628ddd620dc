"""Random numbers for the faults of single lines, hashed from episode key, direction and number.

Each number depends on these inputs only, not on other random numbers. So the link of a single robot
and the robots of a batch lose the same lines. The hash is SplitMix64 of Steele, Lea and Flood
(2014).
"""

from __future__ import annotations

import numpy as np

from acsar_gym.jit import COMPILED, loop

FEEDBACK, COMMANDS, EPISODE = 0, 1, 2
"""What a number is for: a line of one direction, or the whole episode."""
KINDS = 8
"""Largest number of kinds of faults per line."""

_STEP = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_S11, _S27, _S30, _S31 = np.uint64(11), np.uint64(27), np.uint64(30), np.uint64(31)
_BITS = 9007199254740992.0
"""2^53, which scales doubles in [0, 1) to integers."""


@loop
def lot(key: float, whose: int, number: float, kind: int) -> float:
    """Return a uniform random number in [0, 1) for one line and one kind of fault.

    Args:
        key: key of the episode, in [0, 1).
        whose: FEEDBACK, COMMANDS or EPISODE.
        number: number of the line.
        kind: kind of fault, below KINDS.
    """
    count = np.uint64((int(number) * 3 + whose) * KINDS + kind + 1)
    word = (np.uint64(key * _BITS) << _S11) + count * _STEP
    word = (word ^ (word >> _S30)) * _FIRST
    word = (word ^ (word >> _S27)) * _SECOND
    word ^= word >> _S31
    return float(word >> _S11) * (1.0 / _BITS)


if not COMPILED:
    _wrapping = lot

    def lot(key: float, whose: int, number: float, kind: int) -> float:
        """Return the same number without numba, ignoring NumPy's overflow warnings."""
        with np.errstate(over="ignore"):
            return _wrapping(key, whose, number, kind)
