"""Parts of recordings: cut out of one, or written to files in turn."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mover_tools import HALL
from recording_tools import drive, record_env

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording import Episode, Recorder, read, replay
from acsar_gym.recording.cut import cut_recording, parse_duration
from acsar_gym.recording.replay import Tape
from acsar_gym.tools.datasets import read_demonstrations
from acsar_gym.wire import STANDSTILL_LINES


@pytest.fixture(scope="module")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of an env with a LiDAR."""
    return record_env(tmp_path_factory.mktemp("tape") / "tape.mcap", "obstacle_goal", 3)


def file_times(episode: Episode) -> np.ndarray:
    return np.rint(episode.stamps * 1e9).astype(np.int64) + episode.offset


def assert_playable(episode: Episode) -> list[tuple[bytes, bytes]]:
    """All periods of an episode, without a gap."""
    player, periods = Tape(episode), []
    while not player.is_over:
        assert not player.has_gap
        periods.append(player.next())
    return periods


def test_a_part_has_what_was_recorded_then(tape: Path, tmp_path: Path) -> None:
    part = tmp_path / "part.mcap"
    whole = read(tape, revolutions=True)
    result = cut_recording(tape, 1.234, 6.5, part)
    found = read(part, revolutions=True)
    assert result.episodes == len(found.episodes) == 3
    assert result.seconds == pytest.approx(6.5 - 1.234)
    assert not found.cut
    assert found.dropped == 0
    assert found.config == whole.config
    assert whole.sha256 in found.sources
    begin = round(whole.episodes[0].start * 1e9) + whole.episodes[0].offset
    for one, every in zip(found.episodes, whole.episodes, strict=True):
        times = file_times(every) - begin
        inside = (times >= 1_234_000_000) & (times < 6_500_000_000)
        np.testing.assert_array_equal(one.stamps, every.stamps[inside])
        np.testing.assert_array_equal(one.poses, every.poses[inside])
        np.testing.assert_array_equal(one.truth, every.truth[inside])
        periods, all_periods = assert_playable(one), assert_playable(every)
        skipped = len(all_periods) - len(periods) if "part" in one.info else 0
        assert periods == all_periods[skipped : skipped + len(periods)]
        assert len(one.observations) == len(one.actions) + 1 == len(one.step_stamps)
        steps = every.step_stamps.tolist().index(one.step_stamps[0])
        np.testing.assert_array_equal(one.observations[0], every.observations[steps])
        np.testing.assert_array_equal(one.actions, every.actions[steps:][: len(one.actions)])
        np.testing.assert_array_equal(one.rewards, every.rewards[steps:][: len(one.rewards)])
        assert len(one.revolutions.measured) > 4
        assert one.info["seed"] == every.info["seed"]
    first = found.episodes[0]
    assert first.info["part"]["from"] == pytest.approx(first.start - whole.episodes[0].start)
    before = whole.episodes[0].stamps.tolist().index(first.stamps[0]) - 1
    assert first.info["part"]["pose"] == whole.episodes[0].poses[before].tolist()
    assert first.revolutions.exchanges[0] == -1


def test_a_part_has_the_movers_of_its_time(tmp_path: Path) -> None:
    path, part = tmp_path / "tape.mcap", tmp_path / "part.mcap"
    record_env(path, "obstacle_goal", 1, worlds=HALL)
    cut_recording(path, 1.0, 2.0, part)
    (whole,), (found,) = read(path).episodes, read(part).episodes
    place = whole.movers.stamps.tolist().index(found.movers.stamps[0])
    span = slice(place, place + len(found.movers.stamps))
    np.testing.assert_array_equal(found.movers.states, whole.movers.states[span])
    np.testing.assert_array_equal(found.movers.stamps, found.exchanges.stamps)
    np.testing.assert_array_equal(found.movers.exchanges, found.exchanges.numbers)


def test_whole_episodes_of_a_part_replay_bit_by_bit(tape: Path, tmp_path: Path) -> None:
    part, whole = tmp_path / "part.mcap", read(tape)
    second = whole.episodes[1]
    begin = (round(second.start * 1e9) + second.offset) - whole.episodes[0].offset
    cut_recording(tape, begin / 1e9, math.inf, part)
    (one, _), (_, every, _) = read(part).episodes, whole.episodes
    assert "part" not in one.info
    assert assert_playable(one) == assert_playable(every)
    assert one.terminated == every.terminated
    (first, _), others = read_demonstrations([part]).episodes, read_demonstrations([tape]).episodes
    np.testing.assert_array_equal(first.observations, others[1].observations)


def test_a_part_of_a_drive_becomes_demonstrations(tmp_path: Path) -> None:
    """An env plays it, though it begins while the wheels turn."""
    assert replay.LEAD_PERIODS == STANDSTILL_LINES
    path, part = drive(tmp_path / "drive.mcap", RobotConfig.of(None), 600), tmp_path / "part.mcap"
    cut_recording(path, 1.5, 5.5, part)
    (episode,) = read(part).episodes
    (shown,) = read_demonstrations([part]).episodes
    assert shown.terminated  # where the drive ended
    assert 30 < len(shown.actions) <= 40
    (x, y, theta), goal = episode.info["part"]["pose"], episode.poses[-1, :2]
    distance = math.hypot(goal[0] - x, goal[1] - y)
    shown_again = read_demonstrations([part], goal=(distance, 0.0))
    assert len(shown_again.episodes[0].actions) > 0
    assert abs(theta) > 0.01


