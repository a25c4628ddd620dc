"""Tasks with a goal behind obstacles: a cluttered floor, or the worlds of BARN.

The robot sees with a LiDAR and remembers in a map what it has seen. Reward counts the way to the
goal over that map, so that turning back in a dead end pays.

The score of the BARN challenge (Xiao et al., ICRA 2022) for one run is

    score = success * OT / clip(AT, k * OT, 8 * OT)

OT, the optimal time, is the length of the world's own path divided by a reference speed. AT is
the time that the run took.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from acsar_gym.jit import compilable
from acsar_gym.sensors import MAP
from acsar_gym.sensors.map.sensor import (
    FARTHEST_CLEARANCE,
    FIRST_SECTOR,
    GAINED,
    SECTORS,
    SLIDE_ACCELERATION,
    STALLED,
    log_share,
)
from acsar_gym.tasks.goal import GoalTask, goal_distance
from acsar_gym.tasks.options import store_positive
from acsar_gym.tasks.state import State
from acsar_gym.tasks.task import Outcome, end_reward

BARN_TOLERANCE = 1.0
"""A run is a success once odometry is this close to the goal [m]."""
CHALLENGE_SPEED = 2.0
"""Reference speed of the challenge [m/s]."""
BARN_SCORES = ("barn_score", "barn_score_k4", "barn_score_own", "barn_score_own_k4")
"""Names of the four scores in info: k = 2 (since 2024) and k = 4 (2022), each with the
challenge's reference speed of 2 m/s and with the robot's own top speed."""


@compilable
def barn_score(success: float, time: float, length: float, speed: float, k: float) -> float:
    """Compute the score of one run.

    Args:
        success: 1 for a run that reached the goal, otherwise 0.
        time: Duration of the run [s].
        length: Length of the world's own path from start to goal [m]. NaN if it has none.
        speed: Reference speed of the optimal time [m/s].
        k: Runs faster than k times the optimal time have the same score.

    Returns:
        0 to 1 / k. NaN if `length` is NaN.
    """
    optimal = length / speed
    if math.isnan(optimal):
        return optimal
    # A success scores at least 1/8, however slow, and at most 1/k, however fast.
    return success * optimal / min(max(time, k * optimal), 8.0 * optimal)


NEAR_SHARE = log_share(0.5, FARTHEST_CLEARANCE)
"""Less clearance than this costs reward: half a radius of the footprint, as the map observes it."""


class NavigationWeights(NamedTuple):
    """Weights of `navigation_reward`."""

    progress: float = 0.1
    """Reward for shortening the way to the goal, by the robot's map, by as much in a step as the
    top speed would."""
    time: float = 0.04
    """Cost of a step."""
    near: float = 0.15
    """Cost of touching something. It falls to 0 at a clearance of half the footprint's radius."""
    backwards: float = 0.05
    """Cost of the backward part of the action, because sensors look ahead."""
    slide: float = 0.1
    """Cost of each m/s^2 of acceleration sideways above 0.7 m/s^2, up to 2 m/s^2, because tyres
    slide there and odometry drifts."""
    stalled: float = 0.1
    """Cost of 50 steps in which the way doesn't become shorter. It grows from 0 until then."""
    success: float = 5.0
    """Reward at the goal."""
    collision: float = 15.0
    """Cost of a collision. It is more than the goal pays, so that haste isn't worth the risk."""


