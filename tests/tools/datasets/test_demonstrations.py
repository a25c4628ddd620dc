"""Recordings as steps of an env: those that one recorded, and those of drives without one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from boards import FailingLink
from recording_tools import drive, record_drive, record_env

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.envs.ids import full_id
from acsar_gym.errors import ConfigError, RecordingWarning
from acsar_gym.recording import Recorder, read
from acsar_gym.tasks import PointGoal, State
from acsar_gym.tools.datasets import read_demonstrations

CONFIG = RobotConfig.of(None)
TOP = CONFIG.max_linear, CONFIG.max_angular


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        ("point_goal", {"policy_rate": 20.0}),
        ("barn", {"robot": "jackal"}),
    ],
)
def test_steps_of_an_env_are_taken_as_they_are(
    env_id: str, options: dict[str, Any], tmp_path: Path
) -> None:
    data = read_demonstrations([record_env(tmp_path / "tape.mcap", env_id, **options)])
    recorded = read(tmp_path / "tape.mcap").episodes
    assert (data.env_id, data.rate) == (full_id(env_id), options.get("policy_rate", 10.0))
    assert len(data.names) == data.episodes[0].observations.shape[1]
    assert [one.seed for one in data.episodes] == [0, 1]
    for found, one in zip(data.episodes, recorded, strict=True):
        np.testing.assert_array_equal(found.observations, one.observations)
        np.testing.assert_array_equal(found.actions, one.actions)
        np.testing.assert_array_equal(found.rewards, one.rewards)


def test_a_replay_gives_an_agents_observations_to_the_last_bit(tmp_path: Path) -> None:
    """Made of ticks and bytes alone, these are the steps that the env itself recorded."""
    tape = record_env(tmp_path / "tape.mcap", "obstacle_goal")
    steps, replayed = read_demonstrations([tape]), read_demonstrations([tape], "obstacle_goal")
    assert (replayed.env_id, replayed.rate) == (steps.env_id, steps.rate)
    assert replayed.names == steps.names
    for found, one in zip(replayed.episodes, steps.episodes, strict=True):
        np.testing.assert_array_equal(found.observations, one.observations)
        np.testing.assert_array_equal(found.actions, one.actions)
        np.testing.assert_array_equal(found.rewards, one.rewards)
        assert found.terminated == one.terminated


def test_a_drive_is_what_an_agent_would_have_done(tmp_path: Path) -> None:
    """Commands change in the middle of steps; the goal is where the drive ended."""
    way = [(0.3, 0.0, 105), (0.5, 2.0, 47), (9.0, -0.5, 30), (0.2, 0.0, 47)]
    tape = record_drive(tmp_path / "drive.mcap", way)
    data = read_demonstrations([tape])
    (found,), (recorded,) = data.episodes, read(tape).episodes
    count = len(found.actions)
    assert (data.env_id, data.rate, data.policy) == (full_id("point_goal"), 10.0, "unknown")
    assert found.terminated
    assert 18 <= count <= 22
    asked = recorded.asked[: 10 * count].reshape(count, 10, 2).mean(axis=1) / TOP
    np.testing.assert_allclose(found.actions, np.clip(asked, -1.0, 1.0), atol=1e-6)
    assert found.actions[10, 1] == pytest.approx(0.5 * 2.0 / TOP[1])  # half of the step
    assert found.actions[15:18, 0].max() == 1.0
    goal = recorded.poses[-1, 0], recorded.poses[-1, 1]
    for step in range(1, count + 1):
        pose, twist = recorded.poses[10 * step - 1], recorded.twists[10 * step - 1]
        action = (float(found.actions[step - 1, 0]), float(found.actions[step - 1, 1]))
        state = State(tuple(pose), tuple(twist), action=action, goal=goal, max_twist=TOP)
        seen = PointGoal().observe(state, None)
        np.testing.assert_array_equal(found.observations[step], np.array(seen, np.float32))


def test_a_goal_may_be_given_and_be_far_away(tmp_path: Path) -> None:
    """A drive of 5 m is seen as by an agent whose observations are scaled as ever."""
    tape = record_drive(tmp_path / "drive.mcap", [(1.0, 0.0, 1000)])
    (far,) = read_demonstrations([tape]).episodes
    assert far.terminated
    assert far.observations[0, 0] == pytest.approx(float(read(tape).episodes[0].poses[-1, 0]) / 3.0)
    (near,) = read_demonstrations([tape], goal=(2.0, 0.0)).episodes
    assert near.terminated
    assert near.observations[0, 0] == pytest.approx(2.0 / 3.0)
    assert len(near.actions) < len(far.actions) / 2
    (missed,) = read_demonstrations([tape], goal=(0.0, 1.0)).episodes
    assert (len(missed.actions), missed.terminated) == (100, False)


def test_what_is_no_way_to_a_goal_is_left_out(tmp_path: Path) -> None:
    ahead = [(0.5, 0.0, 200)]
    tape = record_drive(tmp_path / "drive.mcap", [(0.3, 0.0, 5)], ahead, [(0.0, 1.0, 200)], ahead)
    with pytest.warns(RecordingWarning) as warned:
        data = read_demonstrations([tape])
    said = sorted(str(warning.message).partition("mcap: ")[2] for warning in warned)
    assert said[0] == "episode 0 is left out: it is shorter than a step"
    assert said[1].startswith("episode 2 is left out: its goal is 0.0")
    assert len(data.episodes) == 2
    np.testing.assert_array_equal(data.episodes[0].observations, data.episodes[1].observations)


def test_several_recordings_are_one_data_set(tmp_path: Path) -> None:
    one = record_drive(tmp_path / "one.mcap", [(0.5, 0.2, 200)])
    two = record_env(tmp_path / "two.mcap", "point_goal")
    data = read_demonstrations([one, two])
    assert len(data.episodes) == 3
    assert data.steps == sum(len(episode.actions) for episode in data.episodes)
    other = record_env(tmp_path / "other.mcap", "barn")
    with pytest.raises(ConfigError, match=r"other\.mcap: env_id are .*Barn.*: give --env"):
        read_demonstrations([one, other])
    husky = record_env(tmp_path / "husky.mcap", "point_goal", robot="husky")
    with pytest.raises(ConfigError, match=r"husky\.mcap: speeds are \(1\.0, 2\.0\), not \(0\.5, "):
        read_demonstrations([two, husky])


def test_what_was_not_driven_is_no_demonstration(tmp_path: Path) -> None:
    """A step that a fault ended, and what a person asked for after an emergency stop."""
    env = gymnasium.make(
        full_id("point_goal"),
        link=FailingLink(open_link("planar"), 1.0),
        record=tmp_path / "env.mcap",
    )
    env.reset(seed=0)
    steps = 0
    while not env.step(np.array([0.5, 0.0], np.float32))[3]:
        steps += 1
    env.close()
    (episode,) = read_demonstrations([tmp_path / "env.mcap"]).episodes
    assert len(episode.actions) == len(episode.rewards) == steps > 5
    assert len(episode.observations) == steps + 1
    assert np.abs(np.diff(episode.observations, axis=0)).max(axis=1).min() > 0.0

    recorder = Recorder(tmp_path / "drive.mcap")
    with Robot(open_link("planar", CONFIG), CONFIG, recorder=recorder) as robot:
        for tick in range(300):
            if tick == 205:
                robot.estop()
            robot.drive(0.4, 0.0)
    (episode,) = read_demonstrations([tmp_path / "drive.mcap"], goal=(2.5, 0.0)).episodes
    assert len(episode.actions) == 20


def test_what_cannot_be_replayed_says_so(tmp_path: Path) -> None:
    tape = record_drive(tmp_path / "drive.mcap", [(0.5, 0.0, 200)])
    for env, said in (
        ("obstacle_goal", "has no scans, which acsar_gym/ObstacleGoal-v1 observes"),
        ("path_follow", "acsar_gym/PathFollow-v0: has no goal"),
        ("CartPole-v1", "CartPole-v1: "),
        ("maze", "env maze: "),
    ):
        with pytest.raises(ConfigError, match=said):
            read_demonstrations([tape], env)
    with pytest.raises(ConfigError, match=r"must lie 0\.5 to"):
        read_demonstrations([tape], goal=(0.1, 0.0))
    recorder = Recorder(tmp_path / "silent.mcap")
    with Robot(open_link("planar", CONFIG), CONFIG, recorder=recorder) as robot:
        for _ in range(200):
            robot.drive(0.8, 0.0)
        robot.listen()
        for _ in range(10):
            robot.drive(0.8, 0.0)
    with pytest.raises(ConfigError, match="has ticks without a command"):
        read_demonstrations([tmp_path / "silent.mcap"])


def test_a_file_names_no_module_to_import(tmp_path: Path) -> None:
    tape = tmp_path / "tape.mcap"
    recorder = Recorder(tape, {"env": {"id": "antigravity:mine/Env-v0"}})
    with Robot(open_link("planar", CONFIG), CONFIG, recorder=recorder) as robot:
        robot.drive(0.8, 0.0)
    with pytest.raises(ConfigError, match="env mine/Env-v0: "):
        read_demonstrations([tape])


def test_a_cut_episode_is_left_out(tmp_path: Path) -> None:
    whole = record_env(tmp_path / "tape.mcap", "obstacle_goal").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 9 // 10])
    with pytest.warns(RecordingWarning, match=r"cut\.mcap: the file is cut: the last .* left out"):
        assert len(read_demonstrations([tmp_path / "cut.mcap"]).episodes) == 1
    (tmp_path / "cut.mcap").write_bytes(drive(tmp_path / "d.mcap", CONFIG, 300).read_bytes()[:-900])
    with (
        pytest.warns(RecordingWarning, match="left out"),
        pytest.raises(ConfigError, match="holds no whole episode"),
    ):
        read_demonstrations([tmp_path / "cut.mcap"])
