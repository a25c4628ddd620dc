"""The compiled generator gives the numbers of NumPy's own."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym.vector import pcg


@given(st.integers(0, 2**64))
def test_the_same_seed_gives_the_same_numbers(seed: int) -> None:
    row = np.array([pcg.seeded(seed)], np.uint64)
    expected = np.random.default_rng(seed).random(20)
    assert [pcg.uniform(row, 0) for _ in range(20)] == expected.tolist()


def test_without_a_seed_generators_differ() -> None:
    assert pcg.seeded(None) != pcg.seeded(None)
