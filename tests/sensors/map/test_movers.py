"""The sensor of what moves: its numbers, and that a batch has the same."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest

import acsar_gym  # noqa: F401 - registers the ids
from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.config.footprint import outline_radius
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError
from acsar_gym.sensors import LIDAR, MAP, MOVERS
from acsar_gym.sensors.map.courses import COURSES
from acsar_gym.sensors.map.movers import (
    FIRST_COURSE,
    MOST_MOVERS,
    MOST_RADIUS,
    MOST_SPEED,
    MOVER_LOW,
    MOVER_NAMES,
    NUMBERS,
    fill_alone,
)
from acsar_gym.sensors.map.sensor import FARTHEST_CLEARANCE, MAP_NAMES, MapSensor, log_share
from acsar_gym.sensors.map.tracks import AGE, HAS_MOVED, MOVES, RADIUS, SPEED_VAR
from acsar_gym.worlds import World
from acsar_gym.worlds.movers import walk
from acsar_gym.worlds.world import Region

ACSAR = RobotConfig.preset("acsar")
OUTER = outline_radius(ACSAR.outline)
CROWDED = World(
    circles=np.array([(3.0, 1.5, 0.2), (2.0, -2.5, 0.3)]),
    start=Region(0.0, 0.0, 0.0, 0.0),
    goal=Region(7.0, 0.0),
    movers=(
        walk([(3.0, -2.0), (3.0, 2.0)], 0.8),
        walk([(6.0, 0.6), (0.5, 0.6)], 1.2),
        walk([(1.5, 2.5), (4.0, -1.0)], 0.5, reacts=True),
    ),
)


def told(tracks: Sequence[tuple[float, ...]], pose: Any) -> Any:
    """Numbers of the sensor, (MOST_MOVERS, numbers), for tracks of place, velocity and radius."""
    return told_all(tracks, pose)[:FIRST_COURSE].reshape(MOST_MOVERS, len(NUMBERS))


def told_all(tracks: Sequence[tuple[float, ...]], pose: Any, moves: float = 1.0) -> Any:
    """All numbers of the sensor for tracks of place, velocity and radius."""
    record: Any = MapSensor(None, ACSAR).records
    for row, numbers in zip(record["tracks"][0], tracks, strict=False):
        row[: RADIUS + 1] = numbers
        row[AGE], row[MOVES], row[HAS_MOVED], row[SPEED_VAR] = 5.0, moves, moves, 0.04
    out = np.full(len(MOVER_NAMES), np.nan)
    fill_alone(record, pose, out)
    assert (out >= MOVER_LOW).all()
    assert (out <= 1.0).all()
    return out


def test_movers_are_told_in_the_robots_frame_and_units_the_first_to_be_met_first() -> None:
    pose = (1.0, 2.0, math.pi / 2.0)
    seen = told([(0.0, 2.0, -0.4, 0.0, 0.2), (1.0, 4.0, 0.0, -0.6, 0.3)], pose)
    scale = MOST_SPEED * ACSAR.max_linear
    near, far = (log_share(apart / OUTER, FARTHEST_CLEARANCE) for apart in (1.0, 2.0))
    wide, narrow = (radius / OUTER / MOST_RADIUS for radius in (0.3, 0.2))
    assert seen[0] == pytest.approx([0.5, far, 0, -0.6 / scale, 0, wide, 1, 0.2])
    assert seen[1] == pytest.approx([0.5, 0, near, 0, 0.4 / scale, narrow, 1, 0.2])
    assert not seen[2:].any()


def test_the_first_of_many_are_told_and_none_is_zeros_and_free_courses() -> None:
    pose = (0.0, 0.0, 0.0)
    many = [(6.0 + 0.3 * n, 0.1, 9.0, -9.0, 5.0) for n in range(MOST_MOVERS + 3)]
    seen = told(many[::-1], pose)
    assert (seen[:, 0] == 0.5).all()
    assert (np.diff(seen[:, 1]) > 0.0).all()
    assert seen[0, 3:].tolist() == pytest.approx([1.0, -1.0, 1.0, 1.0, 0.2])
    nobody = told_all([], pose)
    assert not nobody[:FIRST_COURSE].any()
    assert (nobody[FIRST_COURSE:] == 1.0).all()


def test_who_comes_across_is_met_on_the_courses_that_lead_there_alone() -> None:
    """Somebody walks across in front, and is there when a robot that drives straight on is."""
    ahead = ACSAR.max_linear * 1.2
    crossing = (ahead, 1.2 * 0.5, 0.0, -0.5, 0.1)
    numbers = dict(zip(MOVER_NAMES, told_all([crossing], (0.0, 0.0, 0.0)), strict=True))
    straight, stop = COURSES.index((1.0, 0.0)), COURSES.index((0.0, 0.0))
    assert 0.0 < numbers[f"contact_{straight}"] < 0.5
    assert numbers[f"gap_{straight}"] < 0.1
    assert numbers[f"contact_{stop}"] == 1.0
    assert numbers[f"gap_{stop}"] > 0.1


def test_only_who_is_sure_to_be_fast_is_met_on_courses() -> None:
    """An unsure track counts once it is faster than its deviation explains."""
    coming, pose = (1.5, 0.0, -0.9, 0.0, 0.2), (0.0, 0.0, 0.0)
    slow = (1.5, 0.0, -0.25, 0.0, 0.2)
    assert told_all([coming], pose, moves=0.0)[FIRST_COURSE:].min() < 0.5
    assert (told_all([slow], pose, moves=0.0)[FIRST_COURSE:] == 1.0).all()
    assert told_all([slow], pose, moves=1.0)[FIRST_COURSE:].min() < 0.5


@pytest.mark.parametrize("robot", ["acsar", "jackal"])
def test_the_movers_of_a_batchs_robot_are_the_single_ones(robot: str) -> None:
    env_id = ids.full_id("obstacle_goal")
    options: dict[str, Any] = {"robot": robot, "worlds": CROWDED, "sensors": [MOVERS]}
    many: Any = ids.make_vec(env_id, 3, threads=1, **options)
    one: Any = gymnasium.make(env_id, link="planar", **options)
    observations, _ = many.reset(seed=41)
    observation, _ = one.reset(seed=42)
    names = [sensor.name for sensor in one.unwrapped.sensors]
    assert names == [MAP, MOVERS, LIDAR] == [sensor.name for sensor in many.batch.sensors]
    assert observations.shape == (3, *observation.shape)
    numbers = len(one.unwrapped.task.observation) + len(MAP_NAMES)
    rng, seen = np.random.default_rng(0), 0.0
    for _ in range(40):
        actions = rng.uniform([0.0, -0.4], [0.3, 0.4], (3, 2)).astype(np.float32)
        observations, *_ = many.step(actions)
        observation, _, ended, _, _ = one.step(actions[1])
        if ended:
            break
        np.testing.assert_allclose(observations[1], observation, rtol=0.0, atol=1e-6)
        tracks = many.batch.maps.records["tracks"][1], one.unwrapped.sensors[0].records["tracks"][0]
        np.testing.assert_allclose(*tracks, rtol=0.0, atol=1e-9)
        seen += observation[numbers : numbers + FIRST_COURSE : len(NUMBERS)].sum()
    assert seen > 10.0
    many.close()
    one.close()


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ([MOVERS, LIDAR], "sensor 'movers': the robot has no 'map', which it needs"),
        ([MOVERS, MAP], "sensor 'map': the robot has no 'lidar', which it needs"),
        ([MOVERS, MAP, LIDAR, MOVERS], "two are named 'movers'"),
        (["muvers"], "did you mean 'movers'"),
    ],
)
def test_movers_need_a_map(sensors: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Robot(open_link("planar", ACSAR), ACSAR, sensors)
    with pytest.raises(ConfigError, match=message):
        ids.make_vec("acsar_gym/PointGoal-v0", 2, sensors=sensors)
