"""Tables that grow, lines of fewer points, and the view from above."""

from __future__ import annotations

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.tools.view.drawing import (
    ViewContents,
    draw_top_view,
    thin_evenly,
    thin_keeping_peaks,
)
from acsar_gym.tools.view.tail import INITIAL_ROWS, GrowingTable
from acsar_gym.worlds import World


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


def test_ends_are_among_evenly_chosen_points() -> None:
    assert thin_evenly(3, 10).tolist() == [0, 1, 2]
    chosen = thin_evenly(1000, 10)
    assert (len(chosen), chosen[0], chosen[-1]) == (10, 0, 999)


def test_others_draw_a_robot_from_above_without_a_recording() -> None:
    config = RobotConfig.of(None)
    world = World(segments=np.array([[2.0, -1.0, 2.0, 1.0]]))
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.3]])
    few = draw_top_view(config, poses[:0])
    around = ViewContents(goal=(7.3, 0.0), world=world, truth=poses[:, :2])
    more = draw_top_view(config, poses, 1, around)
    names = [[trace["name"] for trace in drawn["data"]] for drawn in (few, more)]
    assert set(names[1]) - set(names[0]) == {"obstacles", "walls", "true path", "goal"}
    assert more["layout"]["xaxis"]["range"] == [-1.0, 9.0]
