"""What `acsar-gym view` writes for Rerun, read back from its file."""

from __future__ import annotations

import math
import urllib.error
import urllib.request
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun
from mover_tools import HALL
from recording_tools import begun, drive, record_env
from rerun.chunk import RrdReader

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import ConfigError
from acsar_gym.recording import Recorder, read
from acsar_gym.recording.types import Movers
from acsar_gym.tools.view.entities import EpisodeLogger
from acsar_gym.tools.view.show import find_recording, measure_gap, save_recording
from acsar_gym.tools.view.tail import Block, RecordingTail
from acsar_gym.tools.view.viewer import open_viewer
from acsar_gym.worlds.world import to_odometry

pytestmark = [pytest.mark.usefixtures("deadline"), pytest.mark.xdist_group(__name__)]
Column = list[Any]


@pytest.fixture(scope="module")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1.2 s of the planar robot, with a LiDAR."""
    return drive(tmp_path_factory.mktemp("view") / "tape.mcap", RobotConfig.of(None))


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tape's drive, but shorter, by a robot with larger wheels."""
    config = RobotConfig.of(None).model_copy(update={"wheel_radius": 0.06})
    return drive(tmp_path_factory.mktemp("other") / "other.mcap", config, ticks=90)


def read_rrd(path: Path) -> list[dict[str, dict[str, Column]]]:
    """Columns of each entity of each recording in a file."""
    reader, recordings = RrdReader(path), []
    for entry in reader.recordings():
        entities: dict[str, dict[str, Column]] = defaultdict(lambda: defaultdict(list))
        for chunk in reader.stream(store=entry):
            for name, column in chunk.to_record_batch().to_pydict().items():
                entities[chunk.entity_path][name.rpartition(":")[2]] += column
        recordings.append(entities)
    return recordings


def numbers(column: Column) -> list[Any]:
    return [value for row in column for value in row]


def seconds(column: Column) -> list[float]:
    return [time.total_seconds() for time in column]


def test_what_was_driven_is_in_the_file(tape: Path, tmp_path: Path) -> None:
    assert save_recording(tape, None, tmp_path / "tape.rrd") == 1
    (entities,) = read_rrd(tmp_path / "tape.rrd")
    (episode,) = read(tape).episodes
    robot = entities["/run/robot"]
    assert seconds(robot["time"]) == pytest.approx(episode.stamps - episode.start, abs=1e-6)
    places = np.array([row[0] for row in robot["translation"]])
    assert places[:, :2] == pytest.approx(episode.poses[:, :2], abs=1e-6)
    for number, wheel in enumerate(("front_right", "front_left", "rear_left", "rear_right")):
        measured = entities[f"/run/wheels/{wheel}/measured"]["scalars"]
        assert numbers(measured) == pytest.approx(episode.speeds[:, number])
    sent = entities["/run/wheels/front_left/sent"]["scalars"]
    commands = episode.wire.commands(RobotConfig.of(None))[1]
    assert numbers(sent) == pytest.approx(commands[:, 1])
    asked = entities["/run/command/angular/asked"]["scalars"]
    assert numbers(asked) == pytest.approx(episode.asked[:, 1])
    assert len(entities["/run/scan"]["positions"]) == len(episode.scans.stamps)
    ends = [strip[0][-1] for strip in entities["/run/path"]["strips"]]
    assert ends[-1][:2] == pytest.approx(episode.poses[-1, :2], abs=0.011)
    assert "sent as asked" in numbers(entities["/run/safety"]["state"])
    texts = [row[0] for row in entities["/run/log"]["text"]]
    assert texts == ["begins", "the recording ends"]
    assert {"/run/robot/footprint", "/run/truth"} <= set(entities)
    assert "/run/lateness" not in {name for name in entities if entities[name]["scalars"]}


def test_episodes_are_recordings_of_their_own_with_world_and_goal(tmp_path: Path) -> None:
    path = record_env(tmp_path / "env.mcap", "obstacle_goal", worlds="clutter:test")
    assert save_recording(path, None, tmp_path / "env.rrd") == 2
    names = []
    for entities in read_rrd(tmp_path / "env.rrd"):
        names += [row[0] for row in entities["/__properties"]["name"]]
        assert entities["/run/goal"]["strips"]
        assert len(entities["/run/world/obstacles"]["strips"][0]) > 4
        assert max(seconds(entities["/run/robot"]["time"])) > 1.0
    assert sorted(names) == ["episode 1, seed 0", "episode 2, seed 1"]


