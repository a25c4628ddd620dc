"""NumPy's PCG64 for compiled loops: the same numbers from the same seed as `np.random.Generator`.

A generator is a row of four uint64: state (high, low) and increment (high, low). The algorithm is
PCG XSL RR 128/64 of O'Neill (2014), as NumPy documents it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit

Generators = NDArray[np.uint64]  # (n, 4): one generator a row

_MULTIPLIER_HIGH = np.uint64(2549297995355413924)
_MULTIPLIER_LOW = np.uint64(4865540595714422341)
_WORD = (1 << 64) - 1
_HALF = np.uint64(32)
_MASK = np.uint64(0xFFFFFFFF)


def seed_row(seed: int | None) -> tuple[int, int, int, int]:
    """Row of a new `np.random.PCG64(seed)`. None draws a seed from the system."""
    return row_of(np.random.PCG64(seed))


def row_of(bits: np.random.BitGenerator) -> tuple[int, int, int, int]:
    """Row of a generator with the state of a NumPy PCG64."""
    inner: Any = bits.state["state"]
    state = inner["state"]
    increment = inner["inc"]
    return (state >> 64, state & _WORD, increment >> 64, increment & _WORD)


class LentGenerators(Sequence[np.random.Generator]):
    """NumPy generators that go on from the states of some rows, until `give_back` stores theirs.

    Args:
        rows: The generators' rows.
        which: Numbers of the rows that are lent.
        generators: NumPy generators by number of the row, which are made when first used. They are
            kept, because they remember half of a number if 32 bits were drawn.
    """

    def __init__(
        self, rows: Generators, which: Sequence[int], generators: dict[int, np.random.Generator]
    ) -> None:
        self._rows = rows
        self._which = which
        self._generators = generators
        self._lent: set[int] = set()

    def __len__(self) -> int:
        return len(self._which)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[place] for place in range(*index.indices(len(self)))]

        number = self._which[index]
        if number not in self._generators:
            self._generators[number] = np.random.Generator(np.random.PCG64(0))
        generator = self._generators[number]

        if number not in self._lent:
            self._lent.add(number)
            high, low, increment_high, increment_low = self._rows[number].tolist()
            state: Any = generator.bit_generator.state
            state["state"] = {
                "state": high << 64 | low,
                "inc": increment_high << 64 | increment_low,
            }
            generator.bit_generator.state = state
        return generator

    def give_back(self) -> None:
        """Write the states of the generators back into the rows."""
        for number in self._lent:
            row = row_of(self._generators[number].bit_generator)
            self._rows[number] = np.array(row, np.uint64)
        self._lent = set()


@jit
def _high(a: np.uint64, b: np.uint64) -> np.uint64:
    """Upper half of the 128-bit product of two 64-bit numbers."""
    a_low = a & _MASK
    a_high = a >> _HALF
    b_low = b & _MASK
    b_high = b >> _HALF
    middle = a_high * b_low + ((a_low * b_low) >> _HALF)
    upper_middle = a_low * b_high + (middle & _MASK)
    return a_high * b_high + (middle >> _HALF) + (upper_middle >> _HALF)


@jit
def uniform(generators: Generators, i: int) -> float:
    """The next double in [0, 1) of generator i, equal to `Generator.random()`."""
    # The next state: 128-bit multiplication and addition.
    high = generators[i, 0]
    low = generators[i, 1]
    new_low = low * _MULTIPLIER_LOW
    new_high = _high(low, _MULTIPLIER_LOW) + high * _MULTIPLIER_LOW + low * _MULTIPLIER_HIGH
    low = new_low + generators[i, 3]
    carry = np.uint64(1) if low < new_low else np.uint64(0)
    high = new_high + generators[i, 2] + carry
    generators[i, 0] = high
    generators[i, 1] = low

    # Its halves, folded and rotated.
    word = high ^ low
    turn = high >> np.uint64(58)
    word = (word >> turn) | (word << ((np.uint64(64) - turn) & np.uint64(63)))
    return float(word >> np.uint64(11)) * (1.0 / 9007199254740992.0)
