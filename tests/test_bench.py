"""The bookkeeping of `make bench`, whose speeds are for people to read."""

from __future__ import annotations

import bench
import pytest


def test_bench_figures_are_positive_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "BLOCKS", 2)
    monkeypatch.setattr(bench, "ENV_STEPS", 3)
    quick = set(bench.MEASUREMENTS) - {bench.measure_batches}  # which compiles for long
    figures = [figure for measure in quick for figure in measure()]
    assert all(value > 0.0 for _, value, _ in figures)
    assert len({name for name, _, _ in figures}) == len(figures) == 12
    assert bench.make_table(figures).row_count == 12
