"""The benchmark's bookkeeping; its speeds are for people to read."""

from __future__ import annotations

import bench
import pytest

SMALL = {
    "ENV_BLOCKS": 2,
    "ENV_STEPS": 3,
    "BATCH_ROBOTS": 8,
    "BATCH_WORLDS": 2,
    "MOVER_ROBOTS": 8,
    "PATH_POINTS": 20,
}


def test_every_figure_is_a_positive_number(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, size in SMALL.items():
        monkeypatch.setattr(bench, name, size)
    figures = bench.measure_all()
    assert all(figure.value > 0.0 for figure in figures)
    assert len({figure.name for figure in figures}) == len(figures) == 33
    assert bench.figure_table(figures).row_count == 33
