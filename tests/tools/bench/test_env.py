"""The benchmark's bookkeeping; its speeds are for people to read."""

from __future__ import annotations

import pytest

from acsar_gym.tools import bench
from acsar_gym.tools import bench as bench_recording
from acsar_gym.tools import bench as bench_worlds

SMALL = {"BLOCKS": 2, "STEPS": 3, "ROBOTS": 8, "CROWDS": 2, "POINTS": 20}


@pytest.mark.parametrize("sizes", [SMALL, pytest.param({"BLOCKS": 2}, marks=pytest.mark.slow)])
def test_every_figure_is_a_positive_number(
    sizes: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (bench, bench_worlds, bench_recording):
        for name in sizes.keys() & vars(module).keys():
            monkeypatch.setattr(module, name, sizes[name])
    figures = bench.measure_all()
    assert all(figure.value > 0.0 for figure in figures)
    assert len({figure.name for figure in figures}) == len(figures) == 30
    assert bench.figure_table(figures).row_count == 30


def test_the_bare_engine_makes_as_many_calls_as_the_env() -> None:
    env = bench._env("bullet")
    step = bench._engine(env)
    step()
    env.close()
