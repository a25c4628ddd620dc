"""Goals, observation, reward and end: pure functions, no env needed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from task_tools import ACSAR, Played

from acsar_gym.errors import ConfigError
from acsar_gym.tasks import Outcome, PointGoal
from acsar_gym.tasks.episode import Spawn
from acsar_gym.tasks.goal import goal_reward
from acsar_gym.worlds import Pose

TASK = PointGoal()
coordinate = st.floats(-20.0, 20.0)
angle = st.floats(-math.pi, math.pi)


def played(goal: object = (2.0, 0.0)) -> Played:
    return Played(TASK, {"goal": goal})


def drawn(rng: np.random.Generator) -> tuple[float, float]:
    return Spawn(TASK, None, None, ACSAR).draw(rng, {}).goal


def observed(pose: Pose) -> dict[str, float]:
    return played().seen(pose=pose, twist=(0.25, -0.75), action=(0.5, -0.5))


def test_a_goal_straight_ahead_and_one_to_the_left() -> None:
    expected = {
        "goal_distance": 2.0 / 3.0,
        "goal_cos": 1.0,
        "goal_sin": 0.0,
        "linear_velocity": 0.5,
        "angular_velocity": -0.5,
        "last_linear": 0.5,
        "last_angular": -0.5,
    }
    assert observed((0.0, 0.0, 0.0)) == pytest.approx(expected)
    expected |= {"goal_cos": 0.0, "goal_sin": 1.0}
    assert observed((0.0, 0.0, -math.pi / 2.0)) == pytest.approx(expected, abs=1e-6)


@given(coordinate, coordinate, angle, coordinate, coordinate)
def test_observations_stay_in_their_bounds(
    x: float, y: float, theta: float, linear: float, angular: float
) -> None:
    seen = played().seen(pose=(x, y, theta), twist=(linear, angular), action=(1.0, -1.0))
    for name, (low, high) in TASK.observation.items():
        assert low <= seen[name] <= high
    assert math.hypot(seen["goal_cos"], seen["goal_sin"]) == pytest.approx(1.0, abs=1e-6)


def test_goals_come_from_all_sides_in_range_and_repeat_with_the_seed() -> None:
    rng, again = np.random.default_rng(0), np.random.default_rng(0)
    goals = [drawn(rng) for _ in range(1000)]
    assert goals == [drawn(again) for _ in range(1000)]
    assert all(0.5 <= math.hypot(*goal) <= 3.0 for goal in goals)
    counts, _ = np.histogram([math.atan2(y, x) for x, y in goals], 8, (-math.pi, math.pi))
    assert counts.min() > 80


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"goal_distance": (0.1, 3.0)}, "goal_tolerance"),
        ({"goal_distance": (1.0, math.inf)}, "goal_distance"),
        ({"goal_tolerance": -1.0}, "goal_tolerance"),
    ],
)
def test_limits_that_make_no_sense_are_refused(fields: dict[str, object], named: str) -> None:
    with pytest.raises(ConfigError, match=f"^{named} = "):
        PointGoal(**fields)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("x", "contact", "outcome"),
    [
        (0.86, False, Outcome.SUCCESS),
        (0.84, False, Outcome.GOING),
        (-6.1, False, Outcome.OUT_OF_BOUNDS),
        (1.0, True, Outcome.COLLISION),
    ],
)
def test_the_end_is_decided_by_distance_and_contact(
    x: float, contact: bool, outcome: Outcome
) -> None:
    assert played((1.0, 0.0)).step(pose=(x, 0.0, 0.0), contact=contact)[1] is outcome


def test_reward_pays_for_progress_and_arrival_and_less_backwards() -> None:
    step = goal_reward(1.0, 0.9, 1.0, 0, 2.0)
    assert step == pytest.approx(0.18)
    assert goal_reward(1.0, 0.9, 1.0, 1, 2.0) == pytest.approx(step + 2.0)
    assert goal_reward(1.0, 0.9, 1.0, 2, 2.0) == pytest.approx(step - 2.0)
    assert goal_reward(1.0, 0.9, 1.0, 3, 5.0) == pytest.approx(step - 5.0)
    assert goal_reward(1.0, 0.9, -1.0, 0, 2.0) == pytest.approx(step - 0.05)
