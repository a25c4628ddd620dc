"""Tables that grow, lines of fewer points, and the view from above."""

from __future__ import annotations

import numpy as np
import pytest

from acsar_gym.tools.view.drawing import (
    thin_keeping_peaks,
)
from acsar_gym.tools.view.tail import INITIAL_ROWS, GrowingTable


def test_rows_are_kept_while_more_are_added() -> None:
    table, every = GrowingTable(2), np.arange(6.0 * INITIAL_ROWS).reshape(-1, 2)
    before = table.rows
    for rows in np.array_split(every, 7):
        table.add(rows)
    assert len(before) == 0
    assert len(table) == len(every)
    assert (table.rows == every).all()


def test_no_peak_is_lost() -> None:
    values = np.sin(np.arange(180_000) / 500.0)
    values[77_777], values[123_456] = 9.0, -9.0
    chosen = thin_keeping_peaks(values, 500)
    assert len(chosen) <= 500
    assert {77_777, 123_456} <= set(chosen.tolist())
    assert (np.diff(chosen) > 0).all()


@pytest.mark.parametrize("count", [0, 1, 499, 500, 501, 1003])
def test_gaps_and_short_lines_are_allowed(count: int) -> None:
    values = np.full(count, np.nan)
    values[::3] = 1.0
    chosen = thin_keeping_peaks(values, 500)
    assert len(chosen) <= 500
    assert np.isin(chosen, np.arange(count)).all()
    assert np.isnan(values[thin_keeping_peaks(np.full(count, np.nan), 500)]).sum() <= count
