"""The compiled generator gives the numbers of NumPy's own."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym import jit
from acsar_gym.vector import pcg


def next_of(rows: pcg.Generators, i: int) -> float:
    return pcg.uniform(rows, i)


uniform = jit.loop(next_of)


@given(st.integers(0, 2**64))
def test_the_same_seed_gives_the_same_numbers(seed: int) -> None:
    row = np.array([pcg.seed_row(seed)], np.uint64)
    expected = np.random.default_rng(seed).random(20)
    assert [uniform(row, 0) for _ in range(20)] == expected.tolist()


def test_rows_that_are_lent_to_numpy_go_on_where_it_ends() -> None:
    rows = np.array([pcg.seed_row(seed) for seed in (1, 2, 3)], np.uint64)
    whole, made = np.random.default_rng(3), dict[int, pcg.Lent]()
    for _ in range(3):
        assert uniform(rows, 2) == whole.random()
        lent = pcg.LentGenerators(rows, [0, 2], made)
        assert lent[1].normal(size=3).tolist() == whole.normal(size=3).tolist()
        small = np.int32
        assert lent[1].integers(1 << 30, dtype=small) == whole.integers(1 << 30, dtype=small)
        lent.give_back()
    assert set(made) == {2}  # nobody has asked for the others
    assert [len(lent), len(lent[:])] == [2, 2]
    assert rows[1].tolist() == list(pcg.seed_row(2))
