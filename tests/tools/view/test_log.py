"""The log: what is read out of an episode's ticks."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_tools import begun

from acsar_gym.errors import ConfigError
from acsar_gym.recording.messages import STEP_COLUMNS
from acsar_gym.safety.rules import Reason
from acsar_gym.tools.view.app import LINES_AFTER, LINES_BEFORE, make_lines
from acsar_gym.tools.view.log import ERROR, NOTE, WARNING, LogLine, list_lines
from acsar_gym.tools.view.session import Session
from acsar_gym.tools.view.tail import TICK_PLACES, GrowingEpisode, RecordingTail

LATE = 0.001
"""A tick is late from here on [s]."""


@pytest.fixture
def episode(tape: Path) -> GrowingEpisode:
    (found,) = RecordingTail(tape).episodes
    return found


def test_a_calm_drive_only_begins(episode: GrowingEpisode) -> None:
    episode.info = {"seed": 3, "world": 17, "goal": [1.0, 2.0]}
    assert list_lines(episode, LATE) == [LogLine(0.0, NOTE, "begins: seed 3, world 17")]


@pytest.mark.parametrize(
    ("column", "rows", "value", "level", "text"),
    [
        ("reason", [50], Reason.GEOFENCE, WARNING, "outside the geofence: held"),
        ("reason", range(50, 61), Reason.EMERGENCY_STOP, ERROR, "emergency stop: held for 0.1 s"),
        ("reason", range(50, 61), Reason.LIMITS, None, ""),
        ("lateness", [50], 0.0034, WARNING, "late: one tick, by 3.4 ms"),
        ("lateness", [50, 90], 0.01, WARNING, "late: 2 ticks in 0.4 s, at worst by 10.0 ms"),
        ("refused", range(50, 120), 7.0, WARNING, "7 parts of the input were refused"),
    ],
)
def test_what_happened_is_a_line_at_its_time(
    episode: GrowingEpisode, column: str, rows: Any, value: float, level: int | None, text: str
) -> None:
    (calm,) = list_lines(episode, LATE)
    episode.ticks.rows[list(rows), TICK_PLACES[column]] = value
    stamp = float(episode.column("stamp")[50])
    expected = [] if level is None else [LogLine(stamp, level, text)]
    assert list_lines(episode, LATE) == [calm, *expected]


def test_things_that_are_apart_are_lines_of_their_own(episode: GrowingEpisode) -> None:
    episode.ticks.rows[[5, 118], TICK_PLACES["lateness"]] = 0.002
    assert len(list_lines(episode, LATE)) == 3


def test_missing_periods_contact_faults_and_the_end_are_told(episode: GrowingEpisode) -> None:
    episode.ticks.rows[40:, TICK_PLACES["exchange"]] += 3.0
    episode.truth.rows[60:, 4] = 1.0
    episode.faults.append((1.19, "the board is silent"))
    steps = np.array([[0, 0.0, np.nan, 0, 0, 0], [1, 1.2, -3.0, 1, 0, 0]])
    assert steps.shape[1] == len(STEP_COLUMNS)
    episode.steps.add(steps, 1)
    assert [(level, text) for _, level, text in list_lines(episode, LATE)][1:] == [
        (WARNING, "3 control periods aren't recorded"),
        (ERROR, "touches an obstacle"),
        (ERROR, "the board is silent"),
        (WARNING, "ends: failed, 1 step, return -3.0"),
    ]
    episode.steps.rows[-1, 3:5] = 0, 1
    assert list_lines(episode, LATE)[-1].text == "ends: cut short by a fault, 1 step, return -3.0"


def test_an_end_that_is_missing_is_told(tape: Path, tmp_path: Path) -> None:
    whole = Session(tape)
    assert whole.list_lines(0)[-1].text == "the recording ends"
    assert whole.tail._collector.end is not None
    whole.tail._collector.end["dropped"] = 1234
    assert whole.list_lines(0)[-1].text == "the recording ends; 1,234 events were dropped"
    path = tmp_path / "cut.mcap"
    path.write_bytes(begun(tape))
    os.utime(path, (0, 0))
    line = Session(path).list_lines(0)[-1]
    assert (line.level, line.text) == (WARNING, "the recording's end is missing")


def test_the_newest_lines_are_on_top_and_not_too_many_are_shown() -> None:
    lines = [LogLine(float(time), NOTE, f"line {time}") for time in range(200)]
    shown = make_lines(lines, 100.0)
    assert len(shown) == LINES_AFTER + LINES_BEFORE + 2
    assert shown[0].children == f"{99 - LINES_AFTER} later"
    assert shown[1].className == "level0 later"
    now = shown[1 + LINES_AFTER]
    assert (now.className, now.children.children[1]) == ("level0", "line 100")
    assert shown[-1].children == f"{101 - LINES_BEFORE} earlier"


def test_a_damaged_step_is_refused(episode: GrowingEpisode) -> None:
    with pytest.raises(ConfigError, match="damaged"):
        episode.steps.add(np.array([[0, np.nan, 0, 0, 0, 0]], np.float64), 1)
