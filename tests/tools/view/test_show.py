"""What `acsar-gym view` writes for Rerun, read back from its file."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun
from recording_tools import drive, record_env
from rerun.chunk import RrdReader
from scenes import HALL

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import ConfigError
from acsar_gym.recording import Episode, Recorder, read
from acsar_gym.recording.events import TABLES, Tables
from acsar_gym.tools.view.entities import EpisodeLogger
from acsar_gym.tools.view.show import RerunSink, save_recording, start_viewer
from acsar_gym.worlds.world import to_odometry

pytestmark = [pytest.mark.usefixtures("deadline"), pytest.mark.xdist_group(__name__)]
Column = list[Any]


@pytest.fixture(scope="module")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1.2 s of the planar robot, with a LiDAR."""
    return drive(tmp_path_factory.mktemp("view") / "tape.mcap", RobotConfig.of(None))


def read_rrd(path: Path) -> list[dict[str, dict[str, Column]]]:
    """Columns of each entity of each recording in a file."""
    reader = RrdReader(path)
    recordings = []
    for entry in reader.recordings():
        entities: dict[str, dict[str, Column]] = defaultdict(lambda: defaultdict(list))
        for chunk in reader.stream(store=entry):
            for name, column in chunk.to_record_batch().to_pydict().items():
                if not name.endswith("RowId"):
                    entities[chunk.entity_path][name.rpartition(":")[2]] += column
        recordings.append(entities)
    return recordings


def numbers(column: Column) -> list[Any]:
    return [value for row in column for value in row]


def seconds(column: Column) -> list[float]:
    return [time.total_seconds() for time in column]


def test_save_recording_writes_what_was_driven(tape: Path, tmp_path: Path) -> None:
    assert save_recording(tape, tmp_path / "tape.rrd") == 1
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
    wanted = entities["/run/command/angular/asked"]["scalars"]
    assert numbers(wanted) == pytest.approx(episode.asked[:, 1])

    assert len(entities["/run/scan"]["positions"]) == len(episode.scans.stamps)
    ends = [strip[0][-1] for strip in entities["/run/path"]["strips"]]
    assert ends[-1][:2] == pytest.approx(episode.poses[-1, :2], abs=0.011)
    assert "sent as asked" in numbers(entities["/run/safety"]["state"])
    texts = [row[0] for row in entities["/run/log"]["text"]]
    assert texts == ["begins", "the recording ends"]
    assert {"/run/robot/footprint", "/run/truth"} <= set(entities)
    assert "/run/lateness" not in {name for name in entities if entities[name]["scalars"]}


def test_save_recording_writes_each_episode_with_world_and_goal(tmp_path: Path) -> None:
    path = record_env(tmp_path / "env.mcap", "obstacle_goal", worlds="clutter:test")
    assert save_recording(path, tmp_path / "env.rrd") == 2
    names = []
    for entities in read_rrd(tmp_path / "env.rrd"):
        names += [row[0] for row in entities["/__properties"]["name"]]
        assert entities["/run/goal"]["strips"]
        assert len(entities["/run/world/obstacles"]["strips"][0]) > 4
        assert max(seconds(entities["/run/robot"]["time"])) > 1.0
    assert sorted(names) == ["episode 1, seed 0", "episode 2, seed 1"]


def test_save_recording_writes_movers_where_they_were(tmp_path: Path) -> None:
    """As rings with a line ahead, in the frame of the odometry."""
    path = record_env(tmp_path / "env.mcap", "obstacle_goal", 1, worlds=HALL)
    save_recording(path, tmp_path / "env.rrd")
    (entities,) = read_rrd(tmp_path / "env.rrd")
    (episode,) = read(path).episodes
    movers = episode.movers
    shown = entities["/run/movers"]
    assert np.diff(seconds(shown["time"])) == pytest.approx(0.05, abs=0.011)
    row = int(np.argmin(np.abs(movers.stamps - episode.start - seconds(shown["time"])[20])))
    strips = [np.array(strip)[:, :2] for strip in shown["strips"][20]]

    start = tuple(episode.info["start"])
    assert len(strips) == 6
    for ring, line, state in zip(strips[:3], strips[3:], movers.states[row], strict=True):
        x, y, vx, vy, radius = state.tolist()
        place = to_odometry(start, (x, y, 0.0))[:2]
        ahead = to_odometry(start, (x + vx, y + vy, 0.0))[:2]
        assert np.hypot(*(ring - place).T) == pytest.approx(radius, abs=1e-5)
        assert line.ravel() == pytest.approx([*place, *ahead], abs=1e-5)


