"""Rate and jitter of feedback lines, however late they were read; the step of printed speeds."""

from __future__ import annotations

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.protocol import encode
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid.board_log import (
    BoardTrack,
    Floats,
    LineRate,
    count_speed,
    decode_track,
    find_quantum,
    is_explained_by_counts,
    measure_line_rate,
)

ACSAR = RobotConfig.preset("acsar")
SPEEDS = np.random.default_rng(3).uniform(-11.0, 11.0, 3000)


def measure(*episodes: Floats) -> LineRate:
    """The rate of lines at these times."""
    tracks = []
    for stamps in episodes:
        count = len(stamps)
        numbers, held_out = np.arange(count), np.zeros(count, bool)
        nothing = np.zeros(1), np.zeros((1, 4))
        tracks.append(BoardTrack(*nothing, stamps, np.zeros((count, 4)), held_out, numbers))
    return measure_line_rate(tracks)


@pytest.mark.parametrize("stalled", [0.1, 0.4])
def test_a_stalled_host_reads_in_bursts(stalled: float) -> None:
    made = np.arange(1000) / 50.0
    read = made.copy()
    for begin in np.arange(1.0, 19.0, 1.5):  # nothing is read, then all at once
        late = (made >= begin) & (made < begin + stalled)
        read[late] = begin + stalled + 1e-4 * np.arange(np.count_nonzero(late))
    assert measure(read).rate == pytest.approx(50.0, rel=0.002)


def test_lines_that_a_fit_leaves_out_as_late_still_count() -> None:
    made = np.arange(2000) / 100.0
    read = made + 0.0003 * np.random.default_rng(0).random(2000)
    read[::30] += 0.0067
    said = (encode((1.0, 1.0, 1.0, 1.0)),) * 2000
    track = decode_track(WireLog(made, said, read, said), ACSAR)
    assert track is not None
    assert len(track.stamps) < 1960
    assert measure_line_rate([track]).rate == pytest.approx(100.0, abs=0.1)


def test_nothing_takes_time_on_a_wire_that_isnt_there() -> None:
    stamps, said = np.arange(200) / 100.0, (encode((1.0, 1.0, 1.0, 1.0)),) * 200
    board = decode_track(WireLog(stamps, said, stamps, said), ACSAR)
    ros = decode_track(WireLog(stamps, said, stamps, said, stamped=True), ACSAR)
    assert board is not None
    assert ros is not None
    assert board.arrivals == pytest.approx(stamps + ACSAR.wire_time)
    assert ros.arrivals.tolist() == stamps.tolist()
    assert set(ros.stamps) <= set(stamps)
    assert (board.in_ros, ros.in_ros) == (False, True)


@pytest.mark.parametrize("step", [0.027, 0.0871, 0.3])
def test_a_step_is_found_under_the_rounding_to_two_decimals(step: float) -> None:
    exact = step * np.round(SPEEDS / step)
    found = find_quantum(np.round(exact, 2))
    assert found is not None
    assert found.value == pytest.approx(step, abs=2e-4)
    assert found.low <= step <= found.high
    for odd in (np.trunc(exact * 100.0) / 100.0, np.append(np.round(exact, 2), [7.31] * 10)):
        found = find_quantum(odd)  # a board that cuts digits, damaged lines
        assert found is not None
        assert found.value == pytest.approx(step, abs=1e-3)


@pytest.mark.parametrize(("step", "fastest"), [(1.0, 8.0), (0.5, 6.0), (2.0, 12.0)])
def test_few_speeds_show_a_step_that_is_no_chance(step: float, fastest: float) -> None:
    speeds = SPEEDS[np.abs(SPEEDS) < fastest]
    found = find_quantum(step * np.trunc(speeds / step))
    assert found is not None
    assert found.value == pytest.approx(step, abs=1e-3)
    assert found.low <= step <= found.high
    assert find_quantum(np.array([2.94, 3.04, 3.13, 5.98, 6.07])) is None


def test_encoder_counts_are_recognized_below_a_coarser_rounding() -> None:
    count = count_speed(ACSAR, 0.05)
    printed = np.round(0.05 * np.round(count * np.round(SPEEDS / count) / 0.05), 2)
    assert is_explained_by_counts(printed, ACSAR, 0.05, 0.05)
    assert not is_explained_by_counts(printed, ACSAR, 0.045, 0.05)
