"""Recordings as steps of an env: those that an env recorded, and those of other drives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from boards import FailingLink
from recording_tools import record_drive, record_env

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.envs.ids import full_id
from acsar_gym.errors import ConfigError, RecordingWarning
from acsar_gym.recording import Recorder, read
from acsar_gym.tasks import PointGoal, State
from acsar_gym.tools.datasets import read_demonstrations

CONFIG = RobotConfig.of(None)
TOP = (CONFIG.max_linear, CONFIG.max_angular)


def assert_same_steps(episode: Any, recorded: Any) -> None:
    for name in ("observations", "actions", "rewards", "terminated"):
        np.testing.assert_array_equal(getattr(episode, name), getattr(recorded, name))


@pytest.mark.parametrize(
    ("env_id", "options"),
    [("point_goal", {"policy_rate": 20.0, "robot": "jackal"}), ("obstacle_goal", {})],
)
def test_read_demonstrations_takes_an_envs_steps_as_they_are(
    env_id: str, options: dict[str, Any], tmp_path: Path
) -> None:
    """Made of ticks and bytes alone, they are the same to the last bit."""
    tape = record_env(tmp_path / "tape.mcap", env_id, **options)
    data = read_demonstrations([tape])
    assert data.env_id == full_id(env_id)
    assert data.rate == options.get("policy_rate", 10.0)
    assert len(data.names) == data.episodes[0].observations.shape[1]
    assert [episode.seed for episode in data.episodes] == [0, 1]
    for episode, recorded in zip(data.episodes, read(tape).episodes, strict=True):
        assert_same_steps(episode, recorded)

    if env_id == "obstacle_goal":
        replayed = read_demonstrations([tape], env_id)
        assert (replayed.rate, replayed.names) == (data.rate, data.names)
        for pair in zip(replayed.episodes, data.episodes, strict=True):
            assert_same_steps(*pair)


def test_read_demonstrations_of_a_drive_has_an_agents_steps(tmp_path: Path) -> None:
    """Commands change in the middle of steps. The goal is where the drive ended."""
    way = [(0.3, 0.0, 105), (0.5, 2.0, 47), (9.0, -0.5, 30), (0.2, 0.0, 47)]
    tape = record_drive(tmp_path / "drive.mcap", way)
    data = read_demonstrations([tape])
    (episode,) = data.episodes
    (recorded,) = read(tape).episodes
    actions = episode.actions
    count = len(actions)
    assert (data.env_id, data.rate, data.policy) == (full_id("point_goal"), 10.0, "unknown")
    assert episode.terminated
    assert 18 <= count <= 22
    twists = recorded.asked[: 10 * count].reshape(count, 10, 2).mean(axis=1) / TOP
    np.testing.assert_allclose(actions, np.clip(twists, -1.0, 1.0), atol=1e-6)
    assert actions[10, 1] == pytest.approx(0.5 * 2.0 / TOP[1])  # half of the step
    assert actions[15:18, 0].max() == 1.0

    goal = tuple(recorded.poses[-1, :2].tolist())
    places = zip(recorded.poses[9::10], recorded.twists[9::10], actions.tolist(), strict=False)
    for shown, (pose, twist, action) in zip(episode.observations[1:], places, strict=True):
        state = State(tuple(pose), tuple(twist), action=tuple(action), goal=goal, max_twist=TOP)
        observation = np.array(PointGoal().observe(state, None), np.float32)
        np.testing.assert_array_equal(shown, observation)


def test_read_demonstrations_accepts_a_goal_that_is_far_away(tmp_path: Path) -> None:
    """A drive of 5 m is seen as by an agent whose observations have the usual scale."""
    tape = record_drive(tmp_path / "drive.mcap", [(1.0, 0.0, 1000)])
    (distant,) = read_demonstrations([tape]).episodes
    assert distant.terminated
    assert distant.observations[0, 0] == pytest.approx(
        float(read(tape).episodes[0].poses[-1, 0]) / 3.0
    )
    (near,) = read_demonstrations([tape], goal=(2.0, 0.0)).episodes
    assert near.observations[0, 0] == pytest.approx(2.0 / 3.0)
    assert len(near.actions) < len(distant.actions) / 2
    (missed,) = read_demonstrations([tape], goal=(0.0, 1.0)).episodes
    assert (len(missed.actions), missed.terminated) == (100, False)


def test_read_demonstrations_leaves_out_drives_without_a_way(tmp_path: Path) -> None:
    ahead = [(0.5, 0.0, 200)]
    tape = record_drive(tmp_path / "drive.mcap", [(0.3, 0.0, 5)], ahead, [(0.0, 1.0, 200)], ahead)
    with pytest.warns(RecordingWarning) as caught:
        data = read_demonstrations([tape])
    texts = sorted(str(warning.message).partition("mcap: ")[2] for warning in caught)
    assert texts[0] == "episode 0 is left out: it is shorter than a step"
    assert texts[1].startswith("episode 2 is left out: its goal is 0.0")
    assert_same_steps(*data.episodes)


def test_read_demonstrations_joins_recordings_that_fit(tmp_path: Path) -> None:
    drove = record_drive(tmp_path / "drove.mcap", [(0.5, 0.2, 200)])
    steps = record_env(tmp_path / "steps.mcap", "point_goal")
    data = read_demonstrations([drove, steps])
    assert len(data.episodes) == 3
    assert data.steps == sum(len(episode.actions) for episode in data.episodes)
    husky = record_env(tmp_path / "husky.mcap", "point_goal", robot="husky")
    with pytest.raises(ConfigError, match=r"husky\.mcap: speeds are \(1\.0, 2\.0\), not \(0\.5, "):
        read_demonstrations([steps, husky])


def test_read_demonstrations_leaves_out_a_step_that_a_fault_ended(tmp_path: Path) -> None:
    path = tmp_path / "env.mcap"
    link = FailingLink(open_link("planar"), 1.0)
    env = gymnasium.make(full_id("point_goal"), link=link, record=path)
    env.reset(seed=0)
    steps = 0
    while not env.step(np.array([0.5, 0.0], np.float32))[3]:
        steps += 1
    env.close()
    (episode,) = read_demonstrations([path]).episodes
    assert len(episode.actions) == len(episode.rewards) == steps > 5
    assert len(episode.observations) == steps + 1


def test_read_demonstrations_replays_an_episode_that_lacks_a_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that was too slow may have cost it."""
    add = Recorder.add

    def forget(recorder: Recorder, rows: Any) -> None:
        if "steps" not in rows or rows["steps"][0] != 30:
            add(recorder, rows)

    monkeypatch.setattr(Recorder, "add", forget)
    tape = record_env(tmp_path / "tape.mcap", "point_goal", 1)
    assert len(read(tape).episodes[0].actions) == 39
    (episode,) = read_demonstrations([tape]).episodes
    assert len(episode.actions) == 40


