"""The Gymnasium environment: one class for all tasks, in simulation and on hardware."""

from __future__ import annotations

import contextlib
import copy
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Self

import gymnasium
import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies import display
from acsar_gym.bodies.base import GroundTruth, Image
from acsar_gym.config import RobotConfig, RobotSource, whole_ratio
from acsar_gym.errors import (
    AcsarError,
    BoardGarbledError,
    BoardSilentError,
    CommandError,
    ConfigError,
    LidarError,
    LinkError,
    LinkLostError,
    RenderError,
    shown,
)
from acsar_gym.lidars.base import Lidar, Scan, open_lidar, stale_after
from acsar_gym.links import Link, open_link
from acsar_gym.links.fault_injection import FaultyLink
from acsar_gym.links.faults import Faults
from acsar_gym.render.renderer import Screen
from acsar_gym.robot import Robot
from acsar_gym.tasks import Course, Observation, Outcome, State, Task
from acsar_gym.tasks.spaces import task_spaces
from acsar_gym.vector.specs import PlainSpec
from acsar_gym.worlds import Pose, Scene
from acsar_gym.worlds.scene import point_in_world, to_odometry

Info = dict[str, Any]
NOWHERE: Pose = (math.nan, math.nan, math.nan)
"""The true pose where nothing knows it."""


def _faulty(link: Link, faults: Faults) -> FaultyLink | None:
    """The link with faults of its own; None where nothing can go wrong."""
    return FaultyLink(link, faults) if faults.possible else None


def _truncates(on_fault: str) -> bool:
    if not isinstance(on_fault, str) or on_fault not in ("raise", "truncate"):
        raise ConfigError(f"on_fault = {shown(on_fault)}: must be raise or truncate")
    return on_fault == "truncate"


def fault_code(error: LinkError) -> int:
    """A number for what went wrong: 1 silent, 2 garbled, 3 link lost, 4 LiDAR, 5 anything else."""
    kinds = (BoardGarbledError, 2), (BoardSilentError, 1), (LinkLostError, 3), (LidarError, 4)
    return next((code for kind, code in kinds if isinstance(error, kind)), 5)


