"""A task as a user would write it, compiled and plain, to measure what it costs in a batch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from acsar_gym.tasks import Outcome, State, Task


@dataclass(frozen=True)
class SmoothGoal(Task):
    """Reach a point of an open floor without turning more than needed."""

    weight: float = 0.2
    observation: ClassVar[Mapping[str, tuple[float, float]]] = {
        "ahead": (-20.0, 20.0),
        "left": (-20.0, 20.0),
        "linear": (-2.0, 2.0),
        "angular": (-4.0, 4.0),
    }
    memory: ClassVar[Mapping[str, float]] = {"distance": 0.0, "turned": 0.0, "before": 0.0}
    compiled = True

    def begin(self, state: State, memory: Any) -> None:
        """Note the distance to the goal."""
        memory.distance = math.hypot(state.goal[0], state.goal[1])

    def outcome(self, state: State, memory: Any) -> Outcome:
        """Success within the tolerance."""
        dx, dy = state.goal[0] - state.pose[0], state.goal[1] - state.pose[1]
        return Outcome.SUCCESS if math.hypot(dx, dy) < self.goal_tolerance else Outcome.GOING

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Metres gained, less changes of the action and turns that weren't asked for."""
        dx, dy = state.goal[0] - state.pose[0], state.goal[1] - state.pose[1]
        before, memory.distance = memory.distance, math.hypot(dx, dy)
        change, memory.before = abs(state.action[1] - memory.before), state.action[1]
        memory.turned += abs(state.twist[1]) * state.period
        lag = abs(state.sent[1] - state.twist[1])
        worth: float = before - memory.distance - self.weight * change - 0.01 * lag
        return worth

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """The goal in the robot's frame, and its velocities."""
        x, y, theta = state.pose
        dx, dy = state.goal[0] - x, state.goal[1] - y
        cos, sin = math.cos(theta), math.sin(theta)
        return dx * cos + dy * sin, dy * cos - dx * sin, state.twist[0], state.twist[1]


class PlainSmoothGoal(SmoothGoal):
    """The same in plain Python."""

    compiled = False
