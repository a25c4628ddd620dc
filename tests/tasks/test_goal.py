"""Goals, observation, reward and end: pure functions, no env needed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym.bodies.base import GroundTruth
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.tasks import ObstacleGoal, Outcome, PointGoal, State
from acsar_gym.tasks.goal import GOAL_LAYOUT, GoalCourse, goal_distance, goal_reward
from acsar_gym.worlds import Pose, Region, World
from acsar_gym.worlds.pool import Pool

ACSAR = RobotConfig.preset("acsar")
TASK = PointGoal.of((0.5, 3.0), 0.15, ACSAR)
coordinate = st.floats(-20.0, 20.0)
angle = st.floats(-math.pi, math.pi)


def course(goal: object = (2.0, 0.0)) -> GoalCourse:
    return TASK.begin(np.random.default_rng(0), {"goal": goal})


def drawn(seed: int) -> tuple[float, float]:
    return TASK.begin(np.random.default_rng(seed), {}).assignment.goal


def state(pose: Pose, **known: object) -> State:
    fields = {"twist": (0.25, -0.75), "action": (0.5, -0.5), **known}
    return State(pose, **fields)  # type: ignore[arg-type]


def observed(pose: Pose) -> dict[str, float]:
    return dict(zip(GOAL_LAYOUT, course().observe(state(pose)), strict=True))


def test_a_goal_straight_ahead() -> None:
    assert observed((0.0, 0.0, 0.0)) == pytest.approx(
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
    seen = observed((0.0, 0.0, -math.pi / 2.0))
    assert (seen["goal_cos"], seen["goal_sin"]) == pytest.approx((0.0, 1.0), abs=1e-6)


@given(coordinate, coordinate, angle, coordinate, coordinate)
def test_observations_stay_in_their_bounds(
    x: float, y: float, theta: float, linear: float, angular: float
) -> None:
    values = course().observe(state((x, y, theta), twist=(linear, angular), action=(1.0, -1.0)))
    assert len(values) == len(GOAL_LAYOUT)
    assert all(
        low <= v <= high for low, v, high in zip(TASK.low(), values, TASK.high(), strict=True)
    )
    assert math.hypot(values[1], values[2]) == pytest.approx(1.0, abs=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_goals_are_in_range_and_repeat_with_the_seed(seed: int) -> None:
    assert TASK.min_distance <= math.hypot(*drawn(seed)) <= TASK.max_distance
    assert drawn(seed) == drawn(seed)


def test_goals_come_from_all_sides() -> None:
    rng = np.random.default_rng(0)
    goals = [TASK.begin(rng, {}).assignment.goal for _ in range(1000)]
    counts, _ = np.histogram([math.atan2(y, x) for x, y in goals], 8, (-math.pi, math.pi))
    assert counts.min() > 80


@pytest.mark.parametrize("goal", [(0.1, 0.0), (3.0, 3.0)])
def test_goals_out_of_range_name_the_range(goal: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match=r"0\.5 to 3 m"):
        course(goal)


@pytest.mark.parametrize("goal", [(1.0,), "ab", 7, (1.0, 2.0, 3.0), (math.nan, 1.0)])
def test_goals_that_are_no_points_say_so(goal: object) -> None:
    with pytest.raises(ConfigError, match="two finite numbers"):
        course(goal)


@pytest.mark.parametrize("limits", [(0.1, 3.0), (4.0, 3.0), (1.0, math.inf)])
def test_limits_that_make_no_sense_are_refused(limits: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match="tolerance"):
        PointGoal.of(limits, 0.15, ACSAR)


@pytest.mark.parametrize(
    ("x", "outcome"),
    [(0.86, Outcome.SUCCESS), (0.84, Outcome.GOING), (-6.1, Outcome.OUT_OF_BOUNDS)],
)
def test_the_end_is_decided_by_distance(x: float, outcome: Outcome) -> None:
    assert course((1.0, 0.0)).judge(state((x, 0.0, 0.0)))[1] is outcome


def test_contact_is_a_collision_even_at_the_goal() -> None:
    touched = GroundTruth(contact=True)
    assert course().judge(state((2.0, 0.0, 0.0), truth=touched))[1] is Outcome.COLLISION
    unseen = course().judge(state((2.0, 0.0, 0.0), truth=None))
    assert unseen[1] is Outcome.SUCCESS


def test_reward_pays_for_progress_and_arrival() -> None:
    step = goal_reward(1.0, 0.9, 1.0, 0, 2.0)
    assert step == pytest.approx(0.18)
    assert goal_reward(1.0, 0.9, 1.0, 1, 2.0) == pytest.approx(step + 2.0)
    assert goal_reward(1.0, 0.9, 1.0, 2, 2.0) == pytest.approx(step - 2.0)
    assert goal_reward(1.0, 0.9, 1.0, 3, 5.0) == pytest.approx(step - 5.0)
    assert goal_reward(1.0, 1.0, 0.0, 0, 2.0) < 0.0


def test_the_same_progress_pays_less_backwards() -> None:
    forwards = goal_reward(1.0, 0.9, 1.0, 0, 2.0)
    assert goal_reward(1.0, 0.9, -1.0, 0, 2.0) == pytest.approx(forwards - 0.05)


@given(coordinate, coordinate, coordinate, coordinate)
def test_distance_is_the_straight_line(x: float, y: float, gx: float, gy: float) -> None:
    assert goal_distance((x, y, 0.3), (gx, gy)) == pytest.approx(math.dist((x, y), (gx, gy)))


def test_a_goal_of_a_world_is_seen_from_its_start() -> None:
    world = World(start=Region(1.0, 2.0, 0.0, math.pi / 2.0), goal=Region(1.0, 5.0))
    task = ObstacleGoal.of(Pool.of(world), 0.3, ACSAR)
    assignment = task.begin(np.random.default_rng(0), {}).assignment
    assert assignment.goal == pytest.approx((3.0, 0.0))
    assert assignment.number == 0
    assert assignment.world is not None
    assert assignment.start == (1.0, 2.0, math.pi / 2.0)
    assert (assignment.world.start.x, assignment.world.start.y) == (1.0, 2.0)


@pytest.mark.parametrize("tolerance", [0.0, -1.0, math.nan, "wide"])
def test_a_bad_tolerance_is_refused(tolerance: float) -> None:
    with pytest.raises(ConfigError, match="goal_tolerance"):
        ObstacleGoal.of(Pool.of("open"), tolerance, ACSAR)