def record_robot(path: Path, happens: str = "", about: dict[str, Any] | None = None) -> Path:
    """Drive for 300 ticks, and call a method of the robot in between."""
    with Robot(open_link("planar", CONFIG), CONFIG, recorder=Recorder(path, about)) as robot:
        for tick in range(300):
            if tick == 205 and happens:
                getattr(robot, happens)()
            robot.drive(0.4, 0.0)
    return path


def test_read_demonstrations_ends_at_an_emergency_stop(tmp_path: Path) -> None:
    tape = record_robot(tmp_path / "drive.mcap", "estop")
    (episode,) = read_demonstrations([tape], goal=(2.5, 0.0)).episodes
    assert len(episode.actions) == 20


def test_read_demonstrations_explains_what_cannot_be_replayed(tmp_path: Path) -> None:
    tape = record_robot(tmp_path / "drive.mcap")
    for env, text in (
        ("obstacle_goal", "has no scans, which acsar_gym/ObstacleGoal-v1 observes"),
        ("path_follow", "acsar_gym/PathFollow-v0: has no goal"),
        ("CartPole-v1", "CartPole-v1: "),
    ):
        with pytest.raises(ConfigError, match=text):
            read_demonstrations([tape], env)
    with pytest.raises(ConfigError, match=r"must lie 0\.5 to"):
        read_demonstrations([tape], goal=(0.1, 0.0))
    silent = record_robot(tmp_path / "silent.mcap", "listen")
    with pytest.raises(ConfigError, match="has ticks without a command"):
        read_demonstrations([silent])

    # A file must not name a module to import.
    foreign = record_robot(tmp_path / "tape.mcap", "", {"env": {"id": "antigravity:mine/Env-v0"}})
    with pytest.raises(ConfigError, match="env mine/Env-v0: "):
        read_demonstrations([foreign])


def test_read_demonstrations_leaves_out_a_cut_episode(tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    data = record_env(tmp_path / "tape.mcap", "obstacle_goal").read_bytes()
    cut.write_bytes(data[: len(data) * 9 // 10])
    with pytest.warns(RecordingWarning, match=r"cut\.mcap: the file is cut: the last .* left out"):
        assert len(read_demonstrations([cut]).episodes) == 1