def test_rerun_sink_shows_a_drive_as_its_recording(tmp_path: Path) -> None:
    """The viewer gets the same from the recorder as from the file afterwards."""
    config = RobotConfig.of(None)

    def save(stream: rerun.RecordingStream) -> None:
        stream.save(tmp_path / "live.rrd")

    recorder = Recorder(
        tmp_path / "tape.mcap", sinks=[lambda config, header: RerunSink(config, header, save)]
    )
    with Robot(open_link("planar", config), config, ["lidar"], recorder) as robot:
        for _ in range(200):
            robot.drive(0.3, 0.5)
    save_recording(tmp_path / "tape.mcap", tmp_path / "tape.rrd")
    ((live,), (afterwards,)) = (read_rrd(tmp_path / f"{name}.rrd") for name in ("live", "tape"))
    assert set(live) == set(afterwards)
    for entity in ("/run/robot", "/run/scan", "/run/wheels/front_left/sent", "/run/log"):
        assert live[entity] == afterwards[entity]


def test_rerun_sink_that_fails_costs_no_recording(tmp_path: Path) -> None:
    def fail(stream: rerun.RecordingStream) -> None:
        raise RuntimeError("closed")

    path = tmp_path / "tape.mcap"
    recorder = Recorder(path, sinks=[lambda config, header: RerunSink(config, header, fail)])
    with Robot(open_link("planar"), recorder=recorder) as robot:
        robot.drive(0.3, 0.5)
    assert recorder.problem is None
    assert not read(path).cut


def test_rerun_sink_logs_the_end_at_the_last_tick(tape: Path, tmp_path: Path) -> None:
    """Also if the last part has no tick."""
    (episode,) = read(tape).episodes
    path = tmp_path / "live.rrd"
    sink = RerunSink(RobotConfig.of(None), {}, lambda stream: stream.save(path))
    sink.show(0, episode)
    sink.show(0, Episode(episode.head, Tables()))
    sink.close(0)
    (entities,) = read_rrd(path)
    end = episode.stamps[-1] - episode.start
    assert seconds(entities["/run/log"]["time"])[-1] == pytest.approx(end, abs=1e-6)


def test_start_viewer_explains_why_it_does_not_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ConfigError, match=r"the viewer doesn't start: .*--save FILE.rrd"):
        start_viewer()


def test_episode_logger_logs_what_happens(tape: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (episode,) = read(tape).episodes
    tables = episode.tables
    tables["ticks"]["lateness"][10:13] = 0.05
    tables["ticks"]["reason"][20:] = 4
    tables["ticks"]["refused"][30:] = 2
    tables["ticks"]["exchange"][40:] += 3
    tables["exchanges"]["contact"][50] = 1.0
    tables["movers"] = np.zeros(3, TABLES["movers"])
    tables["movers"]["stamp"] = episode.start + np.array([0.2, 0.65, 0.7])
    tables["movers"]["hit"] = [0.0, 1.0, 1.0]
    tables["mover_states"] = np.tile([1.0, 0.0, 0.0, 0.0, 0.3], (3, 1, 1))
    fault = b"the cable is out"
    tables["faults"] = np.array([(episode.start + 0.9, len(fault))], TABLES["faults"])
    tables["faults_bytes"] = np.frombuffer(fault, np.uint8)

    lines: list[tuple[float, str, str]] = []
    logger = EpisodeLogger(rerun.RecordingStream("test"), RobotConfig.of(None), {})
    monkeypatch.setattr(logger, "log_lines", lines.extend)
    logger.log(episode)
    assert [text for _, text, _ in sorted(lines)] == [
        "begins",
        "late: 3 ticks, at worst by 50.0 ms",
        "emergency stop: held",
        "2 parts of the input were refused",
        "3 control periods aren't recorded",
        "touches an obstacle",
        "runs into a mover",
        "the cable is out",
    ]


def test_episode_logger_logs_each_contact(tape: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a line of its own, unless it is within a second of the contact before."""
    (episode,) = read(tape).episodes
    episode.tables["exchanges"]["contact"][[4, 8, 115]] = 1.0
    lines: list[tuple[float, str, str]] = []
    logger = EpisodeLogger(rerun.RecordingStream("test"), RobotConfig.of(None), {})
    monkeypatch.setattr(logger, "log_lines", lines.extend)
    logger.log(episode)
    times = [time for time, text, _ in lines if text == "touches an obstacle"]
    assert times == pytest.approx([0.05, 1.16], abs=0.011)
