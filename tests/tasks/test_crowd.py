"""Tasks among people: what they pay for, by what the robot observes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotEnv
from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import outline_radius
from acsar_gym.errors import ConfigError
from acsar_gym.sensors.map.movers import MOST_RADIUS, MOVER_NAMES
from acsar_gym.sensors.map.sensor import FARTHEST_CLEARANCE, MAP_NAMES, log_share
from acsar_gym.tasks import Crowd, DynaBarn, ObstacleGoal
from acsar_gym.tasks.crowd import TOP_SPEED
from acsar_gym.worlds import Region, World

ACSAR = RobotConfig.preset("acsar")
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
    ("person", "share"),
    [
        ({}, 0.0),
        ({"gap": 0.46}, 0.0),
        ({"gap": 0.225, "bearing": 2.0, "radius": 0.6}, 0.5),
        ({"gap": -0.1}, 1.0),
    ],
)
def test_crowding_in_the_personal_space_of_observed_people(
    person: dict[str, float], share: float, play: Any
) -> None:
    plain = play(ObstacleGoal(), {}, WORLD).step(sensed=sensed())[0]
    paid = play(Crowd(), {}, WORLD).step(sensed=sensed(**person))[0]
    assert plain - paid == pytest.approx(Crowd.weights.crowding * share)


def test_collision_weight_of_dyna_barn(play: Any) -> None:
    free, hit = (play(DynaBarn(), {}, WORLD) for _ in range(2))
    lost = free.step(sensed=sensed())[0] - hit.step(sensed=sensed(), contact=True)[0]
    assert lost == pytest.approx(30.0)


def test_crowd_task_must_sense_people() -> None:
    blind = type("Blind", (Crowd,), {"id": "", "sensors": ("map", "lidar")})
    with pytest.raises(ConfigError, match=r"sensors = \('map', 'lidar'\): must name 'movers'"):
        RobotEnv(blind, link="planar")