def test_movers_are_where_they_were_recorded(tmp_path: Path) -> None:
    """As rings with a line ahead, in the frame of the odometry."""
    path = record_env(tmp_path / "env.mcap", "obstacle_goal", 1, worlds=HALL)
    save_recording(path, None, tmp_path / "env.rrd")
    (entities,), (episode,) = read_rrd(tmp_path / "env.rrd"), read(path).episodes
    movers, shown = episode.movers, entities["/run/movers"]
    assert np.diff(seconds(shown["time"])) == pytest.approx(0.05, abs=0.011)
    row = int(np.argmin(np.abs(movers.stamps - episode.start - seconds(shown["time"])[20])))
    strips = [np.array(strip)[:, :2] for strip in shown["strips"][20]]
    start = tuple(episode.info["start"])
    assert len(strips) == 6
    for ring, line, state in zip(strips[:3], strips[3:], movers.states[row], strict=True):
        x, y, vx, vy, radius = state.tolist()
        at, ahead = to_odometry(start, (x, y, 0.0)), to_odometry(start, (x + vx, y + vy, 0.0))
        assert np.hypot(*(ring - at[:2]).T) == pytest.approx(radius, abs=1e-5)
        assert line.ravel() == pytest.approx([*at[:2], *ahead[:2]], abs=1e-5)


def test_two_runs_lie_over_each_other_with_their_gap(
    tape: Path, other: Path, tmp_path: Path
) -> None:
    save_recording(tape, other, tmp_path / "two.rrd")
    (entities,) = read_rrd(tmp_path / "two.rrd")
    ends = [read(path).episodes[0].poses[-1, :2] for path in (tape, other)]
    gaps = numbers(entities["/gap/odometry"]["scalars"])
    assert gaps[-1] == pytest.approx(100.0 * math.dist(*ends))
    assert len(numbers(entities["/gap/truth"]["scalars"])) > 100
    assert len(entities["/other/robot"]["time"]) == 90
    assert "/other/goal" not in entities


def test_the_gap_is_that_of_the_same_time_since_the_first_tick(tape: Path) -> None:
    (block,) = RecordingTail(tape).read()
    (later,) = RecordingTail(tape).read()
    later.ticks["stamp"][:] += 0.5  # it has waited for standstill
    later.ticks["x"][:] += 0.3
    later.ticks["y"][:] -= 0.4
    gaps = {name: distances for name, _, distances in measure_gap(block, [later], -0.5)}
    assert gaps["odometry"] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("mine", "theirs", "message"),
    [
        ({"seed": 3, "goal": [1.0, 2.0]}, {"seed": 3, "goal": [1.0, 2.0]}, ""),
        ({"seed": 3, "goal": [1.0, 2.0]}, {"seed": 3}, ""),
        ({}, {}, ""),
        ({"seed": 3}, {"seed": 4}, "other.mcap: has no partner of episode 1 (seed 3): record"),
        ({}, {"seed": 4}, "other.mcap: has no partner of episode 1: record both"),
        (
            {"seed": 3, "goal": [1.0, 2.0]},
            {"seed": 3, "goal": [1.0, 2.1]},
            "other.mcap: has no partner of episode 1 (seed 3): ",
        ),
    ],
)
def test_what_cannot_be_paired_is_a_line(
    mine: dict[str, Any],
    theirs: dict[str, Any],
    message: str,
    tmp_path: Path,
) -> None:
    for name, info in (("mine.mcap", mine), ("other.mcap", theirs)):
        recorder, config = Recorder(tmp_path / name, {}), RobotConfig.of(None)
        recorder.describe(info)
        with Robot(open_link("planar", config), config, [], recorder) as robot:
            for _ in range(3):
                robot.drive(0.1, 0.0)
    paths = tmp_path / "mine.mcap", tmp_path / "other.mcap"
    if not message:
        assert save_recording(*paths, tmp_path / "two.rrd") >= 1
        return
    with pytest.raises(ConfigError) as error:
        save_recording(*paths, tmp_path / "two.rrd")
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_a_recording_that_grows_is_read_once_and_another_one_begins_anew(
    tape: Path, other: Path, tmp_path: Path
) -> None:
    path, data = tmp_path / "live.mcap", tape.read_bytes()
    path.write_bytes(begun(tape))
    tail = RecordingTail(path)
    stamps = [block.ticks["stamp"] for block in tail.read()]
    assert tail.describe_end() == "the recording's end is missing"
    with path.open("r+b") as file:
        file.write(data)
    stamps += [block.ticks["stamp"] for block in tail.read()]
    episode = read(tape).episodes[0]
    assert np.concatenate(stamps) == pytest.approx(episode.stamps - episode.start)
    assert [list(tail.read()), tail.describe_end()] == [[], "the recording ends"]
    path.unlink()
    path.write_bytes(other.read_bytes())
    assert sum(len(block.poses) for block in tail.read()) == 90
    assert tail.run == 1