class RobotEnv(PlainSpec, gymnasium.Env[Observation, NDArray[np.float32]]):
    """A four-wheel skid-steer robot with a task; `acsar_gym.envs` has the manuals of the ids."""

    metadata: dict[str, Any] = {  # noqa: RUF012 - as gymnasium.Env declares it
        "render_modes": ["human", "rgb_array"],
        "render_fps": 10,
    }

    def __init__(
        self,
        task: Callable[[RobotConfig], Task],
        link: str | Link = "bullet",
        robot: RobotSource = None,
        *,
        lidar: str | Lidar | None = None,
        policy_rate: float = 10.0,
        render_mode: str | None = None,
        view: str = "top",
        faults: Mapping[str, Any] | Faults | None = None,
        on_fault: str = "truncate",
    ) -> None:
        config = RobotConfig.of(robot)
        self.render_mode = render_mode
        self.ticks_per_step = whole_ratio(
            "control_rate", config.control_rate, "policy_rate", policy_rate
        )
        self.task = task(config)
        self._check_rendering(link, view)
        wire = self._link(link, config)
        self._faulty = _faulty(wire, Faults.of(faults))
        self._truncates = _truncates(on_fault)
        self.robot = Robot(self._faulty or wire, config)
        if lidar is not None and not self.task.sees:
            raise ConfigError(f"lidar = {shown(lidar)}: {self.task.id} uses none")
        self.lidar = open_lidar(lidar, self.robot.link, config) if self.task.sees else None
        self.action_space: Any
        self.observation_space: Any
        self.action_space, self.observation_space = task_spaces(self.task, config)
        self._screen = Screen(config, None if self._bullets_window(link) else render_mode, view)
        self._course: Course | None = None
        self._scan: Scan | None = None
        self._told_last: tuple[Observation, Info] | None = None

    def _check_rendering(self, link: Any, view: str) -> None:
        if self.render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(
                f"render_mode = {shown(self.render_mode)}: must be None, human or rgb_array"
            )
        if not isinstance(view, str) or view not in ("top", "camera"):
            raise ConfigError(f"view = {shown(view)}: must be top or camera")
        if view == "camera" and isinstance(link, str) and link != "bullet":
            raise RenderError(f"link {link!r} has no camera; view='camera' needs link='bullet'")

    def _link(self, link: Any, config: RobotConfig) -> Link:
        if not isinstance(link, str | os.PathLike) and hasattr(link, "advance"):
            ready: Link = link
            return ready
        human = self.render_mode == "human"
        return open_link(link, config, window=self._bullets_window(link), realtime=human)

    def _bullets_window(self, link: Any) -> bool:
        """Whether PyBullet shows the robot in a window of its own."""
        return self.render_mode == "human" and link == "bullet" and display.found()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin an episode; opens link and LiDAR the first time. See the class for `options`."""
        self._halt()
        self._told_last = None
        super().reset(seed=seed)
        if self._faulty is not None:
            self._faulty.seed(self.np_random)
        self._course = course = self.task.begin(self.np_random, {} if options is None else options)
        task = course.assignment
        scene = Scene(task.start, point_in_world(task.start, task.goal), task.world)
        self.robot.reset(scene)
        if self.lidar is not None:
            self._see(lambda lidar: lidar.reset(scene, self.np_random))
            self._see(self._look)
        state = self._state((0.0, 0.0), self.robot.link.truth)
        self._screen.begin(course.assignment, course.tolerance)
        return self._told(course, state, Outcome.GOING)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, Info]:
        """Drive for one step of the policy; see the class for spaces, reward and end."""
        if self._course is None:
            raise ConfigError("step() before reset(): call reset() first")
        linear, angular = self._checked(action)
        try:
            self._drive(linear * self.task.max_linear, angular * self.task.max_angular)
        except LinkError as error:
            if self._told_last is None or not self._truncates:
                raise
            return self._cut_short(error)
        state = self._state((linear, angular), self.robot.link.truth)
        reward, outcome = self._course.judge(state)
        terminated = outcome is not Outcome.GOING
        observation, info = self._told(self._course, state, outcome)
        if terminated:
            self._halt()
        return observation, reward, terminated, False, info

    def _halt(self) -> None:
        """Stop between episodes; a link that is lost is closed, for the next reset to open."""
        try:
            self.robot.stop()
        except LinkError:
            self.robot.deactivate()

    def _cut_short(self, error: LinkError) -> tuple[Observation, float, bool, bool, Info]:
        """The end of an episode by a fault: what was seen last, and why; nothing drives now."""
        self.robot.deactivate()
        assert self._told_last is not None  # noqa: S101 - for the type checker
        (observation, info), self._told_last = self._told_last, None
        reason = {"fault": float(fault_code(error)), "fault_reason": str(error)}
        return observation.copy(), 0.0, False, True, info | {"is_success": 0.0} | reason

    def _drive(self, linear: float, angular: float) -> None:
        for _ in range(self.ticks_per_step):
            self.robot.drive(linear, angular)
            if self.lidar is not None:
                self._see(self._look)

    def _look(self, lidar: Lidar) -> None:
        self._scan = lidar.scan()

    def _see(self, use: Callable[[Lidar], None]) -> None:
        """Use the LiDAR; whatever goes wrong with it stops the robot."""
        try:
            if self.lidar is not None:
                use(self.lidar)
        except BaseException:
            self.robot.deactivate()
            raise

    def _checked(self, action: NDArray[np.float32]) -> tuple[float, float]:
        """The action as two floats in [-1, 1]; stops the wheels and raises for anything else."""
        try:
            linear, angular = np.asarray(action, np.float64).tolist()
            sound = math.isfinite(linear + angular)
        except (TypeError, ValueError, OverflowError):
            sound = False
        if not sound:
            self._halt()
            raise CommandError(
                f"action = {shown(action)}: must be two finite numbers (linear, angular) in [-1, 1]"
            )
        return min(max(linear, -1.0), 1.0), min(max(angular, -1.0), 1.0)

    def _state(self, action: tuple[float, float], truth: GroundTruth | None) -> State:
        odometry = self.robot.odometry
        if truth is not None and self._course is not None:
            start = self._course.assignment.start
            truth = replace(truth, pose=to_odometry(start, truth.pose))
        return State(odometry.pose, odometry.twist, action, truth)

    def _told(self, course: Course, state: State, outcome: Outcome) -> tuple[Observation, Info]:
        """What the agent gets, and what the screen shows."""
        try:
            self._screen.show(state, self._scan)
        except BaseException:
            self.robot.deactivate()
            raise
        told = self._observation(course, state), self._info(course, state, outcome)
        self._told_last = told
        return told

    def _observation(self, course: Course, state: State) -> Observation:
        numbers = course.observe(state)
        if self._scan is None:
            return np.array(numbers, np.float32)
        shares = self._scan.ranges / self.robot.config.lidar.max_range
        return np.concatenate([numbers, shares]).astype(np.float32)

    def _info(self, course: Course, state: State, outcome: Outcome) -> Info:
        (x, y, theta), truth = state.pose, state.truth
        true_pose = truth.pose if truth else NOWHERE
        info = {
            "is_success": float(outcome is Outcome.SUCCESS),
            "odom_x": x,
            "odom_y": y,
            "odom_theta": theta,
            "feedback_age": self.robot.feedback_age,
            "sent_linear": self.robot.safety.sent[0],
            "sent_angular": self.robot.safety.sent[1],
            "sent_reason": float(self.robot.safety.reason),
            "true_x": true_pose[0],
            "true_y": true_pose[1],
            "true_theta": true_pose[2],
            "true_contact": float(truth.contact) if truth else math.nan,
            "odometry_error": math.hypot(true_pose[0] - x, true_pose[1] - y),
        } | course.info(state, true_pose)
        if self._faulty is not None or truth is None:
            info["fault"] = 0.0
        if self._scan is not None:
            age = self.robot.link.now() - self._scan.stamp
            info["scan_age"] = age
            info["scan_stale"] = float(age > stale_after(self.robot.config))
        return info

    @property
    def course(self) -> Course:
        """The episode's course: its world, goal and path. ConfigError before the first reset."""
        if self._course is None:
            raise ConfigError("there is no episode before reset(): call it first")
        return self._course

    def render(self) -> Image | None:
        """A picture, height x width x 3 uint8, in mode rgb_array; windows draw themselves."""
        if self.render_mode != "rgb_array":
            return None
        if not self.robot.active:
            raise RenderError("there is nothing to see before reset(): call it first")
        return self._screen.picture(self.robot.link)

    def close(self) -> None:
        """Stop the wheels, close link, LiDAR and window; twice is once."""
        self._told_last = None
        try:
            self.robot.deactivate()
        finally:
            if self.lidar is not None:
                self.lidar.close()
            self._screen.close()

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles have a robot of their own and are in no episode: reset them first."""
        return self.__dict__ | {"_course": None, "_scan": None, "_told_last": None}

    def __copy__(self) -> Self:
        """Two environments never share a robot, so that every copy is a deep one."""
        return copy.deepcopy(self)

    def __del__(self) -> None:
        if getattr(self, "robot", None) is not None and hasattr(self, "_screen"):
            with contextlib.suppress(AcsarError):
                self.close()
