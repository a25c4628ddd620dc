"""The compiled generator gives the numbers of NumPy's own."""

from __future__ import annotations

import numpy as np

from acsar_gym import jit
from acsar_gym.vector import pcg


def next_of(rows: pcg.Generators, i: int) -> float:
    return pcg.uniform(rows, i)


uniform = jit.loop(next_of)


def test_lent_generators_go_on_where_numpy_ends() -> None:
    rows = np.array([pcg.seed_row(seed) for seed in (1, 2, 3)], np.uint64)
    expected = np.random.default_rng(3)
    generators: dict[int, np.random.Generator] = {}
    for _ in range(3):
        assert uniform(rows, 2) == expected.random()
        lent = pcg.LentGenerators(rows, [0, 2], generators)
        assert lent[1].normal(size=3).tolist() == expected.normal(size=3).tolist()
        half = expected.integers(1 << 30, dtype=np.int32)
        assert lent[1].integers(1 << 30, dtype=np.int32) == half
        lent.give_back()
    assert set(generators) == {2}
    assert [len(lent), len(lent[:])] == [2, 2]
    assert rows[1].tolist() == list(pcg.seed_row(2))
