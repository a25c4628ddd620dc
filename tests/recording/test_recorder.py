"""The recorder: what it drops, what survives a crash, how it ends, and what the driver tells it."""

from __future__ import annotations

import copy
import math
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, NoReturn

import gymnasium
import numpy as np
import pytest
from recording_tools import drive

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import ConfigError, LinkError, LinkLostError, RecordingWarning
from acsar_gym.links.faults import Faults, FaultyLink
from acsar_gym.recording import Recorder, messages, read, reader
from acsar_gym.recording.recorder import BLOCK_PERIOD
from acsar_gym.recording.writer import RecordingWriter
from acsar_gym.sensors.map.sensor import MAP_NAMES
from acsar_gym.worlds import Scene

CONFIG = RobotConfig.of(None)
ENV = "acsar_gym/PointGoal-v0"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "tape.mcap"


def fail(*arguments: object) -> NoReturn:
    raise OSError(28, "No space left on device")


def test_recorder_drops_and_counts_what_a_full_queue_cannot_take(
    monkeypatch: pytest.MonkeyPatch, path: Path
) -> None:
    goes = threading.Event()
    write = RecordingWriter.write

    def write_later(*arguments: Any) -> None:
        goes.wait(60.0)
        write(*arguments)

    monkeypatch.setattr(RecordingWriter, "write", write_later)
    recorder = Recorder(path, capacity=100)
    recorder.open(CONFIG)
    recorder.begin(0.0, simulated=False)
    for stamp in range(1000):
        recorder.add({"clocks": (float(stamp), 0)})
    assert recorder.dropped >= 1000 - 2 * 100
    goes.set()
    recorder.close()
    assert read(path).dropped == recorder.dropped
    assert reader.summarize(path)["tables"]["clocks"] == 1001 - recorder.dropped


