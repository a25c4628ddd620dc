"""The benchmark's bookkeeping; its speeds are for people to read."""

from __future__ import annotations

import pytest

from acsar_gym import bench, bench_worlds


def test_every_figure_is_a_positive_number(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (bench, bench_worlds):
        monkeypatch.setattr(module, "BLOCKS", 2)
        monkeypatch.setattr(module, "STEPS", 3)
    figures = bench.measure()
    assert all(figure.value > 0.0 for figure in figures)
    assert len({figure.name for figure in figures}) == len(figures) == 26
    assert bench.table(figures).row_count == 26


def test_the_bare_engine_makes_as_many_calls_as_the_env() -> None:
    env = bench._env("bullet")
    step = bench._engine(env)
    step()
    env.close()