class NavigationTask(GoalTask):
    """Base of the tasks with a goal behind obstacles, which the robot sees with a LiDAR."""

    sensors: tuple[Any, ...] = ("map", "lidar")
    needs: ClassVar[tuple[str, ...]] = (MAP,)
    memory: ClassVar[Mapping[str, float]] = {"goal_distance": 0.0}
    told: ClassVar[tuple[str, ...] | None] = ("goal_distance",)
    compiled = True
    weights: Any = NavigationWeights()

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Reward of the step, see `navigation_reward`."""
        memory.goal_distance = goal_distance(state.pose, state.goal)
        return navigation_reward(state, outcome, self.weights)


@dataclass(frozen=True, kw_only=True)
class ObstacleGoal(NavigationTask):
    """Reach a point among obstacles, with a LiDAR.

    Example:
        >>> from acsar_gym import RobotEnv
        >>> from acsar_gym.tasks import ObstacleGoal
        >>> env = RobotEnv(ObstacleGoal, link="planar", worlds="open:2", weights={"near": 0.3})
        >>> env.reset(seed=0)[1]["true_contact"]
        0.0
        >>> env.close()
    """

    id = "acsar_gym/ObstacleGoal-v1"
    worlds = "clutter:train"
    goal_tolerance: float = 0.3
    """Radius of the goal [m]."""

    def __post_init__(self) -> None:
        store_positive(self, "goal_tolerance")


class Barn(NavigationTask):
    """Drive 10 m through a field of cylinders (BARN), with a LiDAR. Info has the score.

    Example:
        >>> from acsar_gym import RobotEnv
        >>> from acsar_gym.tasks import Barn
        >>> env = RobotEnv(Barn, link="planar", worlds="barn:2")
        >>> env.reset(seed=0)[1]["barn_score"]
        0.0
        >>> env.close()
    """

    id = "acsar_gym/Barn-v1"
    worlds = "barn:train"
    goal_tolerance = BARN_TOLERANCE
    memory: ClassVar[Mapping[str, float]] = {
        **NavigationTask.memory,
        **dict.fromkeys(BARN_SCORES, 0.0),
    }
    told: ClassVar[tuple[str, ...] | None] = ("goal_distance", *BARN_SCORES)
    compiled = True

    def begin(self, state: State, memory: Any) -> None:
        """Remember the distance to the goal. The scores are zero until it is reached."""
        memory.goal_distance = goal_distance(state.pose, state.goal)
        store_scores(state, memory, 0)

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Reward of the step, see `navigation_reward`. Remembers the scores."""
        memory.goal_distance = goal_distance(state.pose, state.goal)
        store_scores(state, memory, outcome)
        return navigation_reward(state, outcome, self.weights)


# The functions below are compiled for batches, too.


@compilable
def navigation_reward(state: State, outcome: int, weights: Any) -> float:
    """Compute the reward of a step towards a goal behind obstacles.

    Args:
        state: State after the step. `sensed` begins with the numbers of the map.
        outcome: Number of the step's Outcome.
        weights: Weights of the terms, with the names of `NavigationWeights`.
    """
    # Only the smallest clearance costs, and none above NEAR_SHARE.
    clearance = NEAR_SHARE
    for sector in range(FIRST_SECTOR, FIRST_SECTOR + SECTORS):
        # Sensed numbers are float32: without `float` only compiled code would use float64.
        clearance = min(clearance, float(state.sensed[sector]))
    nearness = 1.0 - clearance / NEAR_SHARE

    # Speed times turn rate is the acceleration sideways.
    slide = max(abs(state.twist[0] * state.twist[1]) - SLIDE_ACCELERATION, 0.0)

    costs = weights.time + weights.near * nearness - weights.backwards * min(state.action[0], 0.0)
    costs += weights.slide * min(slide, 2.0) + weights.stalled * float(state.sensed[STALLED])
    end = end_reward(outcome, weights.success, weights.collision)
    reward: float = weights.progress * float(state.sensed[GAINED]) - costs + end
    return reward


@compilable
def store_scores(state: State, memory: Any, outcome: int) -> None:
    """Write BARN's scores of the run so far into the memory. Zeros without success."""
    success = 1.0 if outcome == Outcome.SUCCESS else 0.0
    time = state.time
    length = state.length
    top_speed = state.max_twist[0]
    memory.barn_score = barn_score(success, time, length, CHALLENGE_SPEED, 2.0)
    memory.barn_score_k4 = barn_score(success, time, length, CHALLENGE_SPEED, 4.0)
    memory.barn_score_own = barn_score(success, time, length, top_speed, 2.0)
    memory.barn_score_own_k4 = barn_score(success, time, length, top_speed, 4.0)
