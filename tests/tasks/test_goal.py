"""Goals, observation, reward and end of PointGoal: no env needed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.tasks import Outcome, PointGoal
from acsar_gym.tasks.episode import Spawn

ACSAR = RobotConfig.preset("acsar")
TASK = PointGoal()


@pytest.mark.parametrize(("theta", "cos", "sin"), [(0.0, 1.0, 0.0), (-math.pi / 2.0, 0.0, 1.0)])
def test_observe_a_goal_ahead_and_a_goal_to_the_left(
    theta: float, cos: float, sin: float, play: Any
) -> None:
    observation = play(TASK, {"goal": (2.0, 0.0)}).seen(
        pose=(0.0, 0.0, theta), twist=(0.25, -0.75), action=(0.5, -0.5)
    )
    expected = [2.0 / 3.0, cos, sin, 0.5, -0.5, 0.5, -0.5]
    assert list(observation.values()) == pytest.approx(expected, abs=1e-6)


def test_spawn_goals_are_on_all_sides() -> None:
    rng = np.random.default_rng(0)
    spawn = Spawn(TASK, None, None, ACSAR)
    goals = np.array([spawn.draw(rng, {}).goal for _ in range(1000)])
    distances = np.hypot(*goals.T)
    assert 0.5 <= distances.min() <= distances.max() <= 3.0
    counts, _ = np.histogram(np.arctan2(goals[:, 1], goals[:, 0]), 8, (-math.pi, math.pi))
    assert counts.min() > 80


@pytest.mark.parametrize(
    ("fields", "name"),
    [
        ({"goal_distance": (0.1, 3.0)}, "goal_tolerance"),
        ({"goal_distance": (1.0, math.inf)}, "goal_distance"),
    ],
)
def test_point_goal_refuses_limits_that_make_no_sense(fields: dict[str, Any], name: str) -> None:
    with pytest.raises(ConfigError, match=f"^{name} = "):
        PointGoal(**fields)


@pytest.mark.parametrize(
    ("x", "contact", "outcome"),
    [
        (0.86, False, Outcome.SUCCESS),
        (0.84, False, Outcome.GOING),
        (-6.1, False, Outcome.OUT_OF_BOUNDS),
        (1.0, True, Outcome.COLLISION),
    ],
)
@pytest.mark.parametrize(("linear", "cost"), [(1.0, 0.02), (-1.0, 0.07)])
def test_reward_and_outcome_follow_from_distance_and_contact(
    x: float, contact: bool, outcome: Outcome, linear: float, cost: float, play: Any
) -> None:
    reward, ended = play(TASK, {"goal": (1.0, 0.0)}).step(
        pose=(x, 0.0, 0.0), contact=contact, action=(linear, 0.0)
    )
    assert ended is outcome
    end = {Outcome.GOING: 0.0, Outcome.SUCCESS: 2.0}.get(outcome, -2.0)
    progress = 1.0 - abs(1.0 - x)
    assert reward == pytest.approx(2.0 * progress - cost + end)
