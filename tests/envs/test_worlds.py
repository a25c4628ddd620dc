"""Worlds of the ids: which they train and drive in, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from scenes import HALL

from acsar_gym import World
from acsar_gym.envs.ids import make_vec
from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.sensors.map.sensor import MAP_NAMES
from acsar_gym.tasks.state import CrowdInfo
from acsar_gym.worlds import Region, cache
from acsar_gym.worlds.world import to_world

POINT_GOAL = "acsar_gym/PointGoal-v0"
OBSTACLE_GOAL = "acsar_gym/ObstacleGoal-v1"
PATH_FOLLOW = "acsar_gym/PathFollow-v0"


def test_reset_options_choose_world_goal_and_path(make: Any) -> None:
    env = make(OBSTACLE_GOAL)
    _, info = env.reset(options={"world": 3, "goal": (1.0, 0.5), "difficulty": None})
    assert info["world"] == 3.0
    assert info["goal_distance"] == pytest.approx(math.hypot(1.0, 0.5))
    with pytest.raises(ConfigError, match="'world' and 'difficulty' contradict each other"):
        env.reset(options={"world": 3, "difficulty": (0.0, 1.0)})
    env = make(PATH_FOLLOW)
    _, info = env.reset(options={"path": [(0.0, 0.1), (1.0, 0.1)]})
    assert info["cross_track_error"] == pytest.approx(-0.1)


HALL_SDF = """<sdf version='1.9'><world name='w'><model name='m'><pose>3 0 0.4 0 0 0</pose>
<link name='l'><collision name='c'><geometry><cylinder><radius>0.2</radius><length>1</length>
</cylinder></geometry></collision></link></model></world></sdf>"""


def test_worlds_file_is_passed_with_what_it_does_not_contain(tmp_path: Path, make: Any) -> None:
    path = tmp_path / "hall.sdf"
    path.write_text(HALL_SDF, encoding="utf-8")
    with pytest.raises(WorldError, match="has no start and no goal"):
        make(OBSTACLE_GOAL, worlds=path)
    with pytest.raises(ConfigError, match=r"unknown field 'worlds\.gaol'; did you mean 'goal'"):
        make(OBSTACLE_GOAL, worlds={"path": path, "gaol": (1.0, 2.0)})

    env = make(OBSTACLE_GOAL, worlds={"path": path, "start": (1.0, 2.0, 0.5), "goal": [5.0, 2.0]})
    _, info = env.reset(seed=0)
    assert info["goal_distance"] == pytest.approx(4.0)
    assert env.unwrapped.episode.assignment.start == (1.0, 2.0, 0.5)
    again: Any = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.pool.sets[0].generator == str(path)


def test_worlds_of_an_id_are_the_training_split(
    env_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if env_id == POINT_GOAL:
        return
    env: Any = gymnasium.make(env_id, link="planar")
    pool = env.unwrapped.pool
    assert (pool.split, pool.numbers) == ("train", range(1000, 1400))
    _, info = env.reset(seed=0)
    assert 1000 <= info["world"] < 1400

    world = pool[1000]  # for all numbers: 400 worlds that move take a minute
    monkeypatch.setattr(cache, "cached_world", lambda *_: world)
    batch: Any = make_vec(env_id, 1)
    assert batch.unwrapped.pool.numbers == range(1000, 1400)


START = (5.0, -3.0, 2.0)
PILLAR = World(
    circles=np.array([[*to_world(START, (1.5, 0.0, 0.0))[:2], 0.1]]),
    start=Region(*START[:2], 0.0, START[2]),
    goal=Region(*to_world(START, (3.0, 1.0, 0.0))[:2]),
    name="pillar",
)
AHEAD = np.array([1.0, 0.0], np.float32)
QUIET = {"lidar": {"noise": 0.0}}


def test_info_is_in_the_odometry_frame(link: str, make: Any) -> None:
    env = make(OBSTACLE_GOAL, link, worlds=PILLAR, robot=QUIET)
    robot = env.unwrapped.robot
    _, info = env.reset(seed=0)
    assert (info["true_x"], info["true_y"], info["true_theta"]) == pytest.approx((0, 0, 0))
    assert info["true_goal_distance"] == pytest.approx(math.hypot(3.0, 1.0))
    assert robot.link.truth is not None
    assert robot.link.truth.pose == pytest.approx(START, abs=1e-9)

    for _ in range(10):
        observation, *_, info = env.step(AHEAD)
    pose = (info["true_x"], info["true_y"], info["true_theta"])
    assert pose[0] > 0.2
    assert info["odometry_error"] < 0.05
    assert to_world(START, pose)[:2] == pytest.approx(robot.link.truth.pose[:2])
    ahead: Any = observation[7 + len(MAP_NAMES) + 32] * robot.config.lidar.max_range
    assert ahead == pytest.approx(1.4 - pose[0] - robot.config.lidar_x_offset, abs=0.02)


def test_collision_ends_the_episode_and_leaves_no_trace(link: str, make: Any) -> None:
    """PyBullet keeps what doesn't move as long as the world is the same."""
    env = make(OBSTACLE_GOAL, link, worlds=PILLAR, robot=QUIET)
    episodes = []
    for _ in range(2):
        episode = [env.reset(seed=0)[0].tobytes()]
        terminated = False
        while not terminated:
            observation, reward, terminated, _, info = env.step(AHEAD)
            episode.append(observation.tobytes())
        episodes.append(episode)
        assert float(reward) < -4.0
        assert (info["true_contact"], info["is_success"]) == (1.0, 0.0)
        reach = env.unwrapped.robot.config.body.length / 2.0
        assert info["true_x"] == pytest.approx(1.4 - reach, abs=0.06)
    assert episodes[0] == episodes[1]


def test_reset_chooses_a_world_that_moves_or_stands(make: Any) -> None:
    moving = make(OBSTACLE_GOAL, worlds=HALL)
    _, info = moving.reset(options={"world": World()})
    assert [info[key] for key in CrowdInfo._fields] == [100.0, 10.0, 0.0, 0.0]
    assert moving.reset()[1]["closest_person"] < 3.0

    standing = make(OBSTACLE_GOAL)
    for world, has_crowd in ((HALL, True), (None, False)):
        _, info = standing.reset(options={"world": world})
        assert (standing.unwrapped.robot.link.truth.crowd is not None) == has_crowd
        assert not set(CrowdInfo._fields) & info.keys()
