"""The bookkeeping of `make bench`, whose speeds are for people to read."""

from __future__ import annotations

import bench
import pytest

COMPILES = (bench.measure_batches, bench.measure_movers)
"""These compile for a quarter of a minute, and use the same functions as the others."""


def test_bench_figures_are_positive_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "BLOCKS", 2)
    monkeypatch.setattr(bench, "ENV_STEPS", 3)
    figures = [
        figure for measure in bench.MEASUREMENTS if measure not in COMPILES for figure in measure()
    ]
    assert all(value > 0.0 for _, value, _ in figures)
    assert len({name for name, _, _ in figures}) == len(figures) == 22
    assert bench.make_table(figures).row_count == 22
