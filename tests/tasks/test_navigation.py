"""Tasks with a goal behind obstacles, and among people: their rewards, and BARN's score."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig, RobotEnv
from acsar_gym.config.footprint import outline_radius
from acsar_gym.errors import ConfigError
from acsar_gym.sensors.map.movers import MOST_RADIUS, MOVER_NAMES
from acsar_gym.sensors.map.sensor import FARTHEST_CLEARANCE, GAINED, MAP_NAMES, STALLED, log_share
from acsar_gym.tasks import Barn, Crowd, DynaBarn, ObstacleGoal
from acsar_gym.tasks.crowd import TOP_SPEED
from acsar_gym.tasks.navigation import BARN_SCORES, barn_score
from acsar_gym.worlds import Region, World

ACSAR = RobotConfig.preset("acsar")
REACH = outline_radius(ACSAR.outline)
WORLD = World(start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(4.0, 0.0))
NAMES = [*MAP_NAMES, *MOVER_NAMES]


def sense(gained: float = 0.0, *clearances: float, stalled: float = 0.0, **movers: float) -> Any:
    """Numbers of map, movers and LiDAR: clearances in radii of the footprint, and far ones."""
    sensed = np.zeros(len(NAMES) + 64)
    sensed[: len(MAP_NAMES)] = 1.0
    sensed[GAINED] = gained
    sensed[STALLED] = stalled
    sensed[TOP_SPEED] = ACSAR.max_linear / (10.0 * REACH)
    for sector, clearance in enumerate(clearances):
        place = MAP_NAMES.index(f"clearance_{47 - 10 * sector}")
        sensed[place] = log_share(clearance, FARTHEST_CLEARANCE)
    for name, number in movers.items():
        sensed[NAMES.index(name)] = number
    return sensed


def sense_person(gap: float, bearing: float = 0.0, radius: float = 0.25) -> Any:
    """With a person whose hull is so far from the robot's circle."""
    length = log_share((gap + REACH + radius) / REACH, FARTHEST_CLEARANCE)
    return sense(
        mover_moves_0=1.0,
        mover_x_0=length * math.cos(bearing),
        mover_y_0=length * math.sin(bearing),
        mover_radius_0=radius / REACH / MOST_RADIUS,
    )


@pytest.mark.parametrize(
    ("state", "reward"),
    [
        ({}, -0.04),
        ({"sensed": sense(1.0)}, 0.06),
        ({"pose": (1.0, 0.0, 0.0)}, -0.04),  # nearer in a straight line, but not along the way
        ({"action": (-1.0, 0.0)}, -0.09),
        ({"contact": True}, -15.04),
        ({"sensed": sense(stalled=0.4)}, -0.08),
        ({"twist": (1.0, -1.5)}, -0.12),  # it slides
        ({"pose": (3.8, 0.0, 0.0)}, 4.96),
        ({"sensed": sense(0.0, 0.0)}, -0.19),
        ({"sensed": sense(0.0, 3.0, 0.2)}, -0.04 - 0.15 * (1.0 - math.log(1.8) / math.log(3.0))),
    ],
)
def test_navigation_reward_terms(state: dict[str, Any], reward: float, play: Any) -> None:
    step = play(ObstacleGoal(), {}, WORLD).step(**{"sensed": sense(), **state})
    assert step[0] == pytest.approx(reward)


@pytest.mark.parametrize(
    ("success", "time", "k", "score"),
    [
        (1.0, 1.0, 2.0, 0.5),  # faster than k * OT counts as k * OT
        (1.0, 30.0, 4.0, 5.0 / 30.0),
        (0.0, 20.0, 2.0, 0.0),
    ],
)
def test_barn_score_of_ten_metres(success: float, time: float, k: float, score: float) -> None:
    assert barn_score(success, time, 10.0, 2.0, k=k) == pytest.approx(score)


def test_barn_scores_when_it_reaches_the_goal(play: Any) -> None:
    barn = play(Barn(), {"world": 1}, "barn:2")
    for _ in range(200):
        barn.step(pose=(5.0, 0.0, 0.0), sensed=sense())
    assert [barn.episode.info()[name] for name in BARN_SCORES] == [0.0] * 4

    barn.step(pose=(9.1, 0.0, 0.0), sensed=sense())  # within BARN's metre
    info = barn.episode.info()
    length = barn.assignment.length
    assert 10.0 <= length <= 13.9
    scores = [barn_score(1.0, 20.1, length, speed, k=k) for speed in (2.0, 0.5) for k in (2.0, 4.0)]
    assert [info[name] for name in BARN_SCORES] == pytest.approx(scores)
    assert set(info) == {"goal_distance", "world", *BARN_SCORES}


@pytest.mark.parametrize(
    ("sensed", "share"),
    [
        (sense(), 0.0),
        (sense_person(0.46), 0.0),
        (sense_person(0.225, 2.0, 0.6), 0.5),
        (sense_person(-0.1), 1.0),
    ],
)
def test_crowding_in_the_personal_space_of_observed_people(
    sensed: Any, share: float, play: Any
) -> None:
    plain = play(ObstacleGoal(), {}, WORLD).step(sensed=sensed)[0]
    paid = play(Crowd(), {}, WORLD).step(sensed=sensed)[0]
    assert plain - paid == pytest.approx(Crowd.weights.crowding * share)


def test_collision_weight_of_dyna_barn(play: Any) -> None:
    free, hit = (
        play(DynaBarn(), {}, WORLD).step(sensed=sense(), contact=contact)[0]
        for contact in (False, True)
    )
    assert free - hit == pytest.approx(30.0)


def test_crowd_task_must_sense_people() -> None:
    blind = type("Blind", (Crowd,), {"id": "", "sensors": ("map", "lidar")})
    with pytest.raises(ConfigError, match=r"sensors = \('map', 'lidar'\): must name 'movers'"):
        RobotEnv(blind, link="planar")
