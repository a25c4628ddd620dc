"""Tasks among people: what they pay for, by what the robot observes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from task_tools import ACSAR, Played

from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import outline_radius
from acsar_gym.errors import ConfigError
from acsar_gym.sensors.map.movers import MOST_RADIUS, MOVER_NAMES
from acsar_gym.sensors.map.sensor import FARTHEST_CLEARANCE, MAP_NAMES, log_share
from acsar_gym.tasks import Crowd, DynaBarn, ObstacleGoal, Task
from acsar_gym.tasks.crowd import CROWDING_COST, TOP_SPEED
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.crowd import PERSONAL_SPACE
from acsar_gym.worlds.movers import walk

WORLD = World(start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(4.0, 0.0))
REACH = outline_radius(ACSAR.outline)


def sensed(gap: float | None = None, bearing: float = 0.0, radius: float = 0.25) -> Any:
    """Numbers of map, movers and LiDAR, with one mover's hull so far from the robot's circle."""
    numbers = np.ones(len(MAP_NAMES) + len(MOVER_NAMES) + 64)
    numbers[[MAP_NAMES.index(name) for name in ("gained", "stalled")]] = 0.0
    numbers[TOP_SPEED] = ACSAR.max_linear / (10.0 * REACH)
    movers = dict.fromkeys(MOVER_NAMES, 0.0)
    if gap is not None:
        length = log_share((gap + REACH + radius) / REACH, FARTHEST_CLEARANCE)
        movers["mover_moves_0"] = 1.0
        movers["mover_x_0"] = length * math.cos(bearing)
        movers["mover_y_0"] = length * math.sin(bearing)
        movers["mover_radius_0"] = radius / REACH / MOST_RADIUS
    numbers[len(MAP_NAMES) : len(MAP_NAMES) + len(MOVER_NAMES)] = list(movers.values())
    return numbers


@pytest.mark.parametrize(
    ("known", "share"),
    [
        ({}, 0.0),
        ({"gap": 3.0}, 0.0),
        ({"gap": 0.46}, 0.0),
        ({"gap": 0.225}, 0.5),
        ({"gap": 0.225, "bearing": 2.0, "radius": 0.6}, 0.5),
        ({"gap": 0.0}, 1.0),
        ({"gap": -0.1}, 1.0),
    ],
)
def test_the_personal_space_of_who_is_observed_costs_reward(
    known: dict[str, float], share: float
) -> None:
    plain = Played(ObstacleGoal(), {}, WORLD).step(sensed=sensed())[0]
    paid = Played(Crowd(), {}, WORLD).step(sensed=sensed(**known))[0]
    assert plain - paid == pytest.approx(CROWDING_COST * share)


@pytest.mark.parametrize(("task", "cost"), [(Crowd(), 15.0), (DynaBarn(), 30.0)])
def test_what_a_collision_costs(task: Task, cost: float) -> None:
    plain = Played(task, {}, WORLD).step(sensed=sensed())[0]
    paid = Played(task, {}, WORLD).step(sensed=sensed(), contact=1.0)[0]
    assert plain - paid == pytest.approx(cost)


@pytest.mark.parametrize("robot", ["acsar", "jackal"])
def test_what_is_paid_for_is_where_somebody_is(robot: str) -> None:
    """Somebody walks past the side of a robot that stands."""
    reach, radius, least = outline_radius(RobotConfig.preset(robot).outline), 0.25, 0.15
    beside = reach + radius + least
    passing = walk([[-3.0, beside], [3.0, beside]], 0.8, radius=radius)
    world = replace(WORLD, movers=[passing])
    envs: list[Any] = [
        gymnasium.make(f"acsar_gym/{kind}", link="planar", robot=robot, worlds=world)
        for kind in ("Crowd-v0", "ObstacleGoal-v1")
    ]
    for env in envs:
        env.reset(seed=0)
    crowding, expected = [], []
    for _ in range(70):
        paid, plain = (float(env.step(np.zeros(2, np.float32))[1]) for env in envs)
        crowding.append((plain - paid) / CROWDING_COST)
        truth = envs[0].unwrapped.robot.link.truth
        gap = math.hypot(*truth.crowd.states[0, :2]) - reach - radius
        expected.append(1.0 - min(max(gap / PERSONAL_SPACE, 0.0), 1.0))
    for env in envs:
        env.close()
    assert max(expected) > 0.6
    assert crowding == pytest.approx(expected, abs=0.06)


def test_a_task_among_people_must_sense_them() -> None:
    with pytest.raises(
        ConfigError, match=r"Blind\.sensors = \('map', 'lidar'\): must name 'movers'"
    ):
        type("Blind", (Crowd,), {"sensors": ("map", "lidar")})
