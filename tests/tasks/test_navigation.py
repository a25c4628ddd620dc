"""Tasks with a goal behind obstacles: what they pay and tell, and BARN's score."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from task_tools import ACSAR, Played

from acsar_gym.sensors.map.sensor import FARTHEST_CLEARANCE, GAINED, MAP_NAMES, STALLED, log_share
from acsar_gym.tasks import Barn, ObstacleGoal
from acsar_gym.tasks.navigation import BARN_SCORES, CHALLENGE_SPEED, barn_score
from acsar_gym.worlds import Region, World

WORLD = World(start=Region(0.0, 0.0, 0.0, 0.0), goal=Region(4.0, 0.0))


def told(gained: float = 0.0, *clearances: float, stalled: float = 0.0) -> Any:
    """What the map adds to the observation: clearances in radii of the footprint, and far ones."""
    sensed = np.ones(len(MAP_NAMES) + 64)
    sensed[GAINED], sensed[STALLED] = gained, stalled
    for sector, clearance in enumerate(clearances):
        place = MAP_NAMES.index(f"clearance_{47 - 10 * sector}")
        sensed[place] = log_share(clearance, FARTHEST_CLEARANCE)
    sensed[len(MAP_NAMES) :] = 0.0  # the LiDAR's own numbers pay nothing
    return sensed


def paid(sensed: Any = None, **known: Any) -> float:
    """Reward of one step."""
    episode = Played(ObstacleGoal(), {}, WORLD)
    return episode.step(sensed=told() if sensed is None else sensed, **known)[0]


@pytest.mark.parametrize(
    ("known", "expected"),
    [
        ({}, -0.04),
        ({"sensed": told(1.0)}, 0.06),
        ({"pose": (1.0, 0.0, 0.0)}, -0.04),  # nearer in a straight line, but not along the way
        ({"action": (1.0, -1.0)}, -0.04),
        ({"action": (-1.0, 0.0)}, -0.09),
        ({"contact": True}, -15.04),
        ({"sensed": told(stalled=0.4)}, -0.08),
        ({"twist": (0.5, 1.4)}, -0.04),
        ({"twist": (1.0, -1.5)}, -0.12),  # it slides
        ({"pose": (3.8, 0.0, 0.0)}, 4.96),
        ({"sensed": told(0.0, 0.0)}, -0.19),
        ({"sensed": told(0.0, 3.0, 0.2)}, -0.04 - 0.15 * (1.0 - math.log(1.8) / math.log(3.0))),
    ],
)
def test_reward_pays_for_the_way_and_for_arrival_and_costs_little_clearance(
    known: dict[str, Any], expected: float
) -> None:
    assert paid(**known) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("time", "k", "expected"),
    [
        (1.0, 2.0, 0.5),  # faster than k * OT counts as k * OT
        (20.0, 2.0, 0.25),
        (40.0, 2.0, 0.125),
        (30.0, 4.0, 5.0 / 30.0),
    ],
)
def test_barns_score_of_ten_metres(time: float, k: float, expected: float) -> None:
    assert barn_score(1.0, time, 10.0, 2.0, k) == pytest.approx(expected)
    assert barn_score(0.0, time, 10.0, 2.0, k) == 0.0


def test_an_episode_scores_when_it_reaches_the_goal() -> None:
    played = Played(Barn(), {"world": 1}, "barn:2")
    for _ in range(200):
        played.step(pose=(5.0, 0.0, 0.0), sensed=told())
    assert [played.episode.info()[name] for name in BARN_SCORES] == [0.0] * 4
    played.step(pose=(9.1, 0.0, 0.0), sensed=told())  # within BARN's metre
    length = played.assignment.length
    assert 10.0 <= length <= 13.9
    assert [played.episode.info()[name] for name in BARN_SCORES] == pytest.approx(
        [
            barn_score(1.0, 20.1, length, speed, k)
            for speed in (CHALLENGE_SPEED, ACSAR.max_linear)
            for k in (2.0, 4.0)
        ]
    )
    assert set(played.episode.info()) == {"goal_distance", "world", *BARN_SCORES}
