"""Goals, observation, reward and end: pure functions, no env needed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym.errors import ConfigError
from acsar_gym.tasks import POINT_GOAL_LAYOUT, Outcome, PointGoal, goal_distance, point_goal_reward

TASK = PointGoal()
coordinate = st.floats(-20.0, 20.0)
angle = st.floats(-math.pi, math.pi)


def observed(**known: float) -> dict[str, float]:
    pose = (known.get("x", 0.0), known.get("y", 0.0), known.get("theta", 0.0))
    values = TASK.observe(pose, (0.25, -0.75), (2.0, 0.0), (0.5, -0.5))
    return dict(zip(POINT_GOAL_LAYOUT, values.tolist(), strict=True))


def test_a_goal_straight_ahead() -> None:
    assert observed() == pytest.approx(
        {
            "goal_distance": 2.0 / 3.0,
            "goal_cos": 1.0,
            "goal_sin": 0.0,
            "linear_velocity": 0.5,
            "angular_velocity": -0.5,
            "last_linear": 0.5,
            "last_angular": -0.5,
        }
    )


def test_a_goal_to_the_left_has_a_positive_sine() -> None:
    seen = observed(theta=-math.pi / 2.0)
    assert (seen["goal_cos"], seen["goal_sin"]) == pytest.approx((0.0, 1.0), abs=1e-6)


@given(coordinate, coordinate, angle, coordinate, coordinate)
def test_observations_stay_in_their_bounds(
    x: float, y: float, theta: float, linear: float, angular: float
) -> None:
    values = TASK.observe((x, y, theta), (linear, angular), (1.0, -1.0), (1.0, -1.0))
    assert values.shape == (len(POINT_GOAL_LAYOUT),)
    assert values.dtype == np.float32
    assert np.abs(values).max() <= 2.0
    assert np.hypot(values[1], values[2]) == pytest.approx(1.0, abs=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_goals_are_in_range_and_repeat_with_the_seed(seed: int) -> None:
    goal = TASK.sample_goal(np.random.default_rng(seed))
    assert TASK.min_distance <= math.hypot(*goal) <= TASK.max_distance
    assert TASK.sample_goal(np.random.default_rng(seed)) == goal


def test_goals_come_from_all_sides() -> None:
    rng = np.random.default_rng(0)
    bearings = [math.atan2(y, x) for x, y in (TASK.sample_goal(rng) for _ in range(1000))]
    counts, _ = np.histogram(bearings, bins=8, range=(-math.pi, math.pi))
    assert counts.min() > 80


@pytest.mark.parametrize("goal", [(0.1, 0.0), (3.0, 3.0), (math.nan, 1.0)])
def test_goals_out_of_range_name_the_range(goal: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match=r"0\.5 to 3 m"):
        TASK.check_goal(goal)


@pytest.mark.parametrize("goal", [(1.0,), "ab", None, (1.0, 2.0, 3.0)])
def test_goals_that_are_no_points_say_so(goal: object) -> None:
    with pytest.raises(ConfigError, match="two numbers"):
        TASK.check_goal(goal)  # type: ignore[arg-type]


@pytest.mark.parametrize("limits", [(0.1, 3.0), (4.0, 3.0), (1.0, math.inf)])
def test_limits_that_make_no_sense_are_refused(limits: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match="tolerance"):
        PointGoal(*limits)


def test_the_end_is_decided_by_distance() -> None:
    goal = (1.0, 0.0)
    assert TASK.outcome((0.86, 0.0, 0.0), goal) is Outcome.SUCCESS
    assert TASK.outcome((0.84, 0.0, 0.0), goal) is Outcome.GOING
    assert TASK.outcome((-6.1, 0.0, 0.0), goal) is Outcome.OUT_OF_BOUNDS


def test_reward_pays_for_progress_and_arrival() -> None:
    step = point_goal_reward(1.0, 0.9, 1.0, Outcome.GOING)
    assert step == pytest.approx(0.18)
    assert point_goal_reward(1.0, 0.9, 1.0, Outcome.SUCCESS) == pytest.approx(step + 2.0)
    assert point_goal_reward(1.0, 0.9, 1.0, Outcome.OUT_OF_BOUNDS) == pytest.approx(step - 2.0)
    assert point_goal_reward(1.0, 1.0, 0.0, Outcome.GOING) < 0.0


def test_the_same_progress_pays_less_backwards() -> None:
    forwards = point_goal_reward(1.0, 0.9, 1.0, Outcome.GOING)
    assert point_goal_reward(1.0, 0.9, -1.0, Outcome.GOING) == pytest.approx(forwards - 0.05)


@given(coordinate, coordinate, coordinate, coordinate)
def test_distance_is_the_straight_line(x: float, y: float, gx: float, gy: float) -> None:
    assert goal_distance((x, y, 0.3), (gx, gy)) == pytest.approx(math.dist((x, y), (gx, gy)))
