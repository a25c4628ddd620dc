"""What a deployed policy may know beside its observations, and observations by name."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import PolicyError
from acsar_gym.policies.describing import scale_of
from acsar_gym.sensors import LIDAR
from acsar_gym.tasks import Observation
from acsar_gym.tasks.base import Floats
from acsar_gym.tasks.made import named
from acsar_gym.tasks.path import LENGTH_SCALE, LOOKAHEAD

if TYPE_CHECKING:
    from acsar_gym.envs.base import RobotEnv

GOAL = ("goal_distance", "goal_cos", "goal_sin")
PATH = ("cross_track_error", "heading_cos", "heading_sin", "remaining", "ahead_1", "left_1")
MOVING = ("linear_velocity", "angular_velocity")
"""Names of the numbers that a policy may need of a task's observation."""


@dataclass(frozen=True, slots=True)
class Seen:
    """One observation in SI units, in the base frame (x ahead, y to the left)."""

    linear: float
    """Velocity by odometry [m/s]."""
    angular: float
    """Yaw rate by odometry [rad/s]."""
    distance: float = math.nan
    """To the goal [m]; NaN without one."""
    bearing: float = math.nan
    """Of the goal, positive to the left [rad]."""
    ranges: Floats | None = None
    """(rays,): the newest scan [m]; None without a LiDAR."""
    cross_track: float = math.nan
    """Distance from the path [m], positive where the robot is to the left of it."""
    heading_error: float = math.nan
    """Heading minus the path's direction [rad]."""
    remaining: float = math.nan
    """Length of the path ahead [m]."""
    points: Floats | None = None
    """(4, 2): points of the path ahead [m]."""

    @property
    def goal(self) -> tuple[float, float]:
        """The goal (x, y) in the base frame [m]."""
        return self.distance * math.cos(self.bearing), self.distance * math.sin(self.bearing)


@dataclass(frozen=True)
class Setting:
    """Robot, period and layout of the observation: what a deployed policy may know."""

    config: RobotConfig
    task: str
    """Name of the task, for messages."""
    period: float
    """Time between two decisions [s]."""
    tolerance: float
    """Distance from the goal that counts as success [m]."""
    places: dict[str, int]
    """Index of each of the task's numbers in the observation."""
    scale: float | None
    """What distances are divided by [m]."""
    rays: slice | None
    """Where the LiDAR's ranges are in the observation; None without a LiDAR."""

    @classmethod
    def of(cls, env: RobotEnv) -> Setting:
        """Read the setting of an env."""
        config, task = env.robot.config, env.task
        first, rays = len(task.observation), None
        for sensor in env.sensors:
            if sensor.name == LIDAR:
                rays = slice(first, first + sensor.size)
            first += sensor.size
        return cls(
            config=config,
            task=named(task),
            period=env.ticks_per_step * config.period,
            tolerance=task.goal_tolerance,
            places={name: n for n, name in enumerate(task.observation)},
            scale=scale_of(task),
            rays=rays,
        )

    def need(self, policy: str, names: tuple[str, ...], what: str, instead: str) -> None:
        """Check that the task observes what a policy needs.

        Args:
            policy: its name.
            names: of the numbers that it needs; () for the LiDAR.
            what: what they are in words, such as "a path".
            instead: an env that has it.

        Raises:
            PolicyError: it doesn't.
        """
        found = all(name in self.places for name in names) if names else self.rays is not None
        if not found:
            raise PolicyError(
                f"{policy}: needs {what}, which {self.task} doesn't observe: use --env {instead}, "
                "or another policy"
            )

    def seen(self, observation: Observation) -> Seen:
        """Take an observation apart, and convert it to SI units."""
        numbers, config = observation.astype(np.float64), self.config
        at, scale = self.places, self.scale or 1.0
        told: dict[str, float | Floats | None] = {
            "linear": numbers[at["linear_velocity"]] * config.max_linear,
            "angular": numbers[at["angular_velocity"]] * config.max_angular,
        }
        if "goal_distance" in at:
            told["distance"] = numbers[at["goal_distance"]] * scale
            told["bearing"] = math.atan2(numbers[at["goal_sin"]], numbers[at["goal_cos"]])
        if "cross_track_error" in at:
            told["cross_track"] = numbers[at["cross_track_error"]] * scale
            told["heading_error"] = math.atan2(
                numbers[at["heading_sin"]], numbers[at["heading_cos"]]
            )
            told["remaining"] = numbers[at["remaining"]] * LENGTH_SCALE
            first = at["ahead_1"]
            told["points"] = numbers[first : first + 2 * LOOKAHEAD].reshape(LOOKAHEAD, 2)
        if self.rays is not None:
            told["ranges"] = numbers[self.rays] * config.lidar.max_range
        return Seen(**told)  # type: ignore[arg-type]  # its own fields
