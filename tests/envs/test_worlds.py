"""Worlds of the ids: which they train and drive in, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import pytest
from env_tools import IDS, SEEING, WALL, inner, make

from acsar_gym import Robot, World
from acsar_gym.errors import (
    AcsarError,
    ConfigError,
    WorldError,
)
from acsar_gym.links import open_link
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.worlds import Region, Scene

BARN = Path(__file__).parents[3] / "shared" / "barn"


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (World(np.array([[0.1, 0.0, 0.3]]), goal=Region(3.0, 0.0)), "the start .* obstacle"),
        (World(np.array([[3.0, 0.0, 0.1]]), goal=Region(3.0, 0.0)), "the goal .* obstacle"),
        (
            World(
                segments=np.array([[1, -1, 1, 1], [-1, -1, -1, 1], [-1, -1, 1, -1], [-1, 1, 1, 1]]),
                goal=Region(3.0, 0.0),
            ),
            "no way from start to goal",
        ),
    ],
)
def test_worlds_that_cannot_be_driven_are_refused(world: World, message: str) -> None:
    with pytest.raises(AcsarError, match=message):
        make(SEEING[0], worlds=world).reset(seed=0)


def test_options_of_a_reset_choose_world_goal_and_path() -> None:
    env = make(SEEING[0])
    _, info = env.reset(options={"world": 3, "goal": (1.0, 0.5)})
    assert info["world"] == 3.0
    assert info["goal_distance"] == pytest.approx(math.hypot(1.0, 0.5))
    env.close()
    env = make("acsar_gym/PathFollow-v0")
    _, info = env.reset(options={"path": [(0.0, 0.1), (1.0, 0.1)]})
    assert info["cross_track_error"] == pytest.approx(-0.1)
    with pytest.raises(ConfigError, match="did you mean 'path'"):
        env.reset(options={"paths": 1})
    env.close()


def test_barns_rules() -> None:
    env = make("acsar_gym/Barn-v1")
    assert env.spec is not None
    assert env.spec.max_episode_steps == 1000
    _, info = env.reset(seed=0)
    assert info["goal_distance"] == pytest.approx(10.0)
    assert inner(env).task.goal_tolerance == 1.0
    assert info["barn_score"] == 0.0
    env.close()


@pytest.mark.skipif(not BARN.is_dir(), reason="no published worlds here")
def test_barn_takes_a_folder_of_published_worlds() -> None:
    env = make("acsar_gym/Barn-v1", worlds=BARN)
    names, lengths = set(), []
    for number in range(5):
        env.reset(options={"world": number})
        assignment = inner(env).episode.assignment
        assert assignment.world is not None
        names.add(assignment.world.name)
        lengths.append(assignment.length)
    assert names == {"world_1", "world_77", "world_101", "world_201", "world_299"}
    assert sorted(lengths) == pytest.approx([10.029, 10.738, 10.758, 12.312, 13.446], abs=0.01)
    env.close()


def test_the_robot_drives_the_same_in_a_world_as_on_an_open_floor() -> None:
    """Far obstacles change nothing of what odometry says, in PyBullet."""
    rows = []
    for world in (None, WALL):
        link = open_link("bullet")
        robot = Robot(link)
        robot.reset(Scene(world=world))
        for _ in range(100):
            robot.drive(0.3, 0.5)
        rows.append(robot.odometry.pose)
        robot.deactivate()
    assert rows[0] == rows[1]


# Worlds to train in and to test in, and their numbers


WORLDS = [env_id for env_id in IDS if env_id != "acsar_gym/PointGoal-v0"]


@pytest.mark.parametrize("env_id", WORLDS)
def test_ids_train_in_the_training_split(env_id: str) -> None:
    env = gymnasium.make(env_id, link="planar")
    pool = inner(env).pool
    assert pool is not None
    assert (pool.split, pool.numbers) == ("train", range(1000, 1400))
    _, info = env.reset(seed=0)
    assert 1000 <= info["world"] < 1400
    env.close()
    batch = gymnasium.make_vec(env_id, 1, vectorization_mode="vector_entry_point")
    pool = cast("RobotVectorEnv", batch.unwrapped).pool
    assert pool is not None
    assert pool.numbers == range(1000, 1400)


def test_a_world_is_known_by_its_generators_number() -> None:
    env = make(SEEING[0], worlds="clutter:1000-1399")
    _, info = env.reset(options={"world": 1254})
    world = inner(env).episode.assignment.world
    assert info["world"] == 1254.0
    assert world is not None
    assert world.name == "clutter 1254"
    for number in (254, 999, 1400):
        with pytest.raises(WorldError, match=f"world {number}: must be 1000 to 1399"):
            env.reset(options={"world": number})
    env.close()


def test_a_batch_tells_the_same_numbers() -> None:
    many: Any = gymnasium.make_vec(
        SEEING[0], 8, vectorization_mode="vector_entry_point", worlds="open:1250-1254"
    )
    one = make(SEEING[0], worlds="open:1250-1254")
    told = many.reset(seed=0)[1]["world"].tolist()
    assert told == [one.reset(seed=seed)[1]["world"] for seed in range(8)]
    assert set(told) <= set(range(1250, 1255))
    many.close()
    one.close()