def test_recorder_waits_between_its_blocks(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    times: list[float] = []
    monkeypatch.setattr(RecordingWriter, "flush", lambda _: times.append(time.monotonic()))
    recorder = Recorder(path)
    recorder.open(CONFIG)
    recorder.begin(0.0, simulated=False)
    time.sleep(0.2)
    recorder.close()
    assert len(times) <= 2 + (times[-1] - times[0]) / BLOCK_PERIOD


def test_recorder_prepares_its_messages_before_wheels_turn(
    monkeypatch: pytest.MonkeyPatch, path: Path
) -> None:
    """Defining types takes 0.1 s of Python's lock, by which ticks would be late."""
    recorder = Recorder(path)
    env = gymnasium.make("acsar_gym/Crowd-v0", record=recorder)
    recorder.open(CONFIG)
    store = messages.load_typestore()
    prepared = set(store.cache)
    monkeypatch.setattr(store, "generate_msgdef", fail)
    env.reset(seed=1)
    env.step(np.zeros(2, np.float32))
    env.close()
    assert recorder.problem is None
    assert read(path).episodes[0].tables.count("movers") > 0
    assert set(store.cache) == prepared


def test_recorder_counts_a_gap_at_which_a_replay_ends(
    monkeypatch: pytest.MonkeyPatch, path: Path
) -> None:
    add = Recorder.add

    def forget(recorder: Recorder, rows: Any) -> None:
        if "exchanges" not in rows or rows["exchanges"][0] != 33:
            add(recorder, rows)

    monkeypatch.setattr(Recorder, "add", forget)
    # A simulation waits for the writer, and drops nothing else.
    drive(path, CONFIG, capacity=20)
    recording = read(path)
    assert (recording.dropped, recording.missing) == (1, 0)  # it is nowhere damaged
    replay = Robot(open_link(f"replay:{path}"), CONFIG)
    with pytest.raises(LinkLostError, match="gap, tick 30"), replay:
        for tick in range(100):
            replay.drive(0.3, math.sin(tick / 20.0))


CRASH = """
import os, sys, time
from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.recording import Recorder
config = RobotConfig.of(None)
robot = Robot(open_link("planar", config, realtime=True), config, recorder=Recorder(sys.argv[1]))
with robot:
    while True:
        robot.drive(0.1, 0.0)
        print(robot.link.now(), flush=True)
"""


def test_recorder_loses_at_most_the_last_second_of_a_killed_program(path: Path) -> None:
    newest = 0.0
    command = [sys.executable, "-c", CRASH, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        while newest < 2.5:
            newest = float(process.stdout.readline())
        process.kill()
        newest = max([newest, *map(float, process.stdout.read().split("\n")[:-1])])

    recording = read(path)
    assert recording.cut
    (episode,) = recording.episodes
    assert newest - 1.0 <= episode.stamps[-1] <= newest + 0.1
    assert len(episode.wire.sent) >= len(episode.stamps)


def test_recorder_finishes_at_the_end_of_a_program(path: Path) -> None:
    code = CRASH.replace("while True:", "for _ in range(20):")
    code = code.replace("with robot:", "robot.activate()\nif True:")
    command = [sys.executable, "-c", code, str(path)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert not read(path).cut


def test_recorder_warns_of_a_full_disk_once_at_the_next_reset(
    monkeypatch: pytest.MonkeyPatch, path: Path
) -> None:
    over = threading.Event()
    abandon = RecordingWriter.abandon

    def end(file: RecordingWriter) -> None:
        abandon(file)
        over.set()

    recorder = Recorder(path)
    with Robot(open_link("planar", CONFIG), CONFIG, recorder=recorder) as robot:
        monkeypatch.setattr(RecordingWriter, "flush", fail)
        monkeypatch.setattr(RecordingWriter, "abandon", end)
        robot.drive(0.1, 0.0)
        assert over.wait(60.0)
        with pytest.warns(RecordingWarning, match="No space"):
            robot.reset(Scene())
        robot.reset(Scene())
        robot.drive(0.1, 0.0)
    assert recorder.problem is not None


def test_recorder_replaces_nothing_if_the_link_does_not_open(path: Path) -> None:
    drive(path, CONFIG, 5)
    content = path.read_bytes()
    with pytest.raises(LinkError, match="no such device"):
        Robot(open_link("/dev/acsar-missing"), CONFIG, recorder=Recorder(path)).activate()
    assert path.read_bytes() == content


def test_recorder_that_cannot_begin_closes_the_link() -> None:
    robot = Robot(open_link("planar", CONFIG), CONFIG, recorder=Recorder("/dev/full"))
    with pytest.raises(ConfigError, match=r"/dev/full: .*No space left on device"):
        robot.activate()
    with pytest.raises(LinkError):
        robot.link.write(b"")


def test_recorder_does_not_wait_for_the_reader_of_a_pipe(path: Path) -> None:
    os.mkfifo(path)
    with pytest.raises(ConfigError, match=r"tape.mcap: can't be written"):
        drive(path, CONFIG, 5)


def test_recorder_can_begin_after_a_sink_that_cannot(path: Path) -> None:
    recorder = Recorder(path, sinks=[fail])
    for _ in range(2):
        with pytest.raises(OSError, match="No space"):
            recorder.open(CONFIG)
    assert not path.exists()


def test_recorder_takes_the_text_of_any_error(path: Path) -> None:
    with Robot(open_link("planar", CONFIG), CONFIG, recorder=Recorder(path)) as robot:
        robot.deactivate(LinkError(os.fsdecode(b"\xff.mcap: is lost")))
    faults = read(path).episodes[0].tables["faults_bytes"]
    assert faults.tobytes() == b"\\udcff.mcap: is lost"


def test_recorder_keeps_numbers_of_numpy(path: Path) -> None:
    env = gymnasium.make(ENV, link="planar", record=path)
    env.reset(seed=np.int64(7))  # type: ignore[arg-type]
    env.close()
    assert read(path).episodes[0].info["seed"] == 7


def test_recorder_refuses_the_file_that_is_replayed(path: Path) -> None:
    drive(path, CONFIG, 5)
    same = path.with_name("same.mcap")
    same.symlink_to(path)
    content = path.read_bytes()
    link = FaultyLink(open_link(f"replay:{path}"), Faults())
    with pytest.raises(ConfigError, match=r"same.mcap: is being replayed"):
        Robot(link, CONFIG, recorder=Recorder(same)).activate()
    assert path.read_bytes() == content


def test_recorder_keeps_older_files(path: Path) -> None:
    """An older recording under a number. A file of another kind isn't replaced at all."""
    path.touch()  # an empty file is replaced
    for ticks in (5, 7, 9):
        drive(path, CONFIG, ticks)
    kept = {file.name: len(read(file).episodes[0].stamps) for file in path.parent.iterdir()}
    assert kept == {"tape.1.mcap": 5, "tape.2.mcap": 7, "tape.mcap": 9}
    path.write_text("base: acsar\n")
    with pytest.raises(ConfigError, match=r"tape.mcap: isn't a recording"):
        drive(path, CONFIG, 5)
    assert path.read_text() == "base: acsar\n"


def test_recorder_shares_no_file_and_ends_once(path: Path) -> None:
    envs = gymnasium.make_vec(ENV, 2, vectorization_mode="sync", link="planar", record=path)
    with pytest.raises(ConfigError, match=r"tape.mcap: .*another recorder"):
        envs.reset(seed=0)
    envs.close()
    assert len(read(path).episodes) == 1
    with pytest.raises(ConfigError, match="has ended"):
        envs.envs[0].reset()  # type: ignore[attr-defined]


def test_recorder_of_a_copy_writes_another_file(path: Path) -> None:
    env = gymnasium.make(ENV, link="planar", record=path)
    env.reset(seed=0)
    other = copy.deepcopy(env)
    other.reset(seed=1)
    other.close()
    env.close()
    seeds = [
        read(path.with_name(name)).episodes[0].info["seed"] for name in ("tape.mcap", "tape.1.mcap")
    ]
    assert seeds == [0, 1]
    assert read(path).episodes[0].success is None  # without a step


def test_recorder_of_an_env_keeps_what_the_policy_saw_and_did(path: Path) -> None:
    env_id = "acsar_gym/ObstacleGoal-v1"
    env = gymnasium.make(env_id, link="planar", record=str(path), worlds="clutter:5")
    observations = [env.reset(seed=7)[0]]
    actions = []
    goal = env.unwrapped.episode.assignment.goal  # type: ignore[attr-defined]
    for _ in range(5):
        actions.append(env.action_space.sample())
        observations.append(env.step(actions[-1])[0])
    env.close()

    recording = read(path)
    (episode,) = recording.episodes
    np.testing.assert_array_equal(episode.observations, observations)
    np.testing.assert_array_equal(episode.actions, actions)
    assert len(episode.rewards) == 5
    assert episode.scans.ranges.shape == (6, 64)
    assert (episode.info["seed"], episode.info["goal"]) == (7, list(goal))
    about = recording.header["about"]
    assert (about["env"]["id"], about["env"]["kwargs"]["worlds"]) == (env_id, "clutter:5")
    assert len(about["observation"]) + len(MAP_NAMES) + 64 == len(observations[0])