def test_what_happens_is_in_the_log(tape: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (block,) = RecordingTail(tape).read()
    block.ticks["lateness"][10:13] = 0.05
    block.ticks["reason"][20:] = 4.0
    block.ticks["refused"][30:] = 2.0
    block.ticks["exchange"][40:] += 3.0
    block.truth[50, 4] = 1.0
    block = replace(block, movers=make_movers([0.0, 1.0, 1.0], [0.2, 0.65, 0.7]))
    block.faults.append((0.9, "the cable is out"))
    texts = log_texts(block, monkeypatch)
    assert texts == [
        "begins",
        "late: 3 ticks, at worst by 50.0 ms",
        "emergency stop: held",
        "2 parts of the input were refused",
        "3 control periods aren't recorded",
        "touches an obstacle",
        "runs into a mover",
        "the cable is out",
    ]


def make_movers(hits: list[float], stamps: list[float]) -> Movers:
    """One that stands."""
    state, count = [1.0, 0.0, 0.0, 0.0, 0.3], len(hits)
    numbers, states = np.arange(count), np.tile(state, (count, 1, 1))
    return Movers(numbers, np.array(stamps), np.array(hits), np.zeros(count), states)


def log_texts(block: Block, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The log of an episode, in the order of time."""
    lines: list[tuple[float, str, str]] = []
    logger = EpisodeLogger(rerun.RecordingStream("test"), "run", RobotConfig.of(None), {})
    monkeypatch.setattr(logger, "_send_text", lines.extend)
    logger.log(block)
    return [text for _, text, _ in sorted(lines)]


@pytest.mark.parametrize("damage", ["", "no recording", "cut"])
def test_what_cannot_be_shown_is_a_line(damage: str, tape: Path, tmp_path: Path) -> None:
    path = tmp_path / "bad.mcap"
    path.write_bytes({"": b"", "no recording": b"x" * 99, "cut": tape.read_bytes()[:300]}[damage])
    with pytest.raises(ConfigError) as error:
        save_recording(path, None, tmp_path / "bad.rrd")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "bad.rrd").exists()


@pytest.mark.parametrize("source", ["planar", "serial", "/dev/ttyX"])
def test_a_link_is_no_recording(source: str) -> None:
    with pytest.raises(ConfigError, match=f"{source}: isn't a recording: drive with --record FILE"):
        find_recording(source)


def test_the_page_is_on_loopback_may_ask_nobody_and_ends_with_the_command(tape: Path) -> None:
    with open_viewer(0) as viewer:
        with urllib.request.urlopen(viewer.url) as answer:  # noqa: S310 - http
            policy, page = answer.headers["Content-Security-Policy"], answer.read().decode()
            assert "url=rerun%2Bhttp://127.0.0.1:" in answer.url
        assert "connect-src 'self' http://127.0.0.1:" in policy
        assert "https://" not in page.split("<body>")[0].split("<script")[0]
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"{viewer.url}/nothing")  # noqa: S310 - http
        port = int(viewer.url.rpartition(":")[2])
        with pytest.raises(ConfigError, match=f"--port {port}: can't be used"):
            open_viewer(port).__enter__()
    assert viewer.process.poll() is not None
    for number in (-1, 70_000):
        with pytest.raises(ConfigError, match="--port"):
            open_viewer(number).__enter__()
