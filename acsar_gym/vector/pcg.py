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
    """Row of a new `np.random.PCG64(seed)`; None draws a seed from the system."""
    return row_of(np.random.PCG64(seed))


def row_of(bits: np.random.BitGenerator) -> tuple[int, int, int, int]:
    """Row of a generator with the state of a NumPy PCG64."""
    inner: Any = bits.state["state"]
    state, increment = inner["state"], inner["inc"]
    return state >> 64, state & _WORD, increment >> 64, increment & _WORD


Lent = tuple[np.random.Generator, tuple[int, ...]]
"""A NumPy generator, and its row when it was given back."""


class LentGenerators(Sequence[np.random.Generator]):
    """NumPy generators that go on where some rows are, until `give_back` stores their states."""

    def __init__(self, rows: Generators, which: Sequence[int], made: dict[int, Lent]) -> None:
        """Make no generator yet; each is made when it is first used."""
        self._rows, self._which, self._made = rows, which, made
        self._lent: dict[int, np.random.Generator] = {}

    def __len__(self) -> int:
        return len(self._which)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[place] for place in range(*index.indices(len(self)))]
        row = self._which[index]
        if row not in self._lent:
            numbers = tuple(self._rows[row].tolist())
            if row not in self._made:
                self._made[row] = np.random.Generator(np.random.PCG64(0)), ()
            generator, left = self._made[row]
            if numbers != left:  # compiled loops have drawn since
                state: Any = generator.bit_generator.state
                state["state"] = {
                    "state": numbers[0] << 64 | numbers[1],
                    "inc": numbers[2] << 64 | numbers[3],
                }
                generator.bit_generator.state = state
            self._lent[row] = generator
        return self._lent[row]

    def give_back(self) -> None:
        """Write the states of the generators back into the rows."""
        if self._lent:
            left = [row_of(generator.bit_generator) for generator in self._lent.values()]
            self._rows[list(self._lent)] = np.array(left, np.uint64)
            self._made.update(
                zip(self._lent, zip(self._lent.values(), left, strict=True), strict=True)
            )
        self._lent = {}


@jit
def _high(a: np.uint64, b: np.uint64) -> np.uint64:
    """Upper half of the 128-bit product of two 64-bit numbers."""
    a_low, a_high, b_low, b_high = a & _MASK, a >> _HALF, b & _MASK, b >> _HALF
    middle = a_high * b_low + ((a_low * b_low) >> _HALF)
    other = a_low * b_high + (middle & _MASK)
    return a_high * b_high + (middle >> _HALF) + (other >> _HALF)


@jit
def uniform(generators: Generators, i: int) -> float:
    """The next double in [0, 1) of generator i, equal to `Generator.random()`."""
    high, low = generators[i, 0], generators[i, 1]
    new_low = low * _MULTIPLIER_LOW
    new_high = _high(low, _MULTIPLIER_LOW) + high * _MULTIPLIER_LOW + low * _MULTIPLIER_HIGH
    low = new_low + generators[i, 3]
    carry = np.uint64(1) if low < new_low else np.uint64(0)
    high = new_high + generators[i, 2] + carry
    generators[i, 0], generators[i, 1] = high, low
    word = high ^ low
    turn = high >> np.uint64(58)
    word = (word >> turn) | (word << ((np.uint64(64) - turn) & np.uint64(63)))
    return float(word >> np.uint64(11)) * (1.0 / 9007199254740992.0)
