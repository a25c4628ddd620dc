"""The proof that the wire is the seam: recorded bytes, played back, give the same observations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from mover_tools import HALL
from recording_tools import drive
from tapes import TtyReplayLink, playing, taped

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.envs.ids import full_id
from acsar_gym.errors import ConfigError, LinkError, LinkLostError
from acsar_gym.recording import read
from acsar_gym.recording.replay import ReplayLink
from acsar_gym.worlds import Scene

ENV_ID = "acsar_gym/PointGoal-v0"
IDS = ("point_goal", "obstacle_goal", "path_follow", "barn")
EPISODES = 2
STEPS = 60


def rollout(link: Any, env_id: str = ENV_ID, steps: int = STEPS, **options: Any) -> list[bytes]:
    """Observations, rewards and infos of two episodes with fixed actions, as bytes."""
    env = gymnasium.make(env_id, link=link, **options)
    rng = np.random.default_rng(11)
    seen = []
    for episode in range(EPISODES):
        observation, info = env.reset(seed=None if episode else 5)
        seen.append(observation.tobytes() + repr(info).encode())
        for _ in range(steps):
            action = rng.uniform(-0.2, 1.0, 2).astype(np.float32)
            observation, reward, over, cut, info = env.step(action)
            seen.append(observation.tobytes() + repr((reward, over, info)).encode())
            if over or cut:
                break
    env.close()
    return seen


@pytest.fixture(scope="module")
def bullet(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[bytes]]:
    tape = tmp_path_factory.mktemp("tape") / "bullet.mcap"
    return tape, rollout("bullet", record=tape)


@pytest.mark.parametrize("name", IDS)
def test_every_id_replays_bit_for_bit(name: str, tmp_path: Path) -> None:
    """Truth and noise of the LiDAR included, and the second episode, which has no seed."""
    env_id, tape = full_id(name), tmp_path / "tape.mcap"
    seen = rollout("planar", env_id, 25, record=tape)
    assert rollout(f"replay:{tape}", env_id, 25) == seen
    assert len(read(tape).episodes[0].scans.stamps) == (
        0 if name in ("point_goal", "path_follow") else 25 + 1
    )


@pytest.mark.parametrize("body", ["planar"])
def test_movers_are_replayed_where_they_were(body: str, tmp_path: Path) -> None:
    """Also people who react, and what info tells of them; and so is a recording of the replay."""
    env_id, tape, again = full_id("obstacle_goal"), tmp_path / "tape.mcap", tmp_path / "again.mcap"
    seen = rollout(body, env_id, record=tape, worlds=HALL)
    assert rollout(f"replay:{tape}", env_id, record=again, worlds=HALL) == seen
    assert b"'closest_person': 100.0" not in seen[-1]
    first, second = read(tape).episodes[1], read(again).episodes[1]
    for name in ("exchanges", "stamps", "hits", "intrusions", "states"):
        numbers = getattr(first.movers, name)
        np.testing.assert_array_equal(numbers, getattr(second.movers, name))
        assert len(numbers) == len(first.exchanges)
    link = ReplayLink(tape, compare=False)
    link.reset(Scene())
    assert link.truth is not None
    link.advance(0.01)
    link.advance(0.01)
    assert link.truth.crowd is not None
    states = read(tape).episodes[0].movers.states
    np.testing.assert_array_equal(link.truth.crowd.copy_states(), states[1])
    assert (states[1] != states[0]).any()


def test_a_recording_of_a_replay_is_the_same(
    bullet: tuple[Path, list[bytes]], tmp_path: Path
) -> None:
    tape, seen = bullet
    again = tmp_path / "again.mcap"
    assert rollout(f"replay:{tape}", record=again) == seen
    first, second = read(tape).episodes[1], read(again).episodes[1]
    assert (first.wire.sent, first.wire.got) == (second.wire.sent, second.wire.got)
    np.testing.assert_array_equal(first.truth, second.truth)


def test_over_a_real_tty_the_observations_are_the_same_bits(
    bullet: tuple[Path, list[bytes]],
) -> None:
    tape, seen = bullet
    with playing(tape) as (port, heard):
        assert rollout(TtyReplayLink(tape, port)) == seen
        assert heard.get(timeout=5.0) == 0  # and the commands are the same bytes, too


def test_other_commands_are_told_with_their_tick(bullet: tuple[Path, list[bytes]]) -> None:
    tape, _ = bullet
    env = gymnasium.make(ENV_ID, link=f"replay:{tape}", on_fault="raise")
    env.reset(seed=5)
    rng = np.random.default_rng(11)
    for _ in range(3):
        env.step(rng.uniform(-0.2, 1.0, 2).astype(np.float32))
    with pytest.raises(LinkLostError, match="other commands than recorded, tick 33: 'a"):
        env.step(np.array([-1.0, -1.0], np.float32))
    env.close()


def test_what_cannot_be_replayed_or_recorded_is_told(config: RobotConfig, tmp_path: Path) -> None:
    link = ReplayLink(taped(tmp_path / "blind.mcap", config), compare=False)
    with pytest.raises(LinkError, match=r"no revolutions .* kept only the scans: record"):
        Robot(link, config, ["lidar"]).activate()
    with pytest.raises(ConfigError, match="no such file"):
        open_link(f"replay:{tmp_path / 'none.mcap'}").open()
    env = gymnasium.make(ENV_ID, link="planar", record=tmp_path / "no" / "folder.mcap")
    with pytest.raises(ConfigError, match="can't be written"):
        env.reset()
    env.close()


def test_a_cut_recording_says_so(config: RobotConfig, tmp_path: Path) -> None:
    path = drive(tmp_path / "cut.mcap", config)
    path.write_bytes(path.read_bytes()[:-100])
    link = ReplayLink(path, compare=False)
    link.reset(Scene())
    with pytest.raises(LinkLostError, match=r"cut\.mcap: the file is cut here"):
        for _ in range(1000):
            link.advance(config.period)
    with pytest.raises(LinkLostError, match="all 1 episodes have been played; the file is cut"):
        link.reset(Scene())
