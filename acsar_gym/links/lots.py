"""Which lines of an episode suffer: a hash of the episode's key, the direction and the number.

Nothing is drawn one after the other, so that the single robot's link and thousands of robots in a
batch lose the same lines, whatever else they draw. The hash is SplitMix64 of Steele, Lea and Flood
(2014).
"""

from __future__ import annotations

import numpy as np

from acsar_gym.jit import COMPILED, jit

FEEDBACK, COMMANDS, EPISODE = 0, 1, 2
"""Whose lot it is: a line of one direction, or the whole episode."""
KINDS = 8
"""Faults that a line may have, at most."""

_STEP = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_S11, _S27, _S30, _S31 = np.uint64(11), np.uint64(27), np.uint64(30), np.uint64(31)
_BITS = 9007199254740992.0
"""2^53: a double of [0, 1) as a whole number."""


@jit
def lot(key: float, whose: int, number: float, kind: int) -> float:
    """A number of [0, 1) for line `number` of one direction, and one kind of fault.

    `key`, of [0, 1), is the episode's.
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
        """The same in plain NumPy, whose scalars warn where words wrap around, as they must."""
        with np.errstate(over="ignore"):
            return _wrapping(key, whose, number, kind)
