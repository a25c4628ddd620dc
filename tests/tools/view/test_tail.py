"""Recordings, read while they grow."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from recording_tools import begun

from acsar_gym import kinematics
from acsar_gym.recording import read
from acsar_gym.tools.view.session import BROKEN, ENDED, LIVE, RECORDED, STOPPED, Session, StopAnswer
from acsar_gym.tools.view.tail import WRITING_TIMEOUT, RecordingTail


def test_what_was_recorded_is_shown(tape: Path) -> None:
    tail, (whole,) = RecordingTail(tape), read(tape).episodes
    (episode,) = tail.episodes
    assert tail.is_complete
    assert not tail.is_open
    assert (episode.column("stamp") == whole.stamps - whole.start).all()
    assert (episode.column("x") == whole.poses[:, 0]).all()
    stamps, speeds = whole.wire.commands(tail.config)
    assert np.allclose(episode.sent.rows, np.column_stack([stamps - whole.start, speeds]))
    assert (episode.scans.rows[:, 0] == whole.scans.stamps - whole.start).all()
    assert episode.ranges is not None
    assert np.allclose(episode.ranges.rows, whole.scans.ranges)
    assert episode.is_simulated
    assert episode.end == pytest.approx(whole.stamps[-1] - whole.start)


def test_wheel_speeds_asked_for_are_those_sent_where_nothing_limits(tape: Path) -> None:
    tail = RecordingTail(tape)
    (episode,) = tail.episodes
    calm = np.flatnonzero(episode.column("reason") == 0)[-1]
    asked = episode.asked(slice(calm, calm + 1))[0]
    before = episode.sent.rows[:, 0] < episode.column("stamp")[calm] - 1e-6
    sent = episode.sent.rows[before][-1, 1:]
    assert np.allclose(asked, sent, atol=0.02)
    twist = kinematics.forward(asked, tail.config.wheel_radius, tail.config.effective_separation)
    assert np.allclose(twist, (0.3, episode.column("asked_angular")[calm]))


@pytest.mark.parametrize("pieces", [3, 40])
def test_a_file_that_grows_ends_as_if_it_was_read_at_once(
    tape: Path, tmp_path: Path, pieces: int
) -> None:
    data, grown = tape.read_bytes(), tmp_path / "grown.mcap"
    begin = 60_000
    grown.write_bytes(data[:begin])
    tail = RecordingTail(grown)
    sizes = [len(tail.episodes[0].ticks) if tail.episodes else 0]
    for place in np.linspace(begin, len(data), pieces).astype(int):
        grown.write_bytes(data[:place])
        tail.poll()
        sizes.append(len(tail.episodes[0].ticks) if tail.episodes else 0)
    assert not tail.poll()
    assert sizes == sorted(sizes)
    whole = RecordingTail(tape).episodes[0]
    assert np.array_equal(tail.episodes[0].ticks.rows, whole.ticks.rows, equal_nan=True)
    assert np.array_equal(tail.episodes[0].sent.rows, whole.sent.rows)
    assert tail.is_complete


def test_a_run_is_live_until_its_recording_ends(tape: Path, tmp_path: Path) -> None:
    data, path = tape.read_bytes(), tmp_path / "live.mcap"
    path.write_bytes(begun(tape))
    session = Session(path)
    assert session.state == LIVE  # the header names this process, which runs
    assert not session.can_stop  # but it drives no real robot
    path.write_bytes(data)
    assert session.poll() == 2
    assert session.state == ENDED


def test_a_robot_that_is_started_again_is_not_called_stopped(tape: Path, tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    path.write_bytes(begun(tape))
    session = Session(path)
    session.stop()
    session.stopped = StopAnswer("stopped", "zero is on the wire")
    session.poll()
    assert session.state == STOPPED
    session.tail.episodes *= 2
    session.poll()
    assert session.state == LIVE


def test_a_file_that_was_left_behind_is_not_live(tape: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(begun(tape))
    long_ago = path.stat().st_mtime - 2.0 * WRITING_TIMEOUT
    os.utime(path, (long_ago, long_ago))
    assert Session(path).state == RECORDED


def test_damage_of_a_live_run_is_shown_on_the_page(tape: Path, tmp_path: Path) -> None:
    data, path = tape.read_bytes(), tmp_path / "live.mcap"
    path.write_bytes(data[:60_000])
    session = Session(path)
    path.write_bytes(data[:60_000] + b"\xff" * 200_000)  # more than a chunk
    for _ in range(2):
        assert session.poll() == 1
        assert "is damaged" in session.problem
        assert session.state == BROKEN
    assert session.is_live  # the robot drives on: it can be stopped


def test_a_recording_that_begins_again_is_shown_once_its_header_is_there(
    tape: Path, tmp_path: Path
) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(tape.read_bytes())
    session = Session(path)
    assert session.state == RECORDED
    path.rename(tmp_path / "drive.1.mcap")
    for size in (0, 8, 300):
        path.write_bytes(tape.read_bytes()[:size])
        session.poll()
        assert session.state == BROKEN
    path.write_bytes(begun(tape))
    session.poll()
    assert session.state == LIVE
    assert len(session.tail.episodes) == 1


@pytest.mark.parametrize("told", [None, 1, "abc", [1, 2], [1e300, 0, 0], [0, 0, float("inf")]])
def test_a_start_that_is_none_is_zero(tape: Path, told: object) -> None:
    (episode,) = RecordingTail(tape).episodes
    episode.info = {"start": told, "goal": told}
    assert episode.start == (0.0, 0.0, 0.0)
    assert episode.goal == ((1.0, 2.0) if told == [1, 2] else None)
