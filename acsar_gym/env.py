"""The Gymnasium environment: one class for simulation and hardware."""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies.base import Image
from acsar_gym.config import RobotConfig, whole_ratio
from acsar_gym.errors import AcsarError, CommandError, ConfigError, RenderError, suggestion
from acsar_gym.links import Link, open_link
from acsar_gym.robot import Robot
from acsar_gym.tasks import (
    OBSERVATION_LIMIT,
    Goal,
    Observation,
    Outcome,
    PointGoal,
    goal_distance,
    point_goal_reward,
)
from acsar_gym.worlds import Scene

Info = dict[str, Any]
IMAGE_SIZE = (640, 480)
"""Width and height of rgb_array [pixels]."""


def _goal_option(options: dict[str, Any]) -> Any:
    """The goal among the options of a reset; ConfigError for an unknown option."""
    for name in options:
        if name != "goal":
            raise ConfigError(f"unknown reset option {name!r}{suggestion(name, ['goal'])}")
    return options.get("goal")


def point_goal_spaces() -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Action and observation space of PointGoal, single or one row of many."""
    limit = OBSERVATION_LIMIT
    high = np.array([limit, 1, 1, limit, limit, 1, 1], np.float32)
    low = np.concatenate([np.zeros(1, np.float32), -high[1:]])
    action = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    return action, gymnasium.spaces.Box(low, high, dtype=np.float32)


class PointGoalEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Drive a four-wheel skid-steer robot to a point, seeing nothing but its odometry.

    ## Action space

    `Box(-1, 1, (2,), float32)`, held for one step (100 ms by default):

    | index | action | full scale |
    |---|---|---|
    | 0 | linear velocity, forward positive | `max_linear` of the robot, 0.5 m/s |
    | 1 | angular velocity, counter-clockwise positive | `max_angular` of the robot, 1.5 rad/s |

    Finite values outside are clipped; NaN, infinity or a wrong shape raise CommandError after the
    wheels have been commanded to stop.

    ## Observation space

    `Box((7,), float32)`, from odometry alone, in the odometry frame that starts at the robot:

    | index | observation | range |
    |---|---|---|
    | 0 | distance to the goal / largest goal distance | 0 to 2 |
    | 1, 2 | cosine and sine of the goal's bearing in the robot's frame | -1 to 1 |
    | 3 | linear velocity / `max_linear` | -2 to 2 |
    | 4 | angular velocity / `max_angular` | -2 to 2 |
    | 5, 6 | the last action | -1 to 1 |

    ## Reward

    Twice the metres gained on the goal, less 0.02 a step and 0.05 times the backward part of the
    action (sensors look ahead); +2 at the goal, -2 out of bounds.

    ## Start and end

    The robot stands at the origin of the odometry frame. The goal lies 0.5 to 3 m away in any
    direction; `reset(options={"goal": (x, y)})` sets it. The episode terminates when odometry says
    that the robot is within `goal_tolerance` of the goal (success) or twice the largest goal
    distance away from the start; it is truncated after 200 steps. On hardware, reset stops the
    robot, waits for standstill and sets the odometry to zero.

    ## Arguments

    - `link`: "bullet", "planar", a serial device such as "/dev/ttyUSB0", "socket://host:port",
      "replay:FILE", or a Link.
    - `robot`: a RobotConfig, a preset's name, or a .yaml or .urdf file; None is the ACSAR robot.
    - `goal_distance`: nearest and farthest goal [m]. `goal_tolerance` [m].
    - `policy_rate`: steps per second [Hz]; the robot's control rate must be a whole multiple.
    - `render_mode`: "rgb_array" (PyBullet's camera) or "human" (PyBullet's window), on "bullet".

    ## Info

    The same floats at every step: `goal_distance` [m] and `is_success` by odometry, `odom_x`,
    `odom_y`, `odom_theta`, `feedback_age` [s], and what only a simulator knows: `true_x`, `true_y`,
    `true_theta`, `true_goal_distance`, `true_contact`, and `odometry_error` [m], the distance
    between odometry and truth. Those are NaN on hardware.

    ## Version history

    - v0: first version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as gymnasium.Env declares it
        "render_modes": ["human", "rgb_array"],
        "render_fps": 10,
    }

    def __init__(
        self,
        link: str | Link = "bullet",
        robot: RobotConfig | str | Path | None = None,
        *,
        goal_distance: tuple[float, float] = (0.5, 3.0),
        goal_tolerance: float = 0.15,
        policy_rate: float = 10.0,
        render_mode: str | None = None,
    ) -> None:
        config = RobotConfig.of(robot)
        self.render_mode = render_mode
        self.task = PointGoal.of(goal_distance, goal_tolerance, config)
        self.ticks_per_step = whole_ratio(
            "control_rate", config.control_rate, "policy_rate", policy_rate
        )
        self.robot = Robot(self._link(link, config), config)
        self.action_space: Any
        self.observation_space: Any
        self.action_space, self.observation_space = point_goal_spaces()
        self._goal: Goal = (0.0, 0.0)
        self._last_action = (0.0, 0.0)
        self._distance = 0.0

    def _link(self, link: Any, config: RobotConfig) -> Link:
        if self.render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(
                f"render_mode = {self.render_mode!r}: must be None, human or rgb_array"
            )
        if self.render_mode is not None and isinstance(link, str) and link != "bullet":
            raise RenderError(f"link {link!r} has no camera; render_mode needs link='bullet'")
        if not isinstance(link, str | os.PathLike) and hasattr(link, "advance"):
            ready: Link = link
            return ready
        return open_link(link, config, window=self.render_mode == "human")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin an episode; opens the link the first time. `options={"goal": (x, y)}` in m."""
        self.robot.stop()
        super().reset(seed=seed)
        goal = _goal_option(options or {})
        self._goal = (
            self.task.sample_goal(self.np_random) if goal is None else self.task.check_goal(goal)
        )
        self.robot.reset(Scene(goal=self._goal))
        self._last_action = (0.0, 0.0)
        self._distance = goal_distance(self.robot.odometry.pose, self._goal)
        return self._observation(), self._info(Outcome.GOING)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, Info]:
        """Drive for one step of the policy; see the class for spaces, reward and end."""
        self._last_action = linear, angular = self._checked(action)
        self._drive(linear * self.task.max_linear, angular * self.task.max_angular)
        pose = self.robot.odometry.pose
        before, self._distance = self._distance, goal_distance(pose, self._goal)
        outcome = self.task.outcome(pose, self._goal)
        reward = point_goal_reward(before, self._distance, linear, outcome)
        terminated = outcome is not Outcome.GOING
        if terminated:
            self.robot.stop()
        return self._observation(), reward, terminated, False, self._info(outcome)

    def _drive(self, linear: float, angular: float) -> None:
        speeds = self.robot.wheel_speeds(linear, angular)
        for _ in range(self.ticks_per_step):
            self.robot.tick(speeds)

    def _checked(self, action: NDArray[np.float32]) -> tuple[float, float]:
        """The action as two floats in [-1, 1]; stops the wheels and raises for anything else."""
        try:
            linear, angular = np.asarray(action, np.float64).tolist()
            sound = math.isfinite(linear + angular)
        except (TypeError, ValueError, OverflowError):
            sound = False
        if not sound:
            self.robot.stop()
            raise CommandError(
                f"action = {action!r}: must be two finite numbers (linear, angular) in [-1, 1]"
            )
        return min(max(linear, -1.0), 1.0), min(max(angular, -1.0), 1.0)

    def _observation(self) -> Observation:
        odometry = self.robot.odometry
        return self.task.observe(odometry.pose, odometry.twist, self._goal, self._last_action)

    def _info(self, outcome: Outcome) -> Info:
        x, y, theta = self.robot.odometry.pose
        truth = self.robot.link.truth
        true_pose = truth.pose if truth else (math.nan, math.nan, math.nan)
        return {
            "goal_distance": self._distance,
            "is_success": float(outcome is Outcome.SUCCESS),
            "odom_x": x,
            "odom_y": y,
            "odom_theta": theta,
            "feedback_age": self.robot.feedback_age,
            "true_x": true_pose[0],
            "true_y": true_pose[1],
            "true_theta": true_pose[2],
            "true_goal_distance": goal_distance(true_pose, self._goal),
            "true_contact": float(truth.contact) if truth else math.nan,
            "odometry_error": math.hypot(true_pose[0] - x, true_pose[1] - y),
        }

    def render(self) -> Image | None:
        """PyBullet's camera as height x width x 3 uint8; the window draws itself."""
        if self.render_mode != "rgb_array":
            return None
        if not self.robot.active:
            raise RenderError("there is nothing to see before reset(): call it first")
        image = self.robot.link.image(*IMAGE_SIZE)
        if image is None:
            raise RenderError(
                "this link has no camera; render_mode='rgb_array' needs link='bullet'"
            )
        return image

    def close(self) -> None:
        """Stop the wheels and close the link; twice is once."""
        self.robot.deactivate()

    def __del__(self) -> None:
        robot = getattr(self, "robot", None)
        if robot is not None:
            with contextlib.suppress(AcsarError):
                robot.deactivate()
