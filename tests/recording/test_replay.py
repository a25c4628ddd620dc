"""The proof that the wire is the seam: recorded bytes, played back, give the same observations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from recording_tools import drive, taped
from scenes import HALL

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.envs.ids import full_id
from acsar_gym.errors import ConfigError, LinkError, LinkLostError
from acsar_gym.recording import read
from acsar_gym.recording.replay import ReplayLink
from acsar_gym.worlds import Scene

ENV_ID = "acsar_gym/PointGoal-v0"
STEPS = 60


def rollout(link: Any, env_id: str = ENV_ID, steps: int = STEPS, **options: Any) -> list[bytes]:
    """Observations, rewards and infos of two episodes with fixed actions, as bytes."""
    env = gymnasium.make(env_id, link=link, **options)
    rng = np.random.default_rng(11)
    contents: list[bytes] = []
    for seed in (5, None):
        observation, info = env.reset(seed=seed)
        contents.append(observation.tobytes() + repr(info).encode())
        for _ in range(steps):
            action = rng.uniform(-0.2, 1.0, 2).astype(np.float32)
            observation, *result, info = env.step(action)
            contents.append(observation.tobytes() + repr((result, info)).encode())
            if any(result[1:]):
                break
    env.close()
    return contents


@pytest.fixture(scope="module")
def bullet(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[bytes]]:
    tape = tmp_path_factory.mktemp("tape") / "bullet.mcap"
    return tape, rollout("bullet", record=tape)


@pytest.mark.parametrize("name", ["point_goal", "obstacle_goal", "path_follow", "barn"])
def test_replay_of_each_id_is_equal_to_the_bit(name: str, tmp_path: Path) -> None:
    """Truth and noise of the LiDAR included, and the second episode, which has no seed."""
    env_id = full_id(name)
    tape = tmp_path / "tape.mcap"
    contents = rollout("planar", env_id, 25, record=tape)
    assert rollout(f"replay:{tape}", env_id, 25) == contents
    has_lidar = name in ("obstacle_goal", "barn")
    assert len(read(tape).episodes[0].scans.stamps) == (25 + 1) * has_lidar


def test_replay_moves_people_as_recorded(tmp_path: Path) -> None:
    """Also people who react, and what info tells of them, and in a recording of the replay."""
    env_id = full_id("obstacle_goal")
    tape = tmp_path / "tape.mcap"
    again = tmp_path / "again.mcap"
    contents = rollout("planar", env_id, record=tape, worlds=HALL)
    assert rollout(f"replay:{tape}", env_id, record=again, worlds=HALL) == contents
    assert b"'closest_person': 100.0" not in contents[-1]
    first, second = (read(path).episodes[1] for path in (tape, again))
    for numbers, copied in zip(first.movers, second.movers, strict=True):
        np.testing.assert_array_equal(numbers, copied)
        assert len(numbers) == len(first.exchanges)
    assert (first.wire.sent, first.wire.got) == (second.wire.sent, second.wire.got)
    np.testing.assert_array_equal(first.truth, second.truth)


def test_replay_names_the_tick_of_other_commands(bullet: tuple[Path, list[bytes]]) -> None:
    env = gymnasium.make(ENV_ID, link=f"replay:{bullet[0]}", on_fault="raise")
    env.reset(seed=5)
    rng = np.random.default_rng(11)
    for _ in range(3):
        env.step(rng.uniform(-0.2, 1.0, 2).astype(np.float32))
    with pytest.raises(LinkLostError, match="other commands than recorded, tick 33: 'a"):
        env.step(np.array([-1.0, -1.0], np.float32))
    env.close()


def test_replay_explains_what_it_lacks(config: RobotConfig, tmp_path: Path) -> None:
    link = ReplayLink(taped(tmp_path / "blind.mcap", config), compare=False)
    with pytest.raises(LinkError, match=r"no revolutions .* kept only the scans: record"):
        Robot(link, config, ["lidar"]).activate()
    with pytest.raises(ConfigError, match="no such file"):
        open_link(f"replay:{tmp_path / 'none.mcap'}").open()


def test_replay_ends_where_a_file_is_cut(config: RobotConfig, tmp_path: Path) -> None:
    path = drive(tmp_path / "cut.mcap", config)
    path.write_bytes(path.read_bytes()[:-100])
    link = ReplayLink(path, compare=False)
    link.reset(Scene())
    with pytest.raises(LinkLostError, match=r"cut\.mcap: the file is cut here"):
        for _ in range(1000):
            link.advance(config.period)
    with pytest.raises(LinkLostError, match="all 1 episodes have been played; the file is cut"):
        link.reset(Scene())