def test_a_part_of_a_part(tape: Path, tmp_path: Path) -> None:
    cut_recording(tape, 1.0, 3.0, tmp_path / "part.mcap")
    cut_recording(tmp_path / "part.mcap", 0.5, 1.0, tmp_path / "again.mcap")
    (again,), every = read(tmp_path / "again.mcap").episodes, read(tape).episodes[0]
    assert again.info["part"]["from"] == pytest.approx(again.start - every.start)
    place = every.stamps.tolist().index(again.stamps[0])
    np.testing.assert_array_equal(again.poses, every.poses[place : place + len(again.poses)])


def test_what_cannot_be_cut_is_one_line(tape: Path, tmp_path: Path) -> None:
    for begin, end, said in (
        (3.0, 2.0, "must be 0 s or more, and in this order"),
        (1e6, 2e6, r"nothing is there from 1e\+06 s on"),
    ):
        with pytest.raises(ConfigError, match=said):
            cut_recording(tape, begin, end, tmp_path / "none.mcap")
    assert not (tmp_path / "none.mcap").exists()
    (tmp_path / "there.mcap").write_bytes(b"mine")
    with pytest.raises(ConfigError, match="is there already: name another file with --out"):
        cut_recording(tape, 0.0, 1.0, tmp_path / "there.mcap")
    assert (tmp_path / "there.mcap").read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90", 90.0), ("90s", 90.0), ("20min", 1200.0), ("1.5h", 5400.0), ("1:02:30", 3750.0)],
)
def test_times_are_parsed(text: str, seconds: float) -> None:
    assert parse_duration(text) == seconds


@pytest.mark.parametrize("text", ["", "h", "-1", "nan", "inf", "1 day", "1:x", "3hh", "1e999"])
def test_what_is_no_time_is_told(text: str) -> None:
    with pytest.raises(ConfigError, match="must be a time such as"):
        parse_duration(text)


def test_a_long_episode_goes_on_in_other_files(tmp_path: Path) -> None:
    config = RobotConfig.of(None)
    drive(tmp_path / "one.mcap", config, 450)
    drive(tmp_path / "many.mcap", config, 450, split=2.0)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["many-2.mcap", "many-3.mcap", "many.mcap", "one.mcap"]
    files = [tmp_path / name for name in ("many.mcap", "many-2.mcap", "many-3.mcap")]
    (whole,) = read(tmp_path / "one.mcap").episodes
    parts = []
    for number, path in enumerate(files):
        recording = read(path, revolutions=True)
        assert not recording.cut
        assert recording.dropped == 0
        (part,) = recording.episodes
        assert_playable(part)
        assert part.info.get("part", {}).get("from", 0.0) == pytest.approx(2.0 * number)
        assert len(part.revolutions.measured) > 3
        parts.append(part)
    np.testing.assert_array_equal(np.concatenate([p.poses for p in parts]), whole.poses)
    sent = b"".join(b"".join(part.wire.sent) for part in parts)
    assert sent == b"".join(whole.wire.sent)
    assert np.isfinite(np.concatenate([p.truth for p in parts])).all()


def test_a_long_episode_loses_no_mover(tmp_path: Path) -> None:
    many: Any = Recorder(tmp_path / "many.mcap", split=1.5)
    for record in (tmp_path / "one.mcap", many):
        record_env(record, "obstacle_goal", 1, worlds=HALL)
    names = ("one", "many", "many-2", "many-3")
    whole, *parts = (read(tmp_path / f"{name}.mcap").episodes[0].movers for name in names)
    states = np.concatenate([part.states for part in parts])
    np.testing.assert_array_equal(states, whole.states)
    assert [part.exchanges[0] for part in parts] == [0, 0, 0]


def test_a_long_episode_of_an_env_loses_no_step(tmp_path: Path) -> None:
    record_env(tmp_path / "one.mcap", "point_goal", 1)
    record_env(Recorder(tmp_path / "many.mcap", split=1.5), "point_goal", 1)  # type: ignore[arg-type]
    (whole,) = read(tmp_path / "one.mcap").episodes
    names = ("many.mcap", "many-2.mcap", "many-3.mcap")
    parts = [read(tmp_path / name).episodes[0] for name in names]
    for part in parts:
        assert len(part.observations) == len(part.actions) + 1
        assert_playable(part)
    np.testing.assert_array_equal(np.concatenate([p.actions for p in parts]), whole.actions)
    np.testing.assert_array_equal(np.concatenate([p.rewards for p in parts]), whole.rewards)
    observations = [parts[0].observations, *(p.observations[1:] for p in parts[1:])]
    np.testing.assert_array_equal(np.concatenate(observations), whole.observations)
    np.testing.assert_array_equal(parts[1].observations[0], parts[0].observations[-1])
