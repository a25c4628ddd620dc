"""Lots of lines: a hash that the single link and the batch share."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from acsar_gym.links.faults import (
    COMMAND_LINE,
    FAULT_KINDS,
    FEEDBACK_LINE,
    WHOLE_EPISODE,
    line_hash,
)

WORD = (1 << 64) - 1


def split_mix(word: int) -> int:
    """SplitMix64's output function, in whole numbers."""
    word = ((word ^ (word >> 30)) * 0xBF58476D1CE4E5B9) & WORD
    word = ((word ^ (word >> 27)) * 0x94D049BB133111EB) & WORD
    return word ^ (word >> 31)


@pytest.mark.parametrize("key", [0.0, 0.5, 0.1234567890123, 1.0 - 2.0**-53])
def test_lots_are_split_mix_64(key: float) -> None:
    for whose, number, kind in itertools.product((0, 1, 2), (0, 1, 7, 100_000), (0, 4)):
        count = (number * 3 + whose) * FAULT_KINDS + kind + 1
        word = split_mix(((int(key * 2**53) << 11) + count * 0x9E3779B97F4A7C15) & WORD)
        assert line_hash(key, whose, float(number), kind) == (word >> 11) / 2**53


def test_lots_are_uniform_and_independent() -> None:
    keys = np.random.default_rng(0).random(20).tolist()
    rows = [
        [line_hash(key, whose, float(number), kind) for key in keys for number in range(200)]
        for whose, kind in (
            (FEEDBACK_LINE, 0),
            (FEEDBACK_LINE, 4),
            (COMMAND_LINE, 0),
            (WHOLE_EPISODE, 0),
        )
    ]
    table = np.array(rows)
    assert np.histogram(table, 10, (0.0, 1.0))[0] / table.size == pytest.approx(0.1, abs=0.01)
    assert np.corrcoef(table) == pytest.approx(np.eye(4), abs=0.06)
    assert np.corrcoef(table[0, 1:], table[0, :-1])[0, 1] == pytest.approx(0.0, abs=0.06)
